"""docs/commands.md says what the commands do."""

import importlib.util
from pathlib import Path

SCRIPT = Path(__file__).parents[2] / "pipelines" / "command_reference.py"


def load():
    spec = importlib.util.spec_from_file_location("command_reference", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_page_is_current():
    module = load()
    assert module.PAGE.read_text() == module.reference(), "run `python pipelines/command_reference.py`"


def test_every_command_and_argument_is_there():
    text = load().reference()
    for argument in (
        "SCENE",
        "-o, --output",
        "--no-report",
        "--openings.mask",
        "--envmap",
        "--remesh",
        "--up",
    ):
        assert f"| `{argument}` |" in text
    assert "| `--seed` | `0` | Seed of every random number of the fit. |" in text
