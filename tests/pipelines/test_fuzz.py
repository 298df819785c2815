"""A short run of the fuzzing, and that it would notice what it looks for."""

import os
import subprocess
import sys
from pathlib import Path
from random import Random

import pytest

from gshell_mi.errors import UserError

sys.path.insert(0, str(Path(__file__).parents[2] / "pipelines"))
import fuzz
from fuzzing import targets
from fuzzing.mutators import damage_file

#: A few of each; some hundred inputs in ten seconds.
QUICK = {
    "nerf": 12,
    "colmap_text": 12,
    "llff": 12,
    "images": 8,
    "scene": 6,
    "mesh_ply": 8,
    "mesh_obj": 8,
    "scores": 12,
    "fields": 40,
    "block_fields": 20,
    "light": 12,
    "masks": 8,
    "known": 8,
    "video_mp4": 6,
    "compare": 8,
    "export": 6,
}


@pytest.mark.parametrize("name", QUICK)
def test_damaged_inputs_are_read_or_refused(name, tmp_path):
    targets.TARGETS[name].prepare(tmp_path / "inputs")
    outcomes = [fuzz.attempt(name, tmp_path / "inputs", 1, number) for number in range(QUICK[name])]
    assert set(outcomes) <= {"ok", "refused"}


def target(attempt):
    return targets.Target(lambda folder: (folder / "a.txt").write_text("1 2 3\n"), attempt, "a.txt")


def refuse(folder):
    raise UserError("It is damaged.")


def leave(folder):
    (folder / ".a.partial").write_text("half")
    refuse(folder)


def cut_short(folder):
    (folder / "out").mkdir()
    (folder / "out" / ".mesh.partial").write_text("half")


def stray(folder):
    (folder.parent / "b.txt").write_text("elsewhere")


def first_well(then):
    """Reads the good input, and does something else with damaged ones."""
    return lambda folder: None if folder.name == "good" else then(folder)


@pytest.mark.parametrize(
    "attempt, outcome",
    [
        (lambda folder: None, "ok"),
        (refuse, "refused"),
        (lambda folder: 1 / 0, "failed ZeroDivisionError"),
        (leave, "failed Broken: left behind after a refusal"),
        (stray, "failed Broken: written outside"),
        (cut_short, "failed Broken: half-written"),
    ],
)
def test_what_counts_as_a_failure(attempt, outcome, tmp_path, monkeypatch):
    monkeypatch.setitem(targets.TARGETS, "one", target(first_well(attempt)))
    targets.TARGETS["one"].prepare(tmp_path / "inputs")
    assert fuzz.attempt("one", tmp_path / "inputs", 0, 0).startswith(outcome)


def test_crashes_and_hangs_are_seen():
    """A worker that dies and one that stops, in place of the real ones."""
    findings = fuzz.Findings()

    def worker(program):
        reading, writing = os.pipe()
        program = "import os, signal, time; " + program.format(writing)
        process = subprocess.Popen([sys.executable, "-c", program], pass_fds=[writing])
        os.close(writing)
        return process, reading

    process, reading = worker(r"os.write({}, b'ready\nok\nrefused\n'); os.kill(os.getpid(), signal.SIGSEGV)")
    with open(os.devnull, "rb") as said:
        following, _ = fuzz._watch(process, reading, "a", 0, 60.0, findings, said, 1.0)
    process, reading = worker(r"os.write({}, b'ready\nok\n'); time.sleep(60)")
    with open(os.devnull, "rb") as said:
        fuzz._watch(process, reading, "b", 0, 60.0, findings, said, 1.0)
    process.kill()
    process.wait()
    assert following == 3
    assert findings.failures == ["a:2 ends the process with -11 (nothing said)", "b:1 takes more than 1 s"]
    assert findings.outcomes == {"a ok": 1, "a refused": 1, "b ok": 1}
    assert {kind: count for kind, count in findings.counts().items() if count} == {"crashes": 1, "hangs": 1}


def test_much_of_the_processors_is_a_hang(tmp_path, monkeypatch):
    """Though the clock's limit is longer, as it is on a busy machine."""

    def work_hard(folder):
        while fuzz._processor_seconds() < end:
            sum(range(10_000))

    monkeypatch.setattr(fuzz, "LIMIT", 0.3)
    monkeypatch.setitem(targets.TARGETS, "one", target(first_well(work_hard)))
    end = fuzz._processor_seconds() + 0.6
    reading, writing = os.pipe()
    fuzz.work(writing, "one", 0, 0, 1, tmp_path)
    assert os.read(reading, 100) == b"ready\nfailed takes 1 s of the processors\n"
    os.close(reading)
    os.close(writing)


@pytest.mark.parametrize(
    "name, content",
    [
        ("a.json", b'{"a": [1, {"b": "c"}], "d": 2.5}'),
        ("a.xml", b'<scene version="3.0.0"><a b="1"/></scene>'),
        ("a.txt", b"1 2 3\n4 5 6\n"),
        ("a.bin", bytes(range(256))),
    ],
)
def test_damage_is_done_and_can_be_had_again(name, content, tmp_path):
    results = []
    for seed in [*range(20), *range(20)]:
        (tmp_path / name).write_bytes(content)
        damage_file(tmp_path / name, Random(seed))
        results.append((tmp_path / name).read_bytes())
    assert results[:20] == results[20:]
    assert sum(result != content for result in results[:20]) > 15
