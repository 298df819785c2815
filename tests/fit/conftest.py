import numpy as np
import pytest


@pytest.fixture(scope="module")
def exact(bowl_scene):
    """What the stages of a fit of the bowl may read, with the default settings."""
    from gshell_mi.fit import FitConfig
    from gshell_mi.fit.stage import Fit
    from gshell_mi.scene import load_fit_scene

    scene, config = load_fit_scene(bowl_scene), FitConfig()
    return Fit.of(scene, config)


@pytest.fixture
def decisions(monkeypatch):
    """Call it with what the judge shall say of the next changes of the whole surface: of the refinement, the
    folds and the volume, as far as there are any."""
    from gshell_mi.fit.judge import Judge, Verdict

    said: list[bool] = []
    last = False

    def decide(self, before, after) -> Verdict:
        nonlocal last
        if len(self.splits) > 1:
            last = said.pop(0)
        # Those that the refinement has not seen say the same.
        return Verdict(np.ones(1), np.ones(1), np.array([1.0 if last else -1.0]), np.array([0.1]))

    monkeypatch.setattr(Judge, "decide", decide)
    return lambda *accepted: said.extend(accepted)


@pytest.fixture
def rejecting(monkeypatch):
    """The judge rejects everything."""
    _say(monkeypatch, False)


@pytest.fixture
def accepting(monkeypatch):
    """The judge accepts everything."""
    _say(monkeypatch, True)


def _say(monkeypatch, accepted: bool) -> None:
    from gshell_mi.fit.judge import Verdict

    monkeypatch.setattr(Verdict, "accepted", property(lambda self: np.full(len(self.gain), accepted)))
