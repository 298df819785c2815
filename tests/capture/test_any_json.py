"""Documents of every shape in place of transforms.json: read, or refused in a sentence."""

import json

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from gshell_mi.capture import read_capture
from gshell_mi.errors import UserError

SCALARS = (
    st.none()
    | st.booleans()
    | st.integers(-(10**400), 10**400)
    | st.floats()
    | st.text(max_size=20)
    | st.sampled_from(["a.png", "/", "..", "a", "\\", "train_filenames"])
)
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=20,
)
KEYS = [
    "w",
    "h",
    "fl_x",
    "fl_y",
    "cx",
    "cy",
    "k1",
    "camera_model",
    "camera_angle_x",
    "is_fisheye",
    "train_filenames",
    "val_filenames",
    "test_filenames",
]
FRAMES = st.lists(
    VALUES
    | st.fixed_dictionaries(
        {},
        optional={
            "file_path": SCALARS,
            "transform_matrix": VALUES | st.just(np.eye(4).tolist()),
            "mask_path": SCALARS,
            "fl_x": SCALARS,
            "w": SCALARS,
        },
    ),
    max_size=3,
)
DOCUMENTS = VALUES | st.fixed_dictionaries(
    {"frames": FRAMES | VALUES}, optional={key: VALUES for key in KEYS}
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("capture")
    Image.fromarray(np.zeros((12, 16, 4), np.uint8)).save(place / "a.png")
    return place


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(document=DOCUMENTS)
def test_documents_are_read_or_refused(document, folder):
    (folder / "transforms.json").write_text(json.dumps(document), encoding="utf-8", errors="surrogatepass")
    try:
        capture = read_capture(folder)
    except UserError as error:
        assert str(error).endswith(".") and len(str(error)) < 3000
        return
    assert all(frame.image == folder / "a.png" for frame in capture.frames)
    assert all(np.isfinite(frame.camera.to_world).all() and frame.camera.fx > 0 for frame in capture.frames)
