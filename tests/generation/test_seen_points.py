"""Which parts of a surface the views of a fit saw."""

import numpy as np
import pytest
import trimesh

from gshell_mi.generation.unseen import seen_points

_SCENE = """<scene version="3.0.0"><integrator type="path"/>
<sensor type="perspective" id="view_000"><float name="fov" value="60"/>{optics}
<transform name="to_world"><lookat origin="1,0,20" target="1,0,0" up="0,1,0"/></transform>
<film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="16"/>
{crop}</film></sensor>
<emitter type="constant" id="light"/><shape type="ply" id="subject"><string name="filename" value="mesh.ply"/>
</shape></scene>"""


def seen_of_ball(folder, optics="", crop=""):
    """Points of a ball of radius 2, in its own units, and whether a camera in front of it sees them."""
    ball = trimesh.creation.icosphere(subdivisions=4)
    trimesh.Trimesh(2 * ball.vertices + [1, 0, 0], ball.faces).export(folder / "mesh.ply")
    (folder / "scene.xml").write_text(_SCENE.format(optics=optics, crop=crop))
    back = np.diag([2.0, 2, 2, 1])
    back[0, 3] = 1
    return seen_points(folder, ball, back)


def test_a_view_sees_the_side_of_a_ball_that_faces_it(tmp_path):
    points = seen_of_ball(tmp_path)
    assert points[points[:, 2] > 0.2, 3].mean() > 0.99
    assert points[points[:, 2] < 0.0, 3].mean() < 0.01


@pytest.mark.parametrize(
    "given",
    [
        {"optics": '<float name="principal_point_offset_y" value="-0.5"/>'},
        {"crop": '<integer name="crop_height" value="8"/>'},
    ],
)
def test_a_view_sees_what_is_in_its_frame_only(given, tmp_path):
    """The upper half of the frame is left, or the half above the axis fills it."""
    points = seen_of_ball(tmp_path, **given)
    front = points[:, 2] > 0.2
    upper, lower = front & (points[:, 1] > 0.05), front & (points[:, 1] < -0.05)
    assert sorted([points[upper, 3].mean(), points[lower, 3].mean()]) == pytest.approx([0, 1], abs=0.01)
