"""The live view: that its server answers, and that a browser's connection gets what the fit finds."""

import shutil
import socket
import sys
import urllib.error
import urllib.request

import numpy as np
import pytest
from bowl import CLOSED, SHORT
from fitted import open_sphere

from gshell_mi import UserError
from gshell_mi.fit.__main__ import main
from gshell_mi.preview import Preview
from gshell_mi.scene import load_fit_scene
from gshell_mi.viewer import Viewer
from gshell_mi.viewer.parts import mesh_parts, template_part

viser = pytest.importorskip("viser", reason="no viser: there is no live view")

SOFTWARE_GL = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]


@pytest.fixture
def viewer():
    with Viewer(port=0) as viewer:
        yield viewer


def preview() -> Preview:
    """An open sphere in pure green under a closed template."""
    mesh, template = open_sphere(3), open_sphere(2)
    colors = np.tile([0.0, 0.6, 0.0], (len(mesh.vertices), 1))
    return Preview(mesh.vertices, mesh.faces, colors, template.vertices, template.faces)


class _Counted:
    """A preview that counts how often it is asked for."""

    def __init__(self):
        self.asked = 0

    def __call__(self) -> Preview:
        self.asked += 1
        return preview()


def receive(viewer: Viewer, wanted: list[bytes], seconds: float = 20) -> None:
    """Connects as a browser does, and waits until all of ``wanted`` has come."""
    import zstandard
    from websockets.sync.client import connect

    address, data = viewer.url.replace("http://localhost", "ws://127.0.0.1"), b""
    with connect(address, subprotocols=[f"viser-v{viser.__version__}"], max_size=None) as client:
        while not all(part in data for part in wanted):
            frame = client.recv(timeout=seconds)
            # Sizes before and after compression, a compressed message, arrays as they are.
            end = 16 + int.from_bytes(frame[8:16], "little")
            data += zstandard.ZstdDecompressor().decompress(frame[16:end]) + frame[end:]


def test_it_serves_a_page(viewer):
    with urllib.request.urlopen(viewer.url.replace("localhost", "127.0.0.1")) as answer:
        assert answer.status == 200 and b"<html" in answer.read().lower()


def test_a_client_receives_cameras_meshes_and_losses(viewer, bowl_scene):
    viewer.begin(load_fit_scene(bowl_scene))
    viewer.step("joint", 4, 20, {"loss": 0.1234, "psnr": 21.5}, preview)
    receive(
        viewer,
        [
            b"/cameras/view_011",
            b"/open mesh",
            b"/template",
            b"glTF",
            b"**joint**, step 5 of 20",
            b"loss 0.1234",
        ],
    )


def test_it_takes_little_of_the_time(viewer):
    look, count = _Counted(), 500
    for iteration in range(count):
        viewer.step("appearance", iteration, count, {"loss": 1.0, "psnr": 10.0}, look)
    assert look.asked == 2, "the first step and the last, as all took less than an interval"
    viewer.step("joint", 0, count, {"loss": 1.0, "psnr": 10.0}, look)
    assert look.asked == 3, "a new stage shows at once"


def test_it_shows_what_stages_leave_that_make_no_steps(viewer):
    look = _Counted()
    viewer.stage_done("hull", look)
    assert look.asked == 1
    viewer.step("joint", 0, 1, {"loss": 1.0, "psnr": 10.0}, look)
    viewer.stage_done("joint", look)
    assert look.asked == 2, "its last step has been shown"


def test_a_port_that_is_taken(viewer):
    port = int(viewer.url.rpartition(":")[2])
    with Viewer(port=port) as second:
        assert second.url != viewer.url


def test_parts():
    seen = preview()
    mesh, back = mesh_parts(seen)
    assert len(mesh.indices) == len(back.indices) == len(seen.faces)
    assert mesh.attributes["COLOR_0"].max(0) == pytest.approx([0, 0.6, 0])
    # Vertices that no face uses are left out, and nothing at all is no error.
    one = Preview(seen.vertices, seen.faces[:1], seen.colors, seen.template_vertices, seen.template_faces[:0])
    assert len(mesh_parts(one)[0].attributes["POSITION"]) == 3
    assert template_part(one) == []
    none = Preview(seen.vertices, seen.faces[:0], seen.colors, seen.template_vertices, seen.template_faces)
    assert mesh_parts(none) == [] and len(template_part(none)) == 1


def test_without_viser(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(UserError, match=r"viser, .* not installed; run 'pip install gshell_mi\[viewer\]'"):
        Viewer()


def test_of_a_whole_fit(bowl_scene, tmp_path, capfd, monkeypatch):
    """Every stage reports what it has to the viewer that the command starts."""
    seen = {}
    show = Viewer._show

    def watch(self, preview):
        seen[self._stage] = preview
        show(self, preview)

    monkeypatch.setattr(Viewer, "_show", watch)
    options = [*SHORT, *CLOSED, "--iterations", "2", "--poses", "keep"]
    options += ["--quiet", "--viewer", "--viewer-port", "0"]
    assert main([str(bowl_scene), "-o", str(tmp_path / "out"), *options]) == 0
    assert "live view: http://localhost:" in capfd.readouterr().err
    assert {"hull", "openings", "cavities", "refinement", "revoxelise", "joint"} <= set(seen)
    for found in seen.values():
        assert found.faces.max() < len(found.vertices) == len(found.colors)
        assert np.linalg.norm(found.vertices, axis=1).max() < 1 and len(found.faces) > 100
        assert np.isfinite(found.colors).all() and len(found.template_faces) >= len(found.faces)


def test_in_a_browser(viewer, bowl_scene):
    playwright = pytest.importorskip("playwright.sync_api", reason="no playwright: the page is not opened")
    names = ("chromium", "chromium-browser", "google-chrome")
    browser_path = next(filter(None, map(shutil.which, names)), None)
    viewer.begin(load_fit_scene(bowl_scene))
    viewer.step("joint", 4, 20, {"loss": 0.1234, "psnr": 21.5}, preview)
    with playwright.sync_playwright() as driver:
        try:
            browser = driver.chromium.launch(executable_path=browser_path, args=SOFTWARE_GL)
        except playwright.Error:
            pytest.skip("no Chromium is installed: the page is not opened")
        page, complaints = browser.new_page(), []
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.goto(viewer.url.replace("localhost", "127.0.0.1"))
        page.get_by_text("step 5 of 20").wait_for(timeout=60_000)
        viewer.step("joint", 19, 20, {"loss": 0.1, "psnr": 25.0}, preview)
        page.get_by_text("step 20 of 20").wait_for(timeout=60_000)
        assert not viewer._handles["template"][1].visible
        page.get_by_role("checkbox", name="template").check()
        while not viewer._handles["template"][1].visible:
            page.wait_for_timeout(100)
        browser.close()
    assert complaints == []


# --- who may look


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 200),
        ({"Origin": "http://evil.example"}, 403),
        ({"Host": "evil.example"}, 403),
        ({"Host": "localhost:9000", "Origin": "http://localhost:9000"}, 200),  # behind ssh -L
        ({"Host": "localhost:9000", "Origin": "http://localhost:3000"}, 403),
        ({"Origin": "null"}, 403),
    ],
)
def test_it_answers_its_own_page_alone(viewer, headers, status):
    request = urllib.request.Request(viewer.url.replace("localhost", "127.0.0.1"), headers=headers)
    if status == 200:
        assert urllib.request.urlopen(request).status == 200
        return
    with pytest.raises(urllib.error.HTTPError) as refused:
        urllib.request.urlopen(request)
    assert refused.value.code == status and b"<html" not in refused.value.read()


@pytest.mark.parametrize(
    ("origin", "taken"),
    [("http://evil.example", False), ("http://127.0.0.1:1", False), (None, True), ("own", True)],
)
def test_connections_of_other_origins_are_refused(viewer, origin, taken):
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    address = viewer.url.replace("http://localhost", "127.0.0.1")
    origin = f"http://{address}" if origin == "own" else origin

    def open_it():
        return connect(f"ws://{address}", subprotocols=[f"viser-v{viser.__version__}"], origin=origin)

    if taken:
        with open_it() as client:
            assert client.recv(timeout=20)
        return
    with pytest.raises(InvalidStatus, match="403"):
        open_it()


@pytest.mark.parametrize("port", [-1, 65536, 10**9])
def test_no_port(port):
    with pytest.raises(UserError, match=f"--viewer-port lies between 0 and 65535, unlike {port}"):
        Viewer(port=port)


def test_no_free_port():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 65535))
        taken.listen()
        with pytest.raises(UserError, match="No port from 65535 on is free; choose a smaller"):
            Viewer(port=65535)


def test_a_viser_of_another_build_is_refused(monkeypatch):
    """Where the guard would not be asked, there is no view."""
    monkeypatch.setattr(viser, "ViserServer", lambda **_: None)
    with pytest.raises(UserError, match="cannot be kept to its own page"):
        Viewer(port=0)
