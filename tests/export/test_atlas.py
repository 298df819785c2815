"""UV atlases of objects in any units."""

import numpy as np
import pytest
import trimesh

from gshell_mi.export.atlas import unwrap

BALL = trimesh.creation.icosphere(subdivisions=4)  # 5120 faces


@pytest.mark.parametrize("scale", [1e-8, 1e-3, 1e5])
def test_units_do_not_matter(scale):
    """xatlas takes faces of less than 1e-7 square units for empty."""
    expected = unwrap(BALL.vertices, BALL.faces)
    found = unwrap(scale * BALL.vertices + 10 * scale, BALL.faces)
    assert found is not None and found.charts == expected.charts < 20
    np.testing.assert_allclose(found.uv, expected.uv, atol=0.02)
