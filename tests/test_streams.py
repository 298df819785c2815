"""Commands whose output goes nowhere, and Ctrl-C at any moment from their start on."""

import io
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from gshell_mi import UserError
from gshell_mi.streams import Forgiving, with_streams

FULL = Path("/dev/full")


def run(*arguments: str, **streams) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", *arguments]
    return subprocess.run(command, text=True, timeout=120, **streams)


def closed_pipe() -> int:
    """The end of a pipe that nobody reads."""
    reading, writing = os.pipe()
    os.close(reading)
    return writing


# --- output


def test_a_reader_that_has_left_is_no_error():
    found = run("gshell_mi.doctor", "--llvm", stdout=closed_pipe(), stderr=subprocess.PIPE)
    assert (found.returncode, found.stderr) == (0, "")
    found = run("gshell_mi.doctor", stdout=closed_pipe(), stderr=subprocess.PIPE)
    assert (found.returncode, found.stderr) == (0, "")


@pytest.mark.skipif(not FULL.exists(), reason="needs a device that is always full")
def test_output_that_cannot_be_written_is_told():
    with open(FULL, "w") as full:
        found = run("gshell_mi.doctor", stdout=full, stderr=subprocess.PIPE)
    assert found.returncode == 2
    assert found.stderr == (
        "error: What was found cannot be printed (No space left on device), though all "
        "files are written; print it to another place.\n"
    )


@pytest.mark.skipif(not FULL.exists(), reason="needs a device that is always full")
def test_help_and_mistakes_on_a_full_device():
    with open(FULL, "w") as full:
        found = run("gshell_mi.fit", "none.xml", stdout=full, stderr=full)
        assert found.returncode == 2
        assert run("gshell_mi.fit", "--help", stdout=full, stderr=subprocess.PIPE).stderr == ""


def test_closed_streams():
    """Nothing is printed into the first file that is opened."""
    code = "import os; os.close(0); os.close(1); os.close(2); os.execv(sys.executable, [sys.executable, *{}])"
    arguments = ["-m", "gshell_mi.fit", "none.xml"]
    found = subprocess.run([sys.executable, "-c", "import sys; " + code.format(arguments)], timeout=120)
    assert found.returncode == 2


def test_errors_become_sentences(capsys):
    def raising(error):
        def work():
            raise error

        return work

    assert with_streams(lambda: 0) == 0 and with_streams(lambda: 130) == 130
    assert with_streams(raising(UserError("It is too small; enlarge it."))) == 2
    assert capsys.readouterr().err == "error: It is too small; enlarge it.\n"
    assert with_streams(raising(PermissionError(13, "Permission denied", "/root/a.xml"))) == 2
    assert capsys.readouterr().err == (
        "error: '/root/a.xml' cannot be read or written (Permission denied); "
        "check the path, its permissions and the free space.\n"
    )
    with pytest.raises(KeyError):
        with_streams(raising(KeyError("a fault of ours keeps its traceback")))


def test_a_forgiving_stream_keeps_what_happened():
    class Broken(io.StringIO):
        def write(self, text):
            raise BrokenPipeError

    stream = Forgiving(Broken())
    print("a", "b", file=stream, flush=True)
    print("c", file=stream)
    assert isinstance(stream.error, BrokenPipeError)
    print("nothing", file=Forgiving(None))


# --- Ctrl-C


def interrupted(command: list[str], seconds: float) -> tuple[int, str]:
    """Exit code and stderr of a command that gets a SIGINT after so many seconds."""
    process = subprocess.Popen(
        [sys.executable, "-m", *command],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    time.sleep(seconds)
    process.send_signal(signal.SIGINT)
    _, told = process.communicate(timeout=120)
    return process.returncode, told


@pytest.fixture(scope="module")
def loading() -> float:
    """Seconds that a command needs to load its modules."""
    begin = time.monotonic()
    subprocess.run([sys.executable, "-c", "import gshell_mi.fit.api"], check=True)
    return time.monotonic() - begin


@pytest.mark.parametrize("share", [0.4, 0.6, 0.8, 1.0, 1.2, 1.5, 2.0, 3.0])
def test_it_works_from_the_first_second_on(bowl_scene, tmp_path, loading, share):
    """At whatever moment: while modules load, while the scene loads, in the fit."""
    options = ["--openings.iterations", "100000", "--radiance.batch", "256"]
    code, told = interrupted(
        ["gshell_mi.fit", str(bowl_scene), "-o", str(tmp_path / "out"), *options], share * loading
    )
    assert code == 130, told
    assert "Traceback" not in told and "Interrupted" in told


INTERRUPTED_IN_CODE_THAT_C_RUNS = """
import ctypes, sys
from dataclasses import dataclass
from gshell_mi.command_line import run_command

@dataclass
class Arguments:
    number: int = 0

def work(given):
    run = ctypes.pythonapi.PyRun_String
    run.restype, run.argtypes = ctypes.py_object, [ctypes.c_char_p, ctypes.c_int, *[ctypes.py_object] * 2]
    run(b"raise KeyboardInterrupt", 257, {}, {})  # 257: statements

sys.exit(run_command("fit", "Interrupted.", Arguments, work, []))
"""


def test_the_exit_code_is_ours_where_c_was_running_python(tmp_path):
    (tmp_path / "interrupted.py").write_text(INTERRUPTED_IN_CODE_THAT_C_RUNS)
    found = run(
        "interrupted", stderr=subprocess.PIPE, cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(Path.cwd())}
    )
    assert (found.returncode, found.stderr) == (130, "Interrupted.\n")


INTERRUPT_WHEN_DRJIT_LOADS = """
import os, signal, sys

class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == "drjit":
            sys.meta_path.remove(self)
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupting())
"""


@pytest.mark.parametrize("command", ["capture", "export", "turntable", "report", "compare", "doctor"])
def test_every_command_stops_while_it_loads(command, tmp_path):
    (tmp_path / "sitecustomize.py").write_text(INTERRUPT_WHEN_DRJIT_LOADS)
    paths = [str(tmp_path), str(Path.cwd()), os.environ.get("PYTHONPATH", "")]
    found = run(
        f"gshell_mi.{command}",
        str(tmp_path),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    assert (found.returncode, found.stderr) == (130, "Interrupted.\n")
