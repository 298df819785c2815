"""What the judge rejects of the second round is forgotten: nobody has compared it with the first template."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from silent_steps import Silent

from gshell_mi.fit.stages import refinement
from gshell_mi.fit.stages.refinement import Refinement
from gshell_mi.fit.surface import Moved
from gshell_mi.fit.template import template_of


@pytest.mark.parametrize(("kept", "stages"), [(True, ["folds", "refinement"]), (False, ["refinement"])])
def test_only_accepted_folds_count(fit, hull, decisions, monkeypatch, kept, stages):
    start = template_of(fit.scene.subject, hull.on_grid(fit.lattices.late.grid)).start
    first, second = (Moved(name, start, np.ones_like(start)) for name in ("refinement", "folds"))
    appearance = SimpleNamespace(take_over=lambda *_: None)
    monkeypatch.setattr(refinement, "training_radiance", lambda *_: appearance)
    monkeypatch.setattr(Refinement, "_moved", lambda *_: second)
    decisions(kept)
    found = Refinement("folds", fit.config.folds, first=False).run(
        fit, replace(hull, moved=(first,)), Silent()
    )
    assert [moved.stage for moved in found.moved] == stages
