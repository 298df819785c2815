import os
import re
import subprocess
import sys

import mitsuba as mi
import numpy as np
import pytest

from gshell_mi import UserError, doctor
from gshell_mi.doctor import Diagnosis, diagnose, ensure_variant


def run(*args, **env):
    """The command in a process of its own: Dr.Jit looks for LLVM once per process."""
    command = [sys.executable, "-m", "gshell_mi.doctor", *args]
    return subprocess.run(command, capture_output=True, text=True, env=os.environ | env)


def test_this_machine_is_ready():
    found = diagnose()
    assert isinstance(found, Diagnosis)
    assert found.problems == ()
    assert "llvm_ad_rgb" in found.variants
    assert found.llvm_version >= (doctor.MINIMUM_LLVM, 0, 0)
    assert found.llvm_path is None or found.llvm_path.exists()
    assert found.threads >= 1
    assert found.packages["mitsuba"] == mi.__version__
    assert found.render_seconds > 0
    assert str(found).endswith("Ready.")


def test_diagnosis_leaves_the_variant_alone(variant):
    diagnose(self_test=False)
    assert mi.variant() == variant


def test_missing_llvm_is_one_sentence_and_exit_code_2(tmp_path):
    nonsense = str(tmp_path / "libLLVM.so")
    result = run("--llvm", DRJIT_LIBLLVM_PATH=nonsense)
    assert result.returncode == 2
    sentence = result.stderr.strip().splitlines()[-1]
    assert nonsense in sentence and "correct the path or unset" in sentence
    assert "Traceback" not in result.stderr


def test_missing_llvm_stops_ensure_variant(tmp_path):
    code = (
        "from gshell_mi.doctor import ensure_variant\nfrom gshell_mi import UserError\n"
        "try:\n    ensure_variant('llvm_ad_rgb')\nexcept UserError as e:\n    print('told:', e)"
    )
    env = os.environ | {"DRJIT_LIBLLVM_PATH": str(tmp_path / "libLLVM.so")}
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env)
    assert "told: DRJIT_LIBLLVM_PATH is set to" in result.stdout


def test_no_llvm_at_all(monkeypatch):
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    monkeypatch.setattr(doctor, "_llvm_version", lambda: None)
    found = diagnose()
    assert found.render_seconds is None
    assert "apt-get install libllvm19" in found.problems[0]
    assert "LLVM       not found" in str(found)


def test_old_llvm_is_refused_before_it_aborts(monkeypatch):
    monkeypatch.setattr(doctor, "MINIMUM_LLVM", 17)
    monkeypatch.setattr(doctor, "_NAN_MINIMUM", True)
    monkeypatch.setattr(doctor, "_llvm_version", lambda: (15, 0, 6))
    with pytest.raises(UserError, match=r"LLVM 15 at .* is too old .* `pip install mitsuba==3.9.0`"):
        ensure_variant("llvm_ad_rgb")


@pytest.mark.parametrize(
    ("answer", "problem"),
    [
        ("import sys; sys.exit('LLVM ERROR: no luck')", r"render failed \(LLVM ERROR: no luck\): install"),
        ("1 / 0", r"failed \(ZeroDivisionError: division by zero\): `python"),
        ("import os; os.kill(os.getpid(), 9)", r"failed \(exit code -9\)"),
        ('print(\'{"value": 0.3, "seconds": 1}\')', "rendered 0.300 where 0.5 is right"),
    ],
)
def test_a_failing_self_test_is_told(monkeypatch, answer, problem):
    true_run = subprocess.run
    monkeypatch.setattr(subprocess, "run", lambda cmd, **kw: true_run([sys.executable, "-c", answer], **kw))
    (told,) = diagnose().problems
    assert re.search(problem, told)


def test_ensure_variant(variant):
    ensure_variant(variant)
    assert mi.variant() == variant
    with pytest.raises(UserError, match="variant 'scalar_rgb' is not usable: choose llvm_ad_rgb"):
        ensure_variant("scalar_rgb")
    if not diagnose(self_test=False).cuda:
        with pytest.raises(UserError, match="needs an NVIDIA GPU"):
            ensure_variant("cuda_ad_rgb")
    assert mi.variant() == variant


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="no way to hold a process to one core")
def test_one_core_is_enough_to_read_an_image(tmp_path):
    """Mitsuba reads EXR files in tasks of their own, and waits for them."""
    image = tmp_path / "light.exr"
    mi.Bitmap(np.ones((4, 8, 3), np.float32)).write(str(image))
    code = f"""
import os
os.sched_setaffinity(0, {{min(os.sched_getaffinity(0))}})
import mitsuba as mi
from gshell_mi.doctor import ensure_variant
ensure_variant("llvm_ad_rgb")
print(mi.load_dict({{"type": "envmap", "filename": {str(image)!r}}}))
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert "EnvironmentMapEmitter" in result.stdout


def test_report(capsys):
    assert doctor.main([]) == 0
    report = capsys.readouterr().out
    for word in (
        "Python",
        "mitsuba",
        "drjit",
        "variants",
        "LLVM",
        "threads",
        "memory",
        "GPU",
        "self-test",
        "passed",
    ):
        assert word in report
