"""What a batch consists of: a file with one job per line."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from ..errors import UserError
from ..files import name_trouble

#: Commands that a job may run; files never name a program.
COMMANDS = ("capture", "fit", "export", "turntable", "compare", "report", "dataset", "train", "generate")
#: What stands, in arguments, for the folder of the job's results.
OUT = "{out}"


@dataclass(frozen=True)
class Job:
    """One command to run."""

    name: str
    """Of its folder; unlike all others of the file."""
    command: str
    """One of ``COMMANDS``."""
    arguments: tuple[str, ...]
    cpus: float = 1.0
    gpus: float = 0.0
    memory_gib: float = 0.0
    """Main memory that it is promised; 0 for none in particular."""

    def filled_in(self, out: str) -> list[str]:
        """Its arguments, with the folder of results in place."""
        if any(OUT in argument for argument in self.arguments):
            return [argument.replace(OUT, out) for argument in self.arguments]
        if self.command in ("export", "report"):  # into the fit's
            return list(self.arguments)
        return [*self.arguments, "-o", out]


def read_jobs(path: Path) -> list[Job]:
    """The jobs of a file with one JSON object per line.

    ``{"name": "mug", "command": "fit", "arguments": ["mug.xml"], "cpus": 2}``; ``name``, ``cpus``, ``gpus``
    and ``memory_gib`` may be missing. ``{out}`` in an argument is the folder of the job's results; without
    it, ``-o`` and that folder are added.

    Raises:
        UserError: the file is missing or empty, or a line of it is no job; the sentence tells which.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except FileNotFoundError:
        raise UserError(f"'{path}' does not exist; check the path.") from None
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(
            f"'{path}' cannot be read as a file of jobs ({error}); give one with a JSON object per line."
        ) from error
    jobs = [
        _job(line, f"'{path}', line {number}", number) for number, line in enumerate(lines, 1) if line.strip()
    ]
    if not jobs:
        raise UserError(f"'{path}' holds no jobs; give one JSON object per line.")
    names: set[str] = set()
    for job in jobs:
        if job.name in names:
            raise UserError(f"'{path}' has two jobs of the name '{job.name}'; give each another.")
        names.add(job.name)
    return jobs


def _job(line: str, where: str, number: int) -> Job:
    try:
        found = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise UserError(f"{where}, is no JSON ({error}); write one object per line.") from error
    if not isinstance(found, dict):
        raise UserError(f"{where}, is no JSON object; write one per line.")
    if unknown := set(found) - {"name", "command", "arguments", "cpus", "gpus", "memory_gib"}:
        raise UserError(f"{where}, has '{min(unknown)}', which means nothing; leave it out.")
    command, arguments = found.get("command"), found.get("arguments", [])
    if command not in COMMANDS:
        raise UserError(f"{where}, has no command of gshell_mi; choose one of {', '.join(COMMANDS)}.")
    if not isinstance(arguments, list) or not all(isinstance(argument, str) for argument in arguments):
        raise UserError(f"{where}: 'arguments' must be a list of texts.")
    name = found.get("name", f"{number:06d}-{command}")
    if not isinstance(name, str) or (trouble := name_trouble(name, in_scene=False)):
        raise UserError(
            f"{where}: the name {trouble if isinstance(name, str) else 'is no text'}; give another."
        )
    amounts = {
        key: found.get(key, default) for key, default in (("cpus", 1.0), ("gpus", 0.0), ("memory_gib", 0.0))
    }
    for key, value in amounts.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < 1e6:
            raise UserError(f"{where}: '{key}' must be a number that is not negative.")
    return Job(name, command, tuple(arguments), **{key: float(value) for key, value in amounts.items()})
