"""What a fit was started with, short enough for its checkpoint: another one does not continue it."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

import mitsuba as mi
import numpy as np

from ...errors import UserError
from ...lattice import Lattice
from ...scene import FitScene
from ...targets import Target

#: What a message calls the parts, and what they are where that is short.
_PARTS = {
    "lattice": "lattice: {before} instead of {now}",
    "box": "to_world of the gshell shape",
    "fields": "fields of the gshell shape",
    "material": "material of the gshell shape",
    "light": "initial light",
    "objects": "objects beside the gshell shape",
}


def fingerprint(scene: FitScene, lattice: Lattice) -> dict[str, Any]:
    """Digests of everything that a fit reads, as JSON-able values.

    Args:
        scene: with its targets.
        lattice: that a fit from the hull ends on.
    """
    subject = scene.subject
    others = [shape for shape in scene.scene.shapes() if shape is not subject]
    fields = subject.fields() if subject.filename else None
    views = {view.sensor.id(): view for view in (*scene.training, *scene.held_out)}
    return {
        "lattice": f"{lattice.grid}, {lattice.resolution} cells",
        "box": _digest(np.array(subject.to_world.matrix)),
        "fields": _digest(fields.sdf, fields.msdf, fields.deform) if fields else "",
        "material": _of_parameters(scene.bsdf),
        "light": _of_parameters(scene.light),
        "objects": _digest(*map(_of_parameters, others)),
        "views": {
            name: _of_parameters(view.sensor, view.sensor.film().rfilter()) for name, view in views.items()
        },
        "targets": {name: _digest(*_arrays(view.target)) for name, view in views.items()},
    }


def _arrays(target: Target) -> list[np.ndarray]:
    """What a target tells; that all of it is known, or no depths, adds nothing."""
    depth = [] if target.depth is None else [target.depth]
    return [target.rgba, *depth, *([] if target.is_known else [np.asarray(target.known)])]


def check_fingerprint(before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Raises ``UserError`` if a checkpoint's fit was started with something else, and says what differs."""
    differing = [
        text.format(before=before.get(name), now=now[name])
        for name, text in _PARTS.items()
        if before.get(name) != now[name]
    ]
    for name, text in (("views", "cameras"), ("targets", "images")):
        earlier, later = before.get(name) or {}, now[name]
        if name == "views" and earlier.keys() != later.keys():
            changed = sorted(earlier.keys() ^ later.keys())
            differing.append(f"{len(earlier)} views instead of {len(later)}: {_some(changed)}")
            break
        changed = [view for view in later if earlier.get(view) != later[view]]
        if changed:
            differing.append(f"{text} of {_some(changed)}")
    if differing:
        raise UserError(
            f"The checkpoint's fit was started with other inputs ({', '.join(differing)}); "
            f"resume with the same, or start again with --overwrite."
        )


def _some(names: list[str]) -> str:
    return ", ".join(f"'{name}'" for name in names[:3]) + (" ..." if len(names) > 3 else "")


def _of_parameters(*nodes: Any) -> str:
    """The digest of Mitsuba objects: their classes and all parameters."""
    parts = []
    for node in nodes:
        parts.append(np.frombuffer(node.class_name().encode(), np.uint8))
        if isinstance(node, mi.ReconstructionFilter):
            parts.append(np.float32(node.radius()))
            continue
        for name, value in sorted(mi.traverse(node)):
            parts += [np.frombuffer(name.encode(), np.uint8), np.array(getattr(value, "matrix", value))]
    return _digest(*parts)


def _digest(*arrays: Any) -> str:
    hashed = hashlib.blake2b(digest_size=12)
    for array in arrays:
        array = np.asarray(array)
        hashed.update(f"{array.dtype.str}{array.shape}".encode())
        hashed.update(np.ascontiguousarray(array).tobytes())
    return hashed.hexdigest()
