import pytest
from silent_steps import Silent

#: Fewer steps and pixels, as so small images need.
SMALL = {
    "openings.iterations": 100,
    "radiance.batch": 16384,
    "radiance.smoothing": 8.0,
    "openings.mask": 0.01,
    "openings.binary": 0.015,
    "openings.closing": 0.003,
}


@pytest.fixture(scope="module")
def fit(exact):
    from gshell_mi.fit.stage import Fit

    return Fit(exact.scene, exact.config.changed(SMALL), exact.lattices)


@pytest.fixture(scope="module")
def hull(fit):
    """The bowl with a lid."""
    from gshell_mi.fit.stages.hull import Hull

    return Hull(fit.config.hull).run(fit, None, Silent())
