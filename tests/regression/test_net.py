"""The regression net itself: bands, stored results, the table. The fits are in fits.py."""

import dataclasses

import cases
import net as net_module
import pytest
from cases import CASES, SMALL, Case, write_small_scene
from fit_study.expectations import FIGURES, Expectation, difference
from fit_study.trials import Outcome, Trial, code_version
from net import Net

from gshell_mi.errors import UserError
from gshell_mi.fit import FitConfig
from gshell_mi.scene_files import load_scene


def scores(*, loops=2, pinholes=0, rim=1.0, chamfer=0.2, psnr=30.0, true_loops=2):
    def count(found, reference):
        return {"found": found, "reference": reference}

    return {
        "mesh": {
            "boundary_loops": count(loops, true_loops),
            "pinholes": count(pinholes, 0),
            "components": count(1, 1),
            "nonmanifold_edges": count(0, 0),
            "boundary_length": count(rim * 3.0, 3.0 if true_loops else 0.0),
            "chamfer": chamfer,
            "f_score": 0.9,
        },
        "mean": {"psnr": psnr, "mask_iou": 0.98},
    }


@pytest.fixture
def case(tmp_path, monkeypatch):
    """A case whose expectation lies in the test's folder."""
    monkeypatch.setattr(cases, "EXPECTED", tmp_path / "expected")
    return Case("shirt", lambda folder: Trial(tmp_path / "shirt.xml", "default", FitConfig()))


@pytest.fixture
def found(monkeypatch):
    """Stands in for the fits: what the next one comes to, and how many there were."""

    class Found:
        outcome = Outcome({}, scores(), 100.0, 60.0, "abc")
        fits = 0

    def run_trial(trial, output):
        Found.fits += 1
        return Found.outcome

    monkeypatch.setattr(net_module, "run_trial", run_trial)
    return Found


def changed(outcome, **change):
    return dataclasses.replace(outcome, scores=scores(**change))


def test_every_case_has_its_file_and_every_file_its_case():
    assert {path.name for path in cases.EXPECTED.iterdir()} == {case.expected.name for case in CASES}
    stock = {path.stem for path in cases.SCENES.glob("*.xml")}
    assert len(stock) == 10 and stock <= {case.name for case in CASES}
    assert sum(case.name.startswith("photographed_") for case in CASES) == 3


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_stored_numbers_lie_in_their_bands(case):
    expectation = Expectation.load(case.expected)
    for name, (stored, (least, most)) in expectation.figures.items():
        assert least is not None or most is not None, name
        assert (least is None or least <= stored) and (most is None or stored <= most), name
    if expectation.measured:
        assert set(FIGURES) - {"rim"} <= set(expectation.figures)


@pytest.mark.parametrize(
    ("change", "title", "sentence"),
    [
        ({"loops": 3}, "loops", "loops is 3, 1 above its band, which ends at 2"),
        ({"loops": 1}, "loops", "loops is 1, 1 below its band, which ends at 2"),
        ({"pinholes": 4}, "pin-holes", "pin-holes is 4, 4 above its band, which ends at 0"),
        ({"rim": 1.05}, "rim", "rim is 1.05, 0.02 above its band, which ends at 1.03"),
        ({"chamfer": 0.25}, "chamfer %", "chamfer % is 0.250, 0.030 above its band, which ends at 0.220"),
        ({"psnr": 29.0}, "novel dB", "novel dB is 29.00, 0.40 below its band, which ends at 29.40"),
    ],
)
def test_what_is_worse_leaves_its_band(change, title, sentence):
    expectation = Expectation.of(scores(), "abc")
    left = expectation.left(scores(**change))
    assert {FIGURES[name].title: text for name, text in left.items()} == {title: sentence}


def test_what_is_better_or_noise_does_not():
    expectation = Expectation.of(scores(loops=4, rim=1.4), "abc")
    assert not expectation.left(scores(loops=2, rim=1.0, chamfer=0.1, psnr=40.0))
    assert not expectation.left(scores(loops=4, rim=1.42, chamfer=0.21, psnr=29.7))
    assert expectation.left(scores(loops=5, rim=1.4)).keys() == {"boundary_loops"}


def test_a_closed_truth_has_no_rim():
    expectation = Expectation.of(scores(loops=0, rim=0.0, true_loops=0), "abc")
    assert "rim" not in expectation.figures
    assert expectation.left(scores(loops=1, rim=1.0, true_loops=0)).keys() == {"boundary_loops"}


def test_expectations_come_back(tmp_path):
    for expectation in (Expectation.of(scores(), "abc"), Expectation(None, {})):
        expectation.save(tmp_path / "case.json")
        assert Expectation.load(tmp_path / "case.json") == expectation
    assert difference(Expectation(None, {}), Expectation.of(scores(), "abc"))[0] == "loops: - → 2"
    assert difference(Expectation.of(scores(), "a"), Expectation.of(scores(chamfer=0.3), "b")) == [
        "chamfer %: 0.200 → 0.300"
    ]


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[]",
        "{}",
        '{"measured": true, "fitted_by": null, "figures": {}}',
        '{"measured": true, "fitted_by": null, "figures": {"beauty": {"stored": 1, "least": 0, "most": 2}}}',
        '{"measured": true, "fitted_by": null, "figures": {"chamfer": {"stored": 1}}}',
    ],
)
def test_damaged_expectations_are_told(tmp_path, text):
    (tmp_path / "case.json").write_text(text)
    with pytest.raises(UserError, match=r"case.json'.* make regress ARGS=--update"):
        Expectation.load(tmp_path / "case.json")


def test_without_a_stored_result_it_skips_and_fits_nothing(case, found, tmp_path):
    Expectation(None, {}).save(case.expected)
    with pytest.raises(pytest.skip.Exception, match="no stored result yet: run make regress ARGS=--update"):
        Net(tmp_path / "out").run(case)
    assert found.fits == 0


def test_update_then_hold_then_fail(case, found, tmp_path, capsys):
    Expectation(None, {}).save(case.expected)
    Net(tmp_path / "out", update=True).run(case)
    assert "shirt: loops: - → 2; pin-holes: - → 0;" in capsys.readouterr().out
    assert Expectation.load(case.expected) == Expectation.of(scores(), "abc")

    net = Net(tmp_path / "out")
    net.run(case)
    found.outcome = changed(found.outcome, chamfer=0.3, loops=1)
    with pytest.raises(pytest.fail.Exception) as told:
        net.run(case)
    assert str(told.value).splitlines()[1:3] == [
        "loops is 1, 1 below its band, which ends at 2",
        "chamfer % is 0.300, 0.080 above its band, which ends at 0.220",
    ]

    lines = net.table.read_text().splitlines()
    assert [line[:3] for line in lines if line.startswith("##")] == ["## ", "## "], "a heading per run"
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line[:3] == "| s"]
    assert [row[-1] for row in rows] == ["stored", "held", "**left its band: loops, chamfer %**"]
    assert rows[0][1] == "- → 2" and rows[1][1] == "2" and rows[2][1] == "**2 → 1**"
    assert len({len(row) for row in rows}) == 1


def test_a_fit_without_a_surface_fails(case, found, tmp_path):
    Expectation.of(scores(), "abc").save(case.expected)
    found.outcome = Outcome({}, {}, None, 0.0, "abc", error="Nothing is opaque.")
    with pytest.raises(pytest.fail.Exception, match="shirt has no surface to score: Nothing is opaque"):
        Net(tmp_path / "out").run(case)
    assert "**failed**: Nothing is opaque." in (tmp_path / "out" / "table.md").read_text()


def test_fits_of_this_version_are_kept_unless_fresh(case, found, tmp_path):
    Expectation.of(scores(), "abc").save(case.expected)
    inside = tmp_path / "out" / code_version() / "shirt"
    (inside / "default").mkdir(parents=True)
    (inside / "default.json").touch()
    Net(tmp_path / "out").run(case)
    assert sorted(path.name for path in inside.iterdir()) == ["default", "default.json"]
    Net(tmp_path / "out", fresh=True).run(case)
    assert not list(inside.iterdir())


def test_small_scene_has_fewer_and_smaller_views_of_the_same_truth(tmp_path):
    scene = write_small_scene(cases.SCENES / "leaf.xml", tmp_path, every=8, size=32)
    stock = load_scene(cases.SCENES / "leaf.xml").sensors()
    small = load_scene(scene).sensors()
    assert [sensor.id() for sensor in small] == [sensor.id() for sensor in stock][::8]
    assert {tuple(sensor.film().crop_size()) for sensor in small} == {(32, 32)}
    assert [sensor.id() for sensor in load_scene(tmp_path / "small_leaf" / "reference.xml").sensors()] == [
        sensor.id() for sensor in small
    ]
    assert (tmp_path / "small_leaf" / "truth.ply").read_bytes() == (
        cases.SCENES / "leaf" / "truth.ply"
    ).read_bytes()
    trial = SMALL.prepare(tmp_path / "again")
    assert trial.config == FitConfig.for_effort("preview") and trial.scene.stem == SMALL.name


def test_captures_are_made_once_and_scored_by_their_truth(tmp_path, monkeypatch):
    made = []

    def write_photographs(what, place):
        made.append(what)
        (place / "capture").mkdir(parents=True)

    monkeypatch.setattr(cases, "write_photographs", write_photographs)
    monkeypatch.setattr(cases, "import_capture", lambda source, scene: scene.touch())
    photographed = [case for case in CASES if case.name.startswith("photographed_")]
    for _ in range(2):
        for case in photographed:
            trial = case.prepare(tmp_path)
            assert trial.scene.is_file() and trial.scene.stem == case.name
            assert trial.config == FitConfig() and trial.truth == trial.scene.parent / "truth"
    assert len(made) == len(photographed)
    assert all(what.faults.pose_degrees and what.faults.stand and what.faults.jpeg for what in made)
