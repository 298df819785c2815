"""Tries damaged inputs of every kind; ``python pipelines/fuzz.py --minutes 10`` or ``make fuzz``.

Each must be read or refused in a sentence: no traceback, no crash, no more than ten seconds, no file outside
of the output, nothing half-written. What fails can be had again with ``--only TARGET:NUMBER`` and its seed.
"""

from __future__ import annotations

import argparse
import os
import re
import selectors
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "pipelines")]

#: Seconds that an input may take, of the clock and of the processors, and that a worker may take to start and
#: to write good inputs.
LIMIT, START = 10.0, 300.0

#: What failures are, by a word in their line; what has none of these is an exception that nobody caught.
KINDS = {
    "ends the process": "crashes",
    "takes ": "hangs",
    "outside of the output": "files outside",
    "left behind": "half-written files",
    "half-written": "half-written files",
    "": "tracebacks",
}


@dataclass
class Findings:
    """What became of the inputs.

    Attributes:
        outcomes: how often each target gave "ok" or "refused".
        failures: a line each, with the input's name first.
    """

    outcomes: Counter = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)

    def kinds(self) -> list[str]:
        """One failure of each kind, with how many there are."""
        kinds: dict[str, list[str]] = {}
        for failure in self.failures:
            kinds.setdefault(re.sub(r"\d+", "", failure), []).append(failure)
        return [f"{same[0]} ({len(same)} of the kind)" for same in kinds.values()]

    def counts(self) -> Counter:
        """How many failures there are of each of ``KINDS``."""
        found = Counter(dict.fromkeys(KINDS.values(), 0))
        for failure in self.failures:
            found[next(kind for word, kind in KINDS.items() if word in failure)] += 1
        return found

    @property
    def tried(self) -> int:
        return sum(self.outcomes.values()) + len(self.failures)


def fuzz(
    targets: list[str], seconds: float, *, seed: int = 0, most: int = 10**9, limit: float = LIMIT
) -> Findings:
    """Tries damaged inputs of each target in turn, in a process of its own that may crash or hang.

    Args:
        seconds: for all of them together, without the processes' start.
        most: inputs per target.
        limit: seconds of the clock that an input may take.
    """
    findings = Findings()
    for target in targets:
        first, left = 0, seconds / len(targets)
        while left > 0 and first < most:
            first, spent = _worker(target, seed, first, left, most, limit, findings)
            left -= spent
    return findings


def _worker(
    target: str, seed: int, first: int, seconds: float, most: int, limit: float, findings: Findings
) -> tuple[int, float]:
    """Runs one process until the time is over or it dies; the next input's number, and the seconds spent."""
    reading, writing = os.pipe()
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "pipelines")])}
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryFile() as said:
        process = subprocess.Popen(
            [sys.executable, __file__, "--worker", *map(str, (writing, target, seed, first, most, folder))],
            pass_fds=[writing],
            stdout=said,
            stderr=said,
            env=environment,
        )
        os.close(writing)
        try:
            return _watch(process, reading, target, first, seconds, findings, said, limit)
        finally:
            process.kill()
            process.wait()
            os.close(reading)


def _watch(
    process: subprocess.Popen,
    reading: int,
    target: str,
    number: int,
    seconds: float,
    findings: Findings,
    said,
    most: float = LIMIT,
) -> tuple[int, float]:
    selector = selectors.DefaultSelector()
    selector.register(reading, selectors.EVENT_READ)
    buffer, started, limit = b"", None, START * most / LIMIT
    while True:
        if not selector.select(limit):
            what = f"takes more than {limit:.0f} s"
        else:
            chunk = os.read(reading, 65536)
            buffer += chunk
            *lines, buffer = buffer.split(b"\n")
            for line in lines:
                number, started = _note(line.decode(), target, number, started, findings)
            limit = most
            if chunk and (started is None or time.monotonic() - started < seconds):
                continue
            if chunk:
                return number, seconds
            if process.wait() == 0:
                return number, seconds  # it has tried as many as it should
            said.seek(0)
            tail = said.read()[-300:].decode(errors="replace").strip().splitlines()
            what = f"ends the process with {process.returncode} ({tail[-1] if tail else 'nothing said'})"
        findings.failures.append(f"{target}:{number} {what}")
        if started is None:  # it cannot even read good inputs
            return number, seconds
        return number + 1, time.monotonic() - started


def _note(
    line: str, target: str, number: int, started: float | None, findings: Findings
) -> tuple[int, float | None]:
    word, _, rest = line.partition(" ")
    if word == "ready":
        return number, time.monotonic()
    if word == "failed":
        findings.failures.append(f"{target}:{number} {rest}")
    else:
        findings.outcomes[f"{target} {word}"] += 1
    return number + 1, started


def work(writing: int, target: str, seed: int, first: int, most: int, folder: Path) -> None:
    """Tries inputs until it is stopped, and tells of each in a line."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    from fuzzing.targets import TARGETS

    inputs = folder / "inputs"
    TARGETS[target].prepare(inputs)
    os.write(writing, b"ready\n")
    for number in range(first, most):
        begin = _processor_seconds()
        outcome = attempt(target, inputs, seed, number)
        spent = _processor_seconds() - begin
        if spent > LIMIT and not outcome.startswith("failed"):
            outcome = f"failed takes {spent:.0f} s of the processors"
        os.write(writing, f"{outcome}\n".encode(errors="replace"))


def _processor_seconds() -> float:
    """Of this process and those that it has started and that have ended."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def attempt(target: str, inputs: Path, seed: int, number: int, *, tell: bool = False) -> str:
    """Tries one damaged input: "ok", "refused" or "failed" with the reason."""
    from fuzzing.targets import TARGETS

    try:
        return TARGETS[target].try_one(inputs, f"{target} {seed} {number}")
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        if tell:
            traceback.print_exc()
        place = traceback.extract_tb(error.__traceback__)[-1]
        own = [frame for frame in traceback.extract_tb(error.__traceback__) if "gshell_mi/" in frame.filename]
        place = own[-1] if own else place
        said = (str(error).strip().splitlines() or [""])[-1][:120]
        return f"failed {type(error).__name__}: {said} ({Path(place.filename).name}:{place.lineno})"


def main(arguments: list[str] | None = None) -> int:
    """Runs the command; 1 if any input failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=10.0, help="of trying, all targets together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--targets", nargs="*", help="default: all")
    parser.add_argument("--most", type=int, default=10**9, help="inputs of each target")
    parser.add_argument(
        "--limit",
        type=float,
        default=LIMIT,
        help="seconds that an input may take on the clock; more on a machine that is busy "
        f"(default {LIMIT:g}); of the processors it may always take {LIMIT:g}",
    )
    parser.add_argument("--only", help="TARGET:NUMBER, to see one input fail")
    parser.add_argument("--worker", nargs=6, help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    if given.worker:
        writing, target, seed, first, most, folder = given.worker
        work(int(writing), target, int(seed), int(first), int(most), Path(folder))
        return 0
    if given.only:
        return _again(given.only, given.seed)
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    from fuzzing.targets import TARGETS

    findings, targets = Findings(), given.targets or list(TARGETS)
    for target in targets:
        found = fuzz(
            [target], 60 * given.minutes / len(targets), seed=given.seed, most=given.most, limit=given.limit
        )
        for outcome, count in sorted(found.outcomes.items()):
            print(f"{outcome:24} {count:7}", flush=True)
        for kind in found.kinds():
            print(kind, flush=True)
        findings.outcomes += found.outcomes
        findings.failures += found.failures
    counts = ", ".join(f"{count} {kind}" for kind, count in findings.counts().items())
    print(f"{findings.tried} inputs: {counts}")
    return int(bool(findings.failures))


def _again(name: str, seed: int) -> int:
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    from fuzzing.targets import TARGETS

    target, _, number = name.partition(":")
    inputs = Path(tempfile.mkdtemp()) / "inputs"
    TARGETS[target].prepare(inputs)
    print(attempt(target, inputs, seed, int(number), tell=True))
    print(f"the input is in {inputs.parent / 'try'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
