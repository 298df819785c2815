"""Trainings for tests."""


def train_tiny(data_set, output, steps, **options):
    """Trains the smallest model for some steps."""
    from gshell_mi.generation.train_config import TrainConfig
    from gshell_mi.generation.training import train

    return train(
        data_set,
        output,
        TrainConfig(**{"size": "XS", "steps": steps, "batch": 8, "device": "cpu", "pictures": 0} | options),
    )
