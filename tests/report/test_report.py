"""report.html: what is in it, and that it works in a browser without a network."""

import base64
import io
import json
import re
import shutil
import threading
from dataclasses import asdict

import numpy as np
import pytest
from fitted import open_sphere, write_fit
from PIL import Image

from gshell_mi import UserError
from gshell_mi.export.gltf import read_part
from gshell_mi.files import locked
from gshell_mi.fit.config import FitConfig
from gshell_mi.own_folder import OwnFolder
from gshell_mi.report import ReportConfig, write_report
from gshell_mi.report.__main__ import main
from gshell_mi.report.metrics import read_metrics
from gshell_mi.report.viewer_model import boundary_tubes, viewer_model
from gshell_mi.report.views import correction_rows
from gshell_mi.topology import topology

SMALL = ReportConfig(turntable_frames=3, turntable_size=64, turntable_spp=2, views=2)
SOFTWARE_GL = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]


TRAINING = {
    "views": {
        "view_000": {"psnr": 31.5, "psnr_inside": 30.0, "ssim": 0.95, "flip": 0.04, "mask_iou": 0.98},
        "view_001": {"psnr": 31.0, "mask_iou": None},
    },
    "mean": {"psnr": 31.25, "psnr_inside": 30.0, "ssim": 0.95, "flip": 0.04, "mask_iou": 0.98},
}
HELD_OUT = {
    "views": {"view_003": {"psnr": 29.0, "mask_iou": 0.81}, "view_004": {"psnr": 28.0, "mask_iou": 0.92}},
    "mean": {"psnr": 28.5, "mask_iou": 0.865},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A finished fit's folder: three views whose targets are red and whose fits are blue; two held out."""
    folder = write_fit(tmp_path_factory.mktemp("fit"), open_sphere(3))
    (folder / "views").mkdir()
    triptych = np.zeros((32, 96, 3), np.uint8)
    triptych[:, :32, 0], triptych[:, 32:64, 2] = 255, 255
    for number in range(3):
        Image.fromarray(triptych).save(folder / "views" / f"view_{number:03}.png")
    overlay = np.full((500, 500, 3), 255, np.uint8)
    overlay[100:400, 200:300] = 128
    for name in ("held_out", "masks"):
        (folder / name).mkdir()
        for number in (3, 4):
            image = Image.fromarray(triptych if name == "held_out" else overlay)
            image.save(folder / name / f"view_{number:03}.png")
    mesh = open_sphere(3)
    (folder / "metrics.json").write_text(
        json.dumps(
            {
                "scene": "ball <&>.xml",
                "psnr_training": 31.25,
                "training": TRAINING,
                "held_out": HELD_OUT,
                "counts": asdict(topology(mesh.vertices, mesh.faces)),
                "seconds": {"hull": 1.0, "total": 1.0},
                "versions": {"gshell_mi": "0"},
                "warnings": ["1 floater <here>"],
                "diagnostics": {"floaters": 1},
                "poses": {"views": {"view_000": {"pixels": 0.3, "degrees": 0.02}}},
                "light_frame": "camera",
                "peak_memory_mib": 900,
                "variant": "llvm_ad_rgb",
                "config": asdict(FitConfig()),
            }
        )
    )
    lines = [
        {"stage": "joint", "iteration": i, "loss": 0.1 / (i + 1), "psnr": 20 + i, "seconds": 0.1}
        for i in range(5)
    ]
    (folder / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    write_report(folder, SMALL)
    return folder


def test_page_is_self_contained(folder):
    text = (folder / "report.html").read_text()
    page = text[: text.index('<script type="module">')]
    sources = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert sources and all(source.startswith("data:") for source in sources)
    assert "ball &lt;&amp;&gt;" in page, "names are escaped"
    assert "1 floater &lt;here&gt;" in page, "warnings are told"
    assert "<td>diagnostics.floaters</td><td>1</td>" in page and "<td>peak_memory_mib</td>" in page
    assert "31.25 dB" in page and "view_000: target | fit, 31.50 dB" in page and "view_002" in page
    assert "daylight_votes" in text and "seconds.hull" in text


def test_corrections_come_largest_first(folder):
    page = (folder / "report.html").read_text().partition("<h2>Corrections</h2>")[2]
    assert "<tr><td>view_000</td><td>0.30</td><td>0.020</td><td>–</td></tr>" in page
    metrics = {
        "poses": {
            "views": {
                "view_000": {"pixels": 0.3, "degrees": 0.02, "shift": 0.1},
                "view_001": {"pixels": 1.2, "degrees": 0.2, "shift": 0.1},
            }
        },
        "exposures": {"stops": {"view_001": -0.25, "view_002": 0.5}},
    }
    assert correction_rows(metrics) == [
        ("view_001", ["1.20", "0.200", "-0.250"]),
        ("view_000", ["0.30", "0.020", "–"]),
        ("view_002", ["–", "–", "0.500"]),
    ]
    assert correction_rows({}) == []


def test_held_out_views_come_worst_first(folder):
    page = (folder / "report.html").read_text().partition('<script type="module">')[0]
    assert "28.50 dB on 2 held-out views" in page
    held_out, training = page.partition("<h2>Held-out views</h2>")[2].split("<h2>Training views</h2>")
    training = training.partition("<h2>Corrections</h2>")[0]
    rows = re.findall(r"<td>(view_\d+|mean)</td><td>([^<]*)</td><td>([^<]*)</td>", held_out)
    assert rows == [("mean", "28.50", "–"), ("view_004", "28.00", "–"), ("view_003", "29.00", "–")]
    told = re.findall(r"<figcaption>(.*)</figcaption>", held_out)
    assert told == ["view_004, 28.00 dB", "view_003, 29.00 dB"]
    rows = re.findall(r"<td>(view_\d+|mean)</td><td>([^<]*)</td><td>([^<]*)</td>", training)
    assert rows == [("mean", "31.25", "30.00"), ("view_001", "31.00", "–"), ("view_000", "31.50", "30.00")]


def test_held_out_views_with_corrected_cameras_come_besides(folder, tmp_path):
    assert "laid on the surface" not in (folder / "report.html").read_text()
    shutil.copytree(folder, tmp_path / "fit")
    metrics = json.loads((folder / "metrics.json").read_text())
    views = {"view_003": {"psnr": 30.0}, "view_004": {"psnr": 33.0}}
    metrics["held_out_laid"] = {"views": views, "mean": {"psnr": 31.5}}
    (tmp_path / "fit" / "metrics.json").write_text(json.dumps(metrics))
    page = write_report(tmp_path / "fit", SMALL).read_text().partition("laid on the surface")[2]
    rows = re.findall(r"<td>(view_\d+|mean)</td><td>([^<]*)</td>", page.partition("</table>")[0])
    assert rows == [("mean", "31.50"), ("view_003", "30.00"), ("view_004", "33.00")]


def test_masks_come_worst_first_and_small(folder):
    page = (folder / "report.html").read_text().partition('<script type="module">')[0]
    masks = page.partition("<h2>Masks</h2>")[2].partition("<h2>Curves</h2>")[0]
    told = re.findall(r"<figcaption>(.*)</figcaption>", masks)
    assert told == ["view_003 (held out), IoU 0.810", "view_004 (held out), IoU 0.920"]
    data = re.search(r"data:image/webp;base64,([^\"]*)", masks)[1]
    picture = Image.open(io.BytesIO(base64.b64decode(data)))
    assert picture.size == (round(320 / 320 * 120), 320), "cut to what is not white, with 10 pixels around"


def test_a_fit_to_all_views(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "fit")
    for name in ("held_out", "masks"):
        shutil.rmtree(tmp_path / "fit" / name)
    metrics = json.loads((folder / "metrics.json").read_text())
    del metrics["held_out"]
    metrics["light_frame"] = "world"
    (tmp_path / "fit" / "metrics.json").write_text(json.dumps(metrics))
    page = write_report(tmp_path / "fit", SMALL).read_text().partition('<script type="module">')[0]
    assert "<h2>Training views</h2>" in page and "eld-out" not in page and "<h2>Masks</h2>" not in page
    assert "It turns with the camera" not in page
    assert "It turns with the camera" in (folder / "report.html").read_text()


METRICS = {
    "scene": "a.xml",
    "psnr_training": 30.0,
    "training": TRAINING,
    "versions": {},
    "counts": {"vertices": 3, "faces": 1, "boundary_loops": 1, "components": 1},
    "seconds": {"total": 1.0},
    "config": {},
}


def test_metrics_of_a_fit_are_read(tmp_path):
    (tmp_path / "metrics.json").write_text(json.dumps(METRICS))
    assert read_metrics(tmp_path / "metrics.json") == METRICS


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{}", "'scene' is missing"),
        ("[]", "it is no object"),
        ("5", "it is no object"),
        *(
            (
                json.dumps({key: value for key, value in METRICS.items() if key != name}),
                f"'{name}' is missing",
            )
            for name in METRICS
        ),
        *(
            (json.dumps(METRICS | change), words)
            for change, words in (
                ({"scene": 5}, "'scene' is no str"),
                ({"psnr_training": "30"}, "'psnr_training' is no number"),
                ({"psnr_training": float("nan")}, "'psnr_training' is no number"),
                ({"psnr_training": 10**400}, "'psnr_training' is no number"),
                ({"counts": [3]}, "'counts' is no dict"),
                ({"counts": {"vertices": 3}}, "'counts.faces' is no"),
                ({"seconds": {}}, "'seconds.total' is no"),
                ({"training": {}}, "'training' holds"),
                ({"training": TRAINING | {"mean": 5}}, "'training' holds"),
                ({"held_out": 5}, "'held_out' is no dict"),
                ({"held_out_laid": {"views": {}}}, "'held_out_laid' holds"),
                ({"poses": {"views": {"view_000": {"pixels": "many"}}}}, "'poses' or 'exposures' holds"),
                ({"poses": {"views": [1]}}, "'poses' or 'exposures' holds"),
                ({"exposures": {"stops": {"view_000": None}}}, "'poses' or 'exposures' holds"),
                ({"held_out": {"views": {"a": {"psnr": None}}, "mean": {"psnr": 1}}}, "'held_out' holds"),
                (
                    {"held_out": {"views": {"a": {"psnr": 1, "ssim": "x"}}, "mean": {"psnr": 1}}},
                    "'held_out' holds",
                ),
                ({"warnings": "x"}, "'warnings' is no list"),
                ({"diagnostics": 1}, "'diagnostics' is no"),
                ({"config": {"a": [[[[[[[[1]]]]]]]]}}, "it is nested too deeply"),
            )
        ),
    ],
)
def test_metrics_that_no_fit_wrote(folder, tmp_path, capsys, text, words):
    shutil.copytree(folder, tmp_path / "fit")
    (tmp_path / "fit" / "metrics.json").write_text(text)
    before = (tmp_path / "fit" / "report.html").read_bytes()
    assert main([str(tmp_path / "fit")]) == 2
    error = capsys.readouterr().err
    assert f"metrics.json' is not what a fit writes ({words}" in error and error.count("\n") == 1
    assert (tmp_path / "fit" / "report.html").read_bytes() == before


@pytest.mark.parametrize("text", ["", "{", "[" * 100_000, "9" * 5000, "\udcff"])
def test_metrics_that_are_no_json(tmp_path, text):
    (tmp_path / "metrics.json").write_text(text, errors="surrogateescape")
    with pytest.raises(UserError, match="is missing or no JSON"):
        read_metrics(tmp_path / "metrics.json")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("mesh.glb", "mesh.glb' is damaged"),
        ("views/view_000.png", "view_000.png' cannot be read as an image"),
        ("held_out/view_003.png", "view_003.png' cannot be read as an image"),
        ("masks/view_003.png", "view_003.png' cannot be read as an image"),
        ("light.exr", "light.exr"),
        ("mesh.ply", "mesh.ply"),
    ],
)
@pytest.mark.parametrize("damage", [lambda data: b"", lambda data: b"garbage", lambda data: data[:30]])
def test_damaged_files_of_a_fit(folder, tmp_path, capsys, name, words, damage):
    shutil.copytree(folder, tmp_path / "fit")
    (tmp_path / "fit" / name).write_bytes(damage((folder / name).read_bytes()))
    assert main([str(tmp_path / "fit"), "--turntable-frames", "1", "--turntable-size", "16"]) == 2
    error = capsys.readouterr().err
    assert words in error and error.startswith("error: ") and error.count("\n") == 1


@pytest.mark.parametrize("name", ["views/view_000.png", "held_out/view_003.png"])
def test_a_picture_that_is_no_triptych(folder, tmp_path, name):
    shutil.copytree(folder, tmp_path / "fit")
    Image.new("RGB", (2, 9)).save(tmp_path / "fit" / name)
    with pytest.raises(UserError, match="is too narrow for three pictures"):
        write_report(tmp_path / "fit", ReportConfig(turntable_frames=1, turntable_size=16, turntable_spp=1))


def test_a_report_of_somebody_elses_is_kept(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "fit")
    OwnFolder(tmp_path / "fit", "fit").write_mark(["mesh.glb"])
    (tmp_path / "fit" / "report.html").write_text("mine")
    with pytest.raises(UserError, match=r"report.html' is in the way"):
        write_report(tmp_path / "fit", SMALL)
    assert (tmp_path / "fit" / "report.html").read_text() == "mine"


def test_a_folder_that_a_fit_is_writing(folder, tmp_path, capsys):
    shutil.copytree(folder, tmp_path / "fit")
    told = []
    with locked(tmp_path / "fit"):
        thread = threading.Thread(target=lambda: told.append(main([str(tmp_path / "fit")])))
        thread.start()
        thread.join()
    assert told == [2] and "Another run is writing into" in capsys.readouterr().err


def test_model_of_the_view(folder):
    data = viewer_model(folder)
    document = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    names = [folder.name, "back faces", "template", "boundary loops"]
    assert [material["name"] for material in document["materials"]] == names
    subject = read_part(data)
    mesh = open_sphere(3)
    assert topology(mesh.vertices, mesh.faces).faces == len(subject.indices)
    primitive = document["meshes"][1]["primitives"][0]
    assert document["accessors"][primitive["indices"]]["count"] == 3 * len(subject.indices)


def test_tubes_follow_the_boundary():
    mesh = open_sphere(3)
    points, faces = boundary_tubes(mesh.vertices, mesh.faces, 0.01)
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2))
    edges, uses = np.unique(edges, axis=0, return_counts=True)
    rim = mesh.vertices[np.unique(edges[uses == 1])]
    distance = np.linalg.norm(points[:, None] - rim[None], axis=-1).min(1)
    assert distance == pytest.approx(np.hypot(0.01, 0.005), rel=1e-3)
    assert len(faces) == 10 * (uses == 1).sum()
    closed = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    assert boundary_tubes(np.eye(4)[:, :3], closed, 0.1) is None


@pytest.fixture(scope="module")
def page(folder):
    """The report opened from its file in headless Chromium without a network; and its complaints."""
    playwright = pytest.importorskip("playwright.sync_api", reason="no playwright: the page is not opened")
    names = ("chromium", "chromium-browser", "google-chrome")
    browser_path = next(filter(None, map(shutil.which, names)), None)
    with playwright.sync_playwright() as driver:
        try:
            browser = driver.chromium.launch(executable_path=browser_path, args=SOFTWARE_GL)
        except playwright.Error:
            pytest.skip("no Chromium is installed: the page is not opened")
        page = browser.new_context(offline=True).new_page()
        complaints = []
        page.on("console", lambda said: complaints.append(said.text) if said.type == "error" else None)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("requestfailed", lambda request: complaints.append(request.url[:100]))
        page.goto((folder / "report.html").as_uri())
        page.wait_for_function("document.getElementById('viewer').dataset.ready === 'yes'", timeout=90_000)
        yield page, complaints
        browser.close()


def picture(locator) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(locator.screenshot())).convert("RGB"), float) / 255


def test_no_console_error(page):
    assert page[1] == []


def test_view_draws_and_its_parts_can_be_switched(page):
    viewer, drawn = page[0].locator("#viewer"), {}
    for shown in ("open mesh", "template", "boundary loops", None):
        for box in page[0].locator("input[data-materials]").all():
            box.set_checked(shown is not None and shown in box.locator("..").inner_text())
        page[0].wait_for_timeout(1500)
        drawn[shown] = picture(viewer)
    changed = {
        shown: (np.abs(image - drawn[None]).max(-1) > 0.02).mean() for shown, image in drawn.items() if shown
    }
    assert changed["open mesh"] > 0.1 and changed["template"] > 0.1
    assert 0.0005 < changed["boundary loops"] < 0.1


def test_slider_moves_between_target_and_fit(page):
    pair, slider = page[0].locator(".compare").first, page[0].locator("input[type=range]").first
    blue = []
    for value in ("0", "50", "100"):
        slider.fill(value)
        image = picture(pair)
        blue.append((image[..., 2] > 0.5).mean())
    assert blue[0] > 0.9 and blue[1] == pytest.approx(0.5, abs=0.1) and blue[2] < 0.1


def test_turntable_plays(page):
    video = "document.getElementById('turntable')"
    if not page[0].evaluate(f"""{video}.canPlayType('video/mp4; codecs="avc1.64001f"')"""):
        pytest.skip("this Chromium was built without H.264: the turntable is not played")
    page[0].wait_for_function(f"{video}.readyState >= 2", timeout=20_000)
    assert page[0].evaluate(f"{video}.videoWidth") == SMALL.turntable_size


@pytest.mark.parametrize(
    "arguments, message",
    [
        (("{none}",), "is missing or no JSON; give the folder of a finished fit"),
        (("{fit}", "--views", "0"), "--views must be at least 1"),
        (("{fit}", "--turntable-size", "33"), "must be even"),
        (("{fit}", "--turntable-size", "10000000"), "GiB are free; lower its size or its samples"),
    ],
)
def test_mistakes(folder, tmp_path, capsys, arguments, message):
    assert main([argument.format(none=tmp_path / "none", fit=folder) for argument in arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and message in error and error.count("\n") == 1
