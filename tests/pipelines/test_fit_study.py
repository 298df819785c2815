"""The studies over many fits: rows of the ablation, settings as text, runs that go on, tables."""

import dataclasses
import json
import shutil
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
from bowl import CLOSED, SHORT, sensors_xml, write_scene

from gshell_mi import extras  # noqa: F401 registers losses
from gshell_mi.errors import UserError
from gshell_mi.evaluation.mesh_scores import mesh_scores
from gshell_mi.fit import FitConfig
from gshell_mi.fit.joint.regularisers import registered_losses

PIPELINES = Path(__file__).parents[2] / "pipelines"
sys.path.insert(0, str(PIPELINES))

import ablation  # noqa: E402
import score_scenes  # noqa: E402
from command_reference import field_texts  # noqa: E402
from fit_study import trials  # noqa: E402
from fit_study.ablation_rows import ROWS  # noqa: E402
from fit_study.settings import as_flags, non_default, parsed_settings  # noqa: E402
from fit_study.tables import stages_table, table  # noqa: E402
from fit_study.trials import Outcome, Trial, is_done, load_outcome, run_trial, run_trials  # noqa: E402

#: The options of a fit that is over at once, whose openings do not matter, as NAME=VALUE.
_OPTIONS = [*SHORT[:-1], *CLOSED[:-1], "--iterations", "2"]
QUICK = ["openings.revise=false"] + [
    f"{flag[2:].replace('-', '_')}={value}"
    for flag, value in dict(zip(_OPTIONS[::2], _OPTIONS[1::2], strict=True)).items()
]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = write_scene(tmp_path_factory.mktemp("study"))
    test = "\n".join(sensors_xml(views=2)).replace("view_", "test_")
    (path.with_suffix("") / "test.xml").write_text(f'<scene version="3.0.0">\n{test}\n</scene>\n')
    return path


@pytest.fixture(autouse=True)
def few_samples(monkeypatch):
    for user in ("gshell_mi.compare.compare", "fit_study.stage_scores"):
        monkeypatch.setattr(f"{user}.mesh_scores", partial(mesh_scores, samples=1000))


def outcome(config=None, **changes):
    counts = {name: {"found": 3, "reference": 2} for name in ("boundary_loops", "pinholes", "components")}
    mesh = {
        **counts,
        "nonmanifold_edges": {"found": 0, "reference": 0},
        "chamfer": 0.1234,
        "f_score": 0.9876,
        "boundary_length": {"found": 1.0, "reference": 2.0},
    }
    scores = {"mesh": mesh, "mean": {"psnr": 31.239, "mask_iou": 0.98765}}
    return Outcome(config or {}, scores, 123.4, 70.0, **{"code": "a"} | changes)


def test_every_row_changes_what_it_says_and_is_accepted():
    assert len({row.name for row in ROWS}) == len(ROWS)
    default = FitConfig()
    assert ROWS[0].config(default) == default
    for row in ROWS[1:]:
        changed = non_default(row.config(default))
        assert changed == row.changes, row.name


def test_the_rows_switch_every_loss():
    default = FitConfig()
    stages = {stage: config for stage, config in vars(default).items() if dataclasses.is_dataclass(config)}
    weights = {
        f"{stage}.{name}"
        for stage, config in stages.items()
        for name, text in field_texts(type(config)).items()
        if text.startswith(("Weight", "Final weight"))
    }
    settings = default.settings()
    switched = {
        name
        for row in ROWS
        for name, value in row.changes.items()
        if name in weights and (value == 0) == (settings[name] > 0)
    }
    # Those two need another grid, and depth maps.
    assert switched == weights - {"losses.flexicubes_deviation", "losses.depth"}
    extra = {name for row in ROWS for name in row.changes.get("losses.extra", {})}
    assert extra == set(registered_losses()) - set(vars(default.losses))


def test_settings_as_text():
    config = parsed_settings(
        ["resolution=48", "grid=bcc", "openings.mask=1", "losses.image=l1", "watertight=true"]
    )
    assert config == FitConfig(resolution=48, grid="bcc", watertight=True).changed(
        {"openings.mask": 1.0, "losses.image": "l1"}
    )
    assert as_flags(non_default(config)) == (
        "--resolution 48 --grid bcc --watertight --openings.mask 1 --losses.image l1"
    )


@pytest.mark.parametrize(
    ("pair", "complaint"),
    [
        ("resolution=fine", "'resolution' is a int, and 'fine' is none"),
        ("watertight=1", "'watertight' is a bool"),
        ("iterations", "'iterations' is a int"),
        ("sharpness=3", "no setting 'sharpness'"),
        ("iterations=-1", "--iterations must be at least 0"),
    ],
)
def test_settings_that_are_none(pair, complaint):
    with pytest.raises(UserError, match=complaint):
        parsed_settings([pair])


def test_table():
    rows = [("A", "first", outcome()), ("A", "second", None), ("B", "third", outcome(error="nothing in 'x'"))]
    lines = table(rows, "what").splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert len({len(row) for row in cells}) == 1, "as many cells in every line"
    first = dict(zip(cells[0], cells[3], strict=True))
    assert first == {
        "what": "first",
        "loops": "3 / 2",
        "pin-holes": "3",
        "components": "3 / 2",
        "non-manifold": "0",
        "rim": "0.50",
        "chamfer %": "0.123",
        "F-score": "0.988",
        "novel dB": "31.24",
        "mask IoU": "0.9877",
        "CPU s": "123",
    }
    assert [row[0] for row in cells[2:]] == ["**A**", "first", "**B**", "third"]
    assert cells[-1][1] == "failed: nothing"
    mixed = table([("A", "first", outcome()), ("A", "second", outcome(code="b"))], "what").splitlines()
    assert mixed[4].startswith("| second † |") and mixed[-1].startswith("† Fitted with another version")


def test_table_of_stages():
    moved = outcome().scores["mesh"]
    stages = {"occlusion": {}, "hull": moved, "light": moved, "joint": moved | {"chamfer": 0.05}}
    kept = {stage: {"seconds": 2.4, "mesh": mesh} for stage, mesh in stages.items()}
    rows = [line.strip("| ").split(" | ") for line in stages_table(outcome(stages=kept)).splitlines()]
    assert rows[0] == ["after", "s", "loops", "pin-holes", "components", "rim", "chamfer %", "F-score"]
    assert rows[2][:2] == ["*occlusion*", "2"] and not "".join(rows[2][2:]).strip("| ")
    assert rows[3][2:] == ["3 / 2", "3", "3 / 2", "0.50", "0.123", "0.988"]
    assert rows[4][2] == "same" and rows[5][6] == "0.050"
    assert stages_table(outcome()) == ""


def test_only_the_same_settings_count(tmp_path):
    trial = Trial(Path("shirt.xml"), "default", FitConfig())
    assert load_outcome(trial, tmp_path) is None
    plain = json.loads(json.dumps(dataclasses.asdict(trial.config)))
    trial.record(tmp_path).parent.mkdir()
    trial.record(tmp_path).write_text(json.dumps(dataclasses.asdict(outcome(plain))))
    assert load_outcome(trial, tmp_path).scores["mean"]["psnr"] == 31.239 and is_done(trial, tmp_path)
    assert load_outcome(Trial(trial.scene, "default", FitConfig(seed=1)), tmp_path) is None
    trial.record(tmp_path).write_text(json.dumps(dataclasses.asdict(outcome(plain, error="no"))))
    assert load_outcome(trial, tmp_path).error == "no" and not is_done(trial, tmp_path), "it is tried again"
    trial.record(tmp_path).write_text("{")
    assert load_outcome(trial, tmp_path) is None


def test_fits_scores_and_does_neither_twice(scene, tmp_path, capsys, monkeypatch):
    options = [
        str(scene),
        "--rows",
        "default",
        "no-mask",
        "--set",
        *QUICK,
        "-o",
        str(tmp_path / "fits"),
        "--page",
        str(tmp_path / "page.md"),
    ]
    assert ablation.main(options) == 0
    told = capsys.readouterr().out.splitlines()
    assert told[0] == "2 fits, 0 of them exist already."
    assert told[1].startswith("1/2 bowl, default: loops ") and "left]" in told[1]
    assert told[2].startswith("2/2 bowl, no-mask: ") and "about 0:00:00 left" in told[2]
    page = (tmp_path / "page.md").read_text()
    assert "## bowl" in page and "| mask `--losses.mask 0` |" in page
    assert "`--resolution" not in page and "--iterations 2" in page, "shared settings are named"
    assert "`--poses keep`" not in page, "only what was measured"
    assert "| *openings* |" in page and "| *joint* |" in page, "what the stages have left"

    monkeypatch.setattr(trials, "fit_scene", None)
    assert ablation.main(options) == 0
    assert capsys.readouterr().out.splitlines()[0] == "2 fits, 2 of them exist already."
    assert (tmp_path / "page.md").read_text() == page


def test_an_interrupted_fit_goes_on(scene, tmp_path, monkeypatch):
    trial = Trial(scene, "default", parsed_settings(QUICK))

    def interrupted(*args, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(trials, "compare_fit", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_trial(trial, tmp_path)
    assert load_outcome(trial, tmp_path) is None
    before = (tmp_path / "bowl" / "default" / "log.jsonl").read_text()
    monkeypatch.undo()
    found = run_trial(trial, tmp_path)
    assert found.error is None and found.cpu_seconds is None and found.wall_seconds > 0
    assert (tmp_path / "bowl" / "default" / "log.jsonl").read_text() == before, "no step was done again"


def test_a_fit_that_fails_is_told(scene, tmp_path, monkeypatch, capsys):
    def failing(*args, **options):
        raise UserError("There is nothing opaque.")

    monkeypatch.setattr(trials, "fit_scene", failing)
    ((_, found),) = run_trials([Trial(scene, "default", FitConfig())], tmp_path)
    assert found.error == "There is nothing opaque."
    assert "default: failed: There is nothing opaque." in capsys.readouterr().out


def test_truth_may_lie_elsewhere(scene, tmp_path, monkeypatch):
    truth, bare = tmp_path / "truth", tmp_path / "bare.xml"
    shutil.copytree(scene.with_suffix(""), truth)
    shutil.copyfile(scene, bare)
    (truth / "test").mkdir()
    for number in range(2):
        (truth / "test" / f"test_{number:03}.exr").touch()
    called, fitted = {}, SimpleNamespace(metrics={"seconds": {"total": 1.0}})
    monkeypatch.setattr(trials, "fit_scene", lambda *_, **__: fitted)
    monkeypatch.setattr(trials, "compare_fit", lambda _, **given: called.update(given) or outcome().scores)
    found = run_trial(Trial(bare, "default", FitConfig(), truth=truth), tmp_path / "fits")
    assert found.error is None and found.scores["mesh"]["chamfer"] == 0.1234
    assert called == {"targets": truth / "test", "sensors": truth / "test.xml", "mesh": truth / "truth.ply"}
    assert not bare.with_suffix("").exists(), "targets are what the scene has, not what the truth could give"


def test_scene_without_truth(tmp_path, capsys):
    path = write_scene(tmp_path)
    options = ["--page", str(tmp_path / "page.md"), "-o", str(tmp_path / "fits")]
    assert score_scenes.main([str(path), *options]) == 2
    assert "test.xml' is missing; a scene of a study needs it to be scored" in capsys.readouterr().err
    assert score_scenes.main([str(path), *options, "--page-only"]) == 0
    assert "Not measured: bowl." in (tmp_path / "page.md").read_text()
