"""The regression net: whole fits against stored results. `make regress` runs it.

It takes minutes per case, so `make test` does not collect it, but for the smallest case (test_small_fit.py).
"""

import pytest
from cases import CASES


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_fit_is_no_worse_than_what_is_stored(case, net):
    net.run(case)
