"""A whole fit of the least effort, of few and small views, against a stored result."""

import pytest
from cases import SMALL
from net import Net


@pytest.mark.slow
def test_small_fit_is_no_worse_than_what_is_stored(tmp_path):
    Net(tmp_path).run(SMALL)
