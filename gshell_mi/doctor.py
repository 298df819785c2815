"""Is this machine ready? ``python -m gshell_mi.doctor`` says what is there and how to mend what is not.

>>> from gshell_mi.doctor import diagnose
>>> diagnose(self_test=False).problems
()
"""

import argparse
import json
import os
import platform
import re
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import drjit as dr
import mitsuba as mi

from . import __version__, compat
from .errors import UserError
from .memory import GIB, free_memory
from .streams import with_streams

_NAN_MINIMUM = platform.machine().lower() in ("x86_64", "amd64") and compat.DRJIT_VERSION >= (1, 5)

#: Since 1.5 Dr.Jit emits a NaN-propagating minimum, on which LLVM's x86 code generation aborts up to 16;
#: Mitsuba's own `path` integrator contains it. Otherwise the minimum is Dr.Jit's own.
MINIMUM_LLVM = 17 if _NAN_MINIMUM else 15

#: The newest release whose Dr.Jit emits no such minimum.
_MITSUBA_FOR_OLD_LLVM = "3.9.0"

_INSTALL_LLVM = (
    f"install one of version {MINIMUM_LLVM} or later (Debian, Ubuntu: `sudo apt-get install libllvm19`; "
    "macOS: `brew install llvm`), or set DRJIT_LIBLLVM_PATH to the libLLVM library"
)

#: Radiance of the self-test: a diffuse floor of albedo 0.5 under a uniform light of radiance 1.
_EXPECTED = 0.5


@dataclass(frozen=True)
class Diagnosis:
    """What ``diagnose`` found; ``str()`` of it is the report."""

    python: str
    """Version and platform."""
    packages: dict[str, str]
    """Versions of gshell_mi, mitsuba and drjit."""
    variants: tuple[str, ...]
    """Mitsuba variants of this installation that gshell_mi can use, whether they run here or not."""
    llvm_version: tuple[int, int, int] | None
    """As Dr.Jit sees it; None if it found no library."""
    llvm_path: Path | None
    """The library that Dr.Jit loaded; None if there is none or the system does not tell (outside Linux)."""
    threads: int
    """Size of Dr.Jit's thread pool."""
    cuda: bool
    """Whether Dr.Jit found a CUDA device."""
    free_memory: int | None = None
    """Bytes of main memory that a fit may take; None if the system does not tell."""
    render_seconds: float | None = None
    """Time of the self-test's render including compilation; None if it did not run."""
    problems: tuple[str, ...] = ()
    """One sentence for each thing that keeps ``llvm_ad_rgb`` from running, with the cure."""

    def __str__(self) -> str:
        llvm = "not found"
        if self.llvm_version:
            llvm = ".".join(map(str, self.llvm_version)) + f" ({self.llvm_path or 'path unknown'})"
        rows = {
            "Python": self.python,
            **self.packages,
            "variants": ", ".join(self.variants) or "none",
            "LLVM": llvm,
            "threads": str(self.threads),
            "memory": f"{self.free_memory / GIB:.1f} GiB free" if self.free_memory else "unknown",
            "GPU": "CUDA device found" if self.cuda else "none (the llvm variant needs none)",
            "self-test": f"passed in {self.render_seconds:.1f} s" if self.render_seconds else "not run",
        }
        lines = [f"{name:<10} {value}" for name, value in rows.items()]
        return "\n".join(lines + ([f"problem    {p}" for p in self.problems] or ["Ready."]))


def diagnose(*, self_test: bool = True) -> Diagnosis:
    """Looks at the installation without setting a variant in this process.

    ``self_test`` also renders a small scene in a second process, about two seconds.
    """
    found = Diagnosis(
        python=f"{platform.python_version()} on {platform.system()} {platform.machine()}",
        packages={"gshell_mi": __version__, "mitsuba": mi.__version__, "drjit": dr.__version__},
        variants=tuple(v for v in mi.variants() if v.endswith("_ad_rgb")),
        llvm_version=_llvm_version(),
        llvm_path=_llvm_path(),
        threads=dr.thread_count(),
        cuda=dr.has_backend(dr.JitBackend.CUDA),
        free_memory=free_memory(),
    )
    problem = _llvm_problem()
    if problem is None and self_test:
        found, problem = _run_self_test(found)
    return found if problem is None else replace(found, problems=(problem,))


def ensure_variant(name: str = "llvm_ad_rgb") -> None:
    """Sets the Mitsuba variant, after a check that it can run here.

    Raises ``UserError`` with the cure if the variant is unknown or not usable, or if LLVM or the GPU
    is missing.

    >>> ensure_variant("scalar_rgb")
    Traceback (most recent call last):
        ...
    gshell_mi.errors.UserError: variant 'scalar_rgb' is not usable: choose llvm_ad_rgb or cuda_ad_rgb
    """
    usable = [v for v in mi.variants() if v.endswith("_ad_rgb")]
    if name not in usable:
        raise UserError(f"variant {name!r} is not usable: choose {' or '.join(usable)}")
    if name.startswith("llvm") and (problem := _llvm_problem()):
        raise UserError(problem)
    if name.startswith("cuda") and not dr.has_backend(dr.JitBackend.CUDA):
        raise UserError(f"variant {name!r} needs an NVIDIA GPU and its driver, found none: use llvm_ad_rgb")
    mi.set_variant(name)
    # With a single thread, as on a single core, Mitsuba (3.9.1) waits forever for itself to read an EXR file.
    if dr.thread_count() < 2:
        dr.set_thread_count(2)


def _llvm_version() -> tuple[int, int, int] | None:
    if not dr.has_backend(dr.JitBackend.LLVM):
        return None
    return tuple(dr.detail.llvm_version())


def _llvm_path() -> Path | None:
    """The mapped library; Dr.Jit does not tell which file it opened."""
    maps = Path("/proc/self/maps")
    if not maps.exists():
        return None
    match = re.search(r"(/\S*libLLVM\S*)$", maps.read_text(), re.MULTILINE)
    return Path(match.group(1)) if match else None


def _llvm_problem() -> str | None:
    """Why the LLVM backend cannot run here, with the cure; None if it can."""
    found = _llvm_version()
    chosen = os.environ.get("DRJIT_LIBLLVM_PATH")
    if found is None:
        if chosen:
            return (
                f"DRJIT_LIBLLVM_PATH is set to {chosen!r}, which Dr.Jit cannot load as LLVM: "
                "correct the path or unset the variable"
            )
        return f"Dr.Jit found no LLVM library: {_INSTALL_LLVM}"
    if found[0] < MINIMUM_LLVM:
        path = _llvm_path() or "a path that the system does not tell"
        older = ""
        if _NAN_MINIMUM and found[0] >= 15:
            older = f", or take `pip install mitsuba=={_MITSUBA_FOR_OLD_LLVM}`, which can use this one"
        return f"LLVM {found[0]} at {path} is too old for Dr.Jit {dr.__version__}: {_INSTALL_LLVM}{older}"
    return None


def _run_self_test(found: Diagnosis) -> tuple[Diagnosis, str | None]:
    """Renders in a second process, since LLVM ends the process where it fails."""
    command = [sys.executable, "-m", "gshell_mi.doctor", "--render"]
    try:
        result = subprocess.run(command, capture_output=True, text=True, timeout=120)
    except subprocess.TimeoutExpired:
        return found, "the self-test's render did not end within 120 s: try another LLVM version"
    if result.returncode != 0:
        lines = result.stderr.strip().splitlines() or [f"exit code {result.returncode}"]
        reason = next((line for line in lines if line.startswith("LLVM ERROR")), None)
        if reason:
            return found, f"the self-test's render failed ({reason}): {_INSTALL_LLVM}"
        return found, (
            f"the self-test's render failed ({lines[-1]}): `python -m gshell_mi.doctor --render` "
            "shows the whole message"
        )
    answer = json.loads(result.stdout.strip().splitlines()[-1])
    if abs(answer["value"] - _EXPECTED) > 0.01:
        return found, (
            f"the self-test rendered {answer['value']:.3f} where {_EXPECTED} is right: {_INSTALL_LLVM}"
        )
    return replace(found, render_seconds=answer["seconds"]), None


def _render() -> dict[str, float]:
    """Mean radiance of a diffuse floor that fills the view, and the seconds it took."""
    mi.set_variant("llvm_ad_rgb")
    look_down = mi.ScalarTransform4f().look_at(origin=[0, 0, 2], target=[0, 0, 0], up=[0, 1, 0])
    start = time.perf_counter()
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 3},
            "floor": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().scale(10),
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": _EXPECTED}},
            },
            "light": {"type": "constant"},
            "sensor": {
                "type": "perspective",
                "fov": 40,
                "to_world": look_down,
                "film": {"type": "hdrfilm", "width": 64, "height": 64},
            },
        }
    )
    image = mi.render(scene, spp=64)
    # Dr.Jit's NaN-propagating minimum is what old LLVM versions cannot compile.
    value = dr.mean(dr.minimum(image.array, 10.0))[0]
    return {"value": value, "seconds": time.perf_counter() - start}


def main(argv: list[str] | None = None) -> int:
    """The command; exit code 2 if the llvm variant cannot run."""
    description = (__doc__ or "").split("\n")[0]
    parser = argparse.ArgumentParser(prog="python -m gshell_mi.doctor", description=description)
    parser.add_argument("--llvm", action="store_true", help="check LLVM only, without a render or report")
    parser.add_argument("--render", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    return with_streams(lambda: _run(args))


def _run(args: argparse.Namespace) -> int:
    if args.render:
        print(json.dumps(_render()))
        return 0
    found = diagnose(self_test=not args.llvm)
    if not args.llvm:
        print(found)
    elif found.problems:
        print(*found.problems, sep="\n", file=sys.stderr)
    return 2 if found.problems else 0


if __name__ == "__main__":
    sys.exit(main())
