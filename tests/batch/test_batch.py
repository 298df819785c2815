"""Jobs by the file: what a line may say, what becomes of each, and what is done again."""

import json
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from gshell_mi.batch import work
from gshell_mi.batch.__main__ import main
from gshell_mi.batch.batch import _page, run_batch
from gshell_mi.batch.jobs import Job, read_jobs
from gshell_mi.batch.work import finished, run_job
from gshell_mi.errors import UserError
from gshell_mi.own_folder import OwnFolder


def write_jobs(path, *jobs):
    path.write_text("".join(json.dumps(job) + "\n" for job in jobs))
    return path


def wrong(name):
    """A job that ends at once, with a mistake in its input."""
    return {"name": name, "command": "turntable", "arguments": ["missing"]}


def test_lines_become_jobs(tmp_path):
    jobs = read_jobs(
        write_jobs(
            tmp_path / "jobs",
            {"command": "fit", "arguments": ["a.xml"], "cpus": 2},
            {"name": "b", "command": "export", "arguments": ["{out}/x"], "gpus": 0.5},
        )
    )
    assert jobs[0] == Job("000001-fit", "fit", ("a.xml",), cpus=2.0)
    assert jobs[0].filled_in("/o") == ["a.xml", "-o", "/o"]
    assert jobs[1].filled_in("/o") == ["/o/x"] and jobs[1].gpus == 0.5
    assert Job("c", "report", ("fit",)).filled_in("/o") == ["fit"]  # it has no -o


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("nonsense", r"line 1, is no JSON"),
        ("[1]", "line 1, is no JSON object"),
        ('{"command": "rm"}', "has no command of gshell_mi; choose one of capture, fit"),
        ('{"command": "fit", "shell": "x"}', "has 'shell', which means nothing"),
        ('{"command": "fit", "arguments": "x"}', "'arguments' must be a list of texts"),
        ('{"command": "fit", "name": "../x"}', "the name has a '/'"),
        ('{"command": "fit", "name": 3}', "the name is no text"),
        ('{"command": "fit", "cpus": -1}', "'cpus' must be a number that is not negative"),
        ("", "holds no jobs"),
        ('{"command": "fit", "name": "a"}\n{"command": "fit", "name": "a"}', "two jobs of the name 'a'"),
    ],
)
def test_mistakes_in_the_file_are_told(line, sentence, tmp_path):
    (tmp_path / "jobs").write_text(line)
    with pytest.raises(UserError, match=sentence):
        read_jobs(tmp_path / "jobs")


def test_a_job_leaves_its_files_and_what_became_of_it(tmp_path):
    found = run_job(Job("a", "turntable", ("missing",)), str(tmp_path))
    assert (found["status"], found["code"]) == ("wrong", 2)
    assert "missing" in found["told"] and "Traceback" not in found["told"]
    assert json.loads((tmp_path / "a" / "job.json").read_text()) == found


def test_results_go_to_any_storage_and_only_good_ends_count(tmp_path):
    pytest.importorskip("fsspec")
    job = Job("a", "turntable", ("missing",))
    run_job(job, f"file://{tmp_path}/there")
    told = json.loads((tmp_path / "there" / "a" / "job.json").read_text())
    assert told["status"] == "wrong"
    assert finished(f"file://{tmp_path}/there", [job]) == {}
    (tmp_path / "there" / "a" / "job.json").write_text(json.dumps(told | {"status": "done"}))
    assert set(finished(f"file://{tmp_path}/there", [job])) == {"a"}
    assert finished(f"file://{tmp_path}/there", [Job("a", "turntable", ("other",))]) == {}


@pytest.mark.parametrize(
    "spoilt",
    [
        {"seconds": "<b>"},
        {"seconds": None},
        {"told": 3},
        {"name": "b"},
        {"psnr": "high"},
        {"psnr": float("nan")},
    ],
)
def test_a_damaged_note_of_a_job_is_no_good_end(spoilt, tmp_path):
    pytest.importorskip("fsspec")
    job = Job("a", "turntable", ("missing",))
    good = {"name": "a", "job": ["turntable", "missing"], "status": "done"}
    good |= {"code": 0, "seconds": 1.0, "told": "", "psnr": 30.0}
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "job.json").write_text(json.dumps(good))
    assert finished(str(tmp_path), [job]) == {"a": good}
    (tmp_path / "a" / "job.json").write_text(json.dumps(good | spoilt))
    assert finished(str(tmp_path), [job]) == {}


def test_no_cell_of_the_page_is_taken_for_html():
    cells = ("name", "status", "psnr", "seconds", "told")
    assert "<b>" not in _page([dict.fromkeys(cells, "'<b>")])


class FakeFits:
    """Stands for the processes of fits: each leaves a checkpoint and is cut off."""

    def __init__(self):
        self.arguments: list[list[str]] = []

    def run(self, command, **_):
        self.arguments.append(command[3:])
        output = work._output(command)
        output.mkdir(parents=True, exist_ok=True)
        (output / "checkpoint.npz").touch()
        OwnFolder(output, "fit").write_mark({"checkpoint.npz"})
        return SimpleNamespace(returncode=1, stderr="")


@pytest.mark.parametrize("given", [(), ("-o", "{out}"), ("-o", "{out}/fit"), ("--output={out}/fit",)])
def test_a_fit_goes_on_wherever_it_writes_and_another_one_takes_its_place(given, tmp_path, monkeypatch):
    fits = FakeFits()
    monkeypatch.setattr(work, "subprocess", SimpleNamespace(run=fits.run, PIPE=None, DEVNULL=None))
    for scene in ("a.xml", "a.xml", "b.xml", "b.xml"):
        run_job(Job("a", "fit", (scene, *given)), str(tmp_path))
    assert [words[-1] for words in fits.arguments] == ["--overwrite", "--resume"] * 2


def test_a_fit_elsewhere_is_never_replaced(tmp_path, monkeypatch):
    fits = FakeFits()
    monkeypatch.setattr(work, "subprocess", SimpleNamespace(run=fits.run, PIPE=None, DEVNULL=None))
    given = ("a.xml", "--targets", "{out}", "-o", str(tmp_path / "mine"))
    run_job(Job("a", "fit", given), str(tmp_path / "jobs"))
    assert fits.arguments[0][-2:] == ["-o", str(tmp_path / "mine")]


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells a process of its parent's end")
def test_a_killed_worker_leaves_no_job_behind():
    script = (
        "import subprocess\nfrom gshell_mi.lifetime import end_with_parent\n"
        "job = subprocess.Popen(['sleep', '600'], preexec_fn=end_with_parent)\n"
        "print(job.pid, flush=True)\njob.wait()\n"
    )
    worker = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    job = int(worker.stdout.readline())
    assert _runs(job)
    worker.kill()
    worker.wait()
    until = time.monotonic() + 20
    while _runs(job) and time.monotonic() < until:
        time.sleep(0.1)
    assert not _runs(job)


def _runs(number: int) -> bool:
    try:
        state = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


class FakeRay:
    """Runs tasks when their results are asked for; the first tries of some jobs fail."""

    class exceptions:
        class RayError(Exception):
            pass

    def __init__(self, lost):
        self.lost, self.runs = dict(lost), []

    def init(self, **_):
        pass

    shutdown = init

    def remote(self, *, max_retries):
        assert max_retries == 0  # the batch counts tries itself

        class Task:
            def __init__(self, work):
                self.work = work

            def options(self, **_):
                return self

            def remote(self, job, results):
                return (self.work, job, results, object())

        return Task

    def wait(self, references, **_):
        return references[:1], references[1:]

    def get(self, reference):
        _, job, _, _ = reference
        self.runs.append(job.name)
        if self.lost.get(job.name, 0) > 0:
            self.lost[job.name] -= 1
            raise self.exceptions.RayError
        status = "wrong" if job.name == "bad" else "done"
        return {"name": job.name, "status": status, "code": 0, "seconds": 1.0, "told": "", "psnr": 20.0}


def test_lost_workers_cost_a_try_and_mistakes_none_and_neither_stops_the_rest(tmp_path, monkeypatch):
    ray = FakeRay({"b": 1, "never": 9})
    monkeypatch.setitem(sys.modules, "ray", ray)
    jobs = write_jobs(tmp_path / "jobs", *(wrong(name) for name in ("a", "b", "bad", "never", "c")))
    with pytest.raises(UserError, match="2 jobs of 5 failed, first 'bad'; see"):
        run_batch(jobs, tmp_path / "out", retries=2)
    assert {name: ray.runs.count(name) for name in ("a", "b", "bad", "never", "c")} == {
        "a": 1,
        "b": 2,
        "bad": 1,
        "never": 3,
        "c": 1,
    }
    rows = [json.loads(line) for line in (tmp_path / "out" / "results.jsonl").read_text().splitlines()]
    assert [row["name"] for row in rows] == ["bad", "never", "a", "b", "c"]  # the worst first
    page = (tmp_path / "out" / "results.html").read_text()
    assert page.index(">never<") < page.index(">a<")


def test_without_ray_it_is_told(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ray", None)
    assert main([str(write_jobs(tmp_path / "jobs", wrong("a"))), "-o", str(tmp_path / "out")]) == 2
    assert "This needs Ray; install it with pip install 'gshell_mi[ray]'" in capsys.readouterr().err


def test_a_cluster_that_does_not_start_is_told(tmp_path, monkeypatch, capsys):
    pytest.importorskip("fsspec")

    def init(address, **options):
        raise ValueError("no memory is left\nand more")

    ray = SimpleNamespace(init=init, shutdown=lambda: None)
    monkeypatch.setitem(sys.modules, "ray", ray)
    given = [str(write_jobs(tmp_path / "jobs", wrong("a"))), "-o", str(tmp_path / "out")]
    assert main(given) == 2
    assert "Ray cannot start on this machine (no memory is left); give it" in capsys.readouterr().err
    assert main([*given, "--address", "ray://none"]) == 2
    assert "There is no Ray cluster at 'ray://none' (ValueError)" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["{tmp}/no", "-o", "{tmp}/out"], "does not exist; check the path"),
        (["{tmp}/jobs"], "Nothing says where the results go"),
        (["{tmp}/jobs", "-o", "{tmp}/out", "--retries", "-1"], "--retries must not be negative"),
        (["{tmp}/jobs", "-o", "{tmp}/out", "--cpus", "0"], "--cpus must be at least 1"),
    ],
)
def test_mistakes_are_told(arguments, sentence, tmp_path, capsys):
    write_jobs(tmp_path / "jobs", wrong("a"))
    assert main([argument.replace("{tmp}", str(tmp_path)) for argument in arguments]) == 2
    assert sentence in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_on_a_cluster_of_this_machine_what_is_done_is_not_done_again(tmp_path):
    pytest.importorskip("ray")
    import trimesh

    (tmp_path / "in").mkdir()
    trimesh.creation.icosphere().export(tmp_path / "in" / "ball.ply")
    made = [
        {
            "name": f"set{i}",
            "command": "dataset",
            "arguments": [
                str(tmp_path / "in"),
                "--side",
                "16",
                "--max-chamfer",
                "5",
                "--quiet",
                "-o",
                "{out}",
            ],
        }
        for i in range(2)
    ]
    jobs = write_jobs(tmp_path / "jobs", *made, wrong("bad"))
    shards = [tmp_path / "out" / "jobs" / f"set{i}" / "out" / "shards" / "00000.npz" for i in range(2)]
    times = []
    for _ in range(2):
        with pytest.raises(UserError, match="1 job of 3 failed, first 'bad'"):
            run_batch(jobs, tmp_path / "out", cpus=1)
        times.append([shard.stat().st_mtime_ns for shard in shards])
    assert times[0] == times[1]
