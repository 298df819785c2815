"""How settings change over a stage; ``progress`` goes from 0 to 1."""


def decay_at(progress: float) -> float:
    """The factor of step sizes, which falls tenfold."""
    return 0.1**progress


def falling(start: float, end: float, progress: float) -> float:
    """A lambda that falls geometrically from ``start`` to ``end``; 0, which is no smoothing, if either is 0.

    >>> [falling(8.0, 0.5, progress) for progress in (0, 0.5, 1)], falling(0.0, 0.5, 0.5)
    ([8.0, 2.0, 0.5], 0.0)
    """
    return start * (end / start) ** progress if start and end else 0.0
