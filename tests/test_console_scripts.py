"""The commands as the console scripts that pyproject.toml names."""

import signal
import sys
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from gshell_mi import streams

ROOT = Path(__file__).parents[1]
SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["scripts"]


def main_of(script: str):
    return EntryPoint(script, SCRIPTS[script], "console_scripts").load()


def test_every_runnable_package_has_one_of_its_name():
    packages = [path.parent.name for path in (ROOT / "gshell_mi").glob("*/__main__.py")]
    assert "fit" in packages
    expected = {f"gshell-{name}": f"gshell_mi.{name}.__main__:main" for name in packages}
    assert expected | {"gshell-doctor": "gshell_mi.doctor:main"} == SCRIPTS


@pytest.mark.parametrize("script", SCRIPTS)
def test_targets_take_their_arguments_from_the_process(script, monkeypatch, capsys):
    main = main_of(script)
    assert callable(main)
    monkeypatch.setattr(sys, "argv", [f"/usr/bin/{script}", "--help"])
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code == 0
    assert f"gshell_mi.{script.removeprefix('gshell-')}" in capsys.readouterr().out


@pytest.mark.parametrize("script", [name for name in SCRIPTS if name != "gshell-doctor"])
def test_targets_return_the_exit_code(script, variant, tmp_path, monkeypatch, capsys):
    missing = tmp_path / "missing"
    output = ["-o", str(tmp_path / "made.xml")] if script == "gshell-capture" else []
    renders = [] if script in ("gshell-train", "gshell-batch") else ["--variant", variant]
    monkeypatch.setattr(sys, "argv", [script, str(missing), *output, *renders])
    assert main_of(script)() == 2
    told = capsys.readouterr().err.splitlines()[-1]  # lines before it tell of progress, on a slow machine
    assert told.startswith("error: ") and str(missing) in told
    assert not any(tmp_path.iterdir())


def test_the_doctor_returns_the_exit_code(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["gshell-doctor", "--llvm"])
    main = main_of("gshell-doctor")
    assert main() == 0
    monkeypatch.setattr("gshell_mi.doctor._llvm_problem", lambda: "there is none: install one")
    assert main() == 2
    assert capsys.readouterr().err == "there is none: install one\n"


@pytest.mark.parametrize(
    ("started", "ours"),
    [
        ("/usr/bin/gshell-fit", True),
        ("gshell-report.exe", True),
        ("gshell-mine.py", False),
        ("/usr/bin/my-gshell-fit", False),
        ("/gshell-fit/run", False),
        ("", False),
    ],
)
def test_ctrl_c_ends_them_quietly_from_their_start_on(started, ours, monkeypatch):
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        monkeypatch.setattr(sys, "argv", [started])
        streams.begin_command()
        assert signal.getsignal(signal.SIGINT) is (streams.leave if ours else signal.default_int_handler)
    finally:
        signal.signal(signal.SIGINT, before)
