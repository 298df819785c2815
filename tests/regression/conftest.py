"""Options of the regression net, for `make regress`."""

from pathlib import Path

import pytest


def pytest_addoption(parser):
    group = parser.getgroup("regression net")
    group.addoption("--update", action="store_true", help="store what is found as what is expected")
    group.addoption("--fresh", action="store_true", help="make every fit anew")
    group.addoption(
        "--fits",
        type=Path,
        default=Path("out/regression"),
        help="folder of the fits and their table (default out/regression)",
    )


@pytest.fixture(scope="session")
def net(request):
    """The run over all cases."""
    from net import Net  # needs a variant, which is not set when options are read

    option = request.config.getoption
    return Net(option("--fits").absolute(), option("--update"), option("--fresh"))
