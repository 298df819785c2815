"""A spatially varying principled material on the lattice."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from .activations import sigmoid
from .fields.carried import Carried

if TYPE_CHECKING:
    from .extraction import SurfaceMesh

#: Range of roughness: below, paths to a small light become too rare for a fit's few samples.
ROUGHNESS_RANGE = (0.08, 1.0)

#: Vertex attributes of the mesh, and the principled BSDF's parameters that read them.
ATTRIBUTES = {"vertex_color": "base_color", "vertex_roughness": "roughness", "vertex_metallic": "metallic"}

#: Parameters that the whole object shares, by the attribute whose logits they are added to. What little each
#: vertex is told about its gloss drowns in noise; what all are told together does not.
_SHARED = {"vertex_roughness": "shared_roughness", "vertex_metallic": "shared_metallic"}


class MaterialField:
    """Base colour, roughness and metallic at the lattice's vertices, interpolated to the mesh's.

    The field hangs on the lattice, not on the mesh, hence it stays where it is when the surface
    moves through it, and both sides of a sheet share it.

    Args:
        reflectance: (vertex_count, 3) linear Rec.709 base colour in [0, 1].
        base_color: one colour instead.
        roughness, metallic: in [0, 1], uniform to start with.

    The optimised ``parameters`` are logits: flat ``mi.Float`` by the names of the mesh's attributes, colours
    interleaved, and one number each that is added to all roughnesses and all metallics.
    """

    def __init__(
        self,
        reflectance: np.ndarray,
        *,
        base_color: np.ndarray | None = None,
        roughness: float = 0.6,
        metallic: float = 0.05,
    ):
        if base_color is not None:
            reflectance = np.broadcast_to(base_color, reflectance.shape)
        count = len(reflectance)
        low, high = ROUGHNESS_RANGE
        self.parameters = {
            "vertex_color": mi.Float(_logit(reflectance).astype(np.float32).ravel()),
            "vertex_roughness": dr.full(mi.Float, float(_logit((roughness - low) / (high - low))), count),
            "vertex_metallic": dr.full(mi.Float, float(_logit(metallic)), count),
        } | {name: mi.Float([0.0]) for name in _SHARED.values()}

    @property
    def on_lattice(self) -> list[str]:
        """The names of the parameters that have a value per vertex."""
        return [name for name in self.parameters if name in ATTRIBUTES]

    def carry(self, carried: Carried) -> None:
        """Moves the parameters to other blocks of the lattice."""
        for name in self.on_lattice:
            self.parameters[name] = carried.values(dr.detach(self.parameters[name]))

    def values(self) -> dict[str, mi.Float]:
        """The lattice fields themselves, all in [0, 1], by attribute name."""
        logits = {name: self.parameters[name] for name in self.on_lattice}
        for name, shared in _SHARED.items():
            logits[name] = logits[name] + self.parameters[shared]
        unit = {name: sigmoid(field) for name, field in logits.items()}
        low, high = ROUGHNESS_RANGE
        unit["vertex_roughness"] = low + (high - low) * unit["vertex_roughness"]
        return unit


class GivenMaterial:
    """One principled material everywhere that is not optimised: used like a ``MaterialField``.

    Args:
        count: lattice vertices.
        base_color, roughness, metallic: as ``given_material`` found them; those of Mitsuba's ``principled``
            where they are missing.
    """

    def __init__(
        self,
        count: int,
        *,
        base_color: np.ndarray | None = None,
        roughness: float = 0.5,
        metallic: float = 0.0,
    ):
        color = np.broadcast_to(0.5 if base_color is None else base_color, (count, 3))
        self.parameters: dict[str, mi.Float] = {}
        self.on_lattice: list[str] = []
        self._values = {
            "vertex_color": mi.Float(color.astype(np.float32).ravel()),
            "vertex_roughness": dr.full(mi.Float, roughness, count),
            "vertex_metallic": dr.full(mi.Float, metallic, count),
        }

    def carry(self, carried: Carried) -> None:
        """Moves the values to other blocks of the lattice."""
        self._values = {name: carried.values(field) for name, field in self._values.items()}

    def values(self) -> dict[str, mi.Float]:
        """The lattice fields by attribute name."""
        return dict(self._values)


def attributes_of(material: MaterialField | GivenMaterial, mesh: SurfaceMesh) -> dict[str, np.ndarray]:
    """A material at the vertices of a mesh that was extracted from its lattice, by attribute name: (V, 3) or
    (V,)."""
    found = {}
    for name, field in material.values().items():
        channels = 3 if name == "vertex_color" else 1
        values = np.array(mesh.interpolate(field, channels).numpy())
        found[name] = values.T if channels == 3 else values
    return found


def given_material(bsdf: mi.BSDF) -> dict:
    """Uniform values of a ``principled`` BSDF as arguments of ``MaterialField``; empty for other BSDFs."""
    parameters = mi.traverse(bsdf)
    found = {}
    for name in ATTRIBUTES.values():
        for key in parameters.keys():
            if key == f"{name}.value" or key.endswith(f".{name}.value"):
                value = np.array(parameters[key]).ravel()
                found[name] = value if name == "base_color" else float(value[0])
    return found


def principled() -> dict:
    """A two-sided principled BSDF that reads the mesh's attributes, for ``mi.load_dict``."""
    textures = {
        parameter: {"type": "mesh_attribute", "name": attribute}
        for attribute, parameter in ATTRIBUTES.items()
    }
    return {"type": "twosided", "bsdf": {"type": "principled", **textures}}


def _logit(x: ArrayLike) -> np.ndarray:
    # Saturated values would have no gradient left.
    x = np.clip(x, 0.02, 0.98)
    return np.log(x / (1 - x))
