"""Base colours as fine as the images, by projecting back what a render lacks.

Where geometry, light and gloss are known, the base colour of a place is what makes its render agree with the
images in the mean over all views. Each round renders every view, and multiplies the colours of what is seen
by the ratio of the images to the renders (as in iterative back-projection, Irani and Peleg 1991). Colours at
the lattice's vertices are as coarse as its cells; these are at the vertices of a mesh as fine as the pixels.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...activations import sigmoid
from ...compat import write_mesh
from ...images import decibels
from ...material import principled
from ...pixels import COVERED
from ...preview import Preview
from ...targets import Target, mean_radiance
from ...views import PinholeViews

#: Samples per pixel of a render. Their noise averages out over the pixels, views and rounds of a vertex.
_SPP = 8

#: Longest path, as that of the exported scene.
_DEPTH = 5

#: Renders brighter than the image by more than this factor are not so for want of colour.
_OUTLIER = 4.0

#: Radiance below this fraction of the images' mean counts as that much.
_DARK = 0.03

#: So many pixels more are taken to agree with the render at each vertex.
_PRIOR = 0.5

#: Colours nearer to 0 or 1 than this have no logit.
_SATURATED = 1e-3

#: How much more than the colour of a place its logit may change, at most: 1 / (1 - color) has no bound.
_STEEPEST = 3.0


@dataclass(frozen=True)
class FineMesh:
    """A surface as it is rendered: ``vertices`` (V, 3), ``faces`` (F, 3), ``normals`` (V, 3), and ``color``
    (V, 3), ``roughness`` (V,) and ``metallic`` (V,)."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    color: np.ndarray
    roughness: np.ndarray
    metallic: np.ndarray

    def shape(self) -> mi.Mesh:
        """As a Mitsuba mesh with attributes that can be changed."""
        properties = mi.Properties()
        properties["bsdf"] = mi.load_dict(principled())
        mesh = mi.Mesh(
            "subject", len(self.vertices), len(self.faces), has_vertex_normals=True, props=properties
        )
        for name, size, values in (
            ("vertex_color", 3, self.color),
            ("vertex_roughness", 1, self.roughness),
            ("vertex_metallic", 1, self.metallic),
        ):
            mesh.add_attribute(name, size, np.ascontiguousarray(values, np.float32).ravel())
        positions, normals = (
            mi.Float(np.ascontiguousarray(values, np.float32).ravel())
            for values in (self.vertices, self.normals)
        )
        write_mesh(mesh, positions, mi.UInt32(np.ascontiguousarray(self.faces, np.uint32).ravel()), normals)
        return mesh


class BackProjection:
    """Steps that each look at one view; after every round over all views the colours change.

    Args:
        mesh: with the colours to start from.
        objects: the rest of the scene, for ``mi.load_dict``.
        sensors, views: the cameras.
        targets: their images.
        lights: per view ``to_world`` of the emitter ``light``; none if it stays.
        kept: what ``state`` gave, of a run to go on with.
        seed: of the paths.
    """

    def __init__(
        self,
        mesh: FineMesh,
        objects: dict,
        sensors: list[mi.Sensor],
        views: PinholeViews,
        targets: list[Target],
        lights: list[mi.Transform4f],
        kept: Mapping[str, np.ndarray],
        *,
        seed: int = 0,
    ):
        self._mesh, self._sensors, self._views, self._lights, self._seed = mesh, sensors, views, lights, seed
        self._targets = targets
        self._faces = mi.UInt32(np.ascontiguousarray(mesh.faces, np.uint32).ravel())
        self._shape = mesh.shape()
        self._scene = mi.load_dict({"type": "scene", "subject": self._shape, **objects})
        self._parameters = mi.traverse(self._scene)
        self._color = next(name for name in self._parameters.keys() if name.endswith("subject.vertex_color"))
        self._integrator = mi.load_dict({"type": "path", "max_depth": _DEPTH, "hide_emitters": True})
        self._dark = _DARK * mean_radiance(targets)
        count = len(mesh.vertices)
        self._logits = mi.Float(kept["logits"]) if kept else mi.Float(_logit(mesh.color).ravel())
        #: Over the pixels that see a vertex: of images and of renders, both over the images.
        self._sums = {
            name: mi.Float(kept[name]) if kept else dr.zeros(mi.Float, 3 * count)
            for name in ("images", "renders")
        }
        self._show()

    def state(self) -> dict[str, np.ndarray]:
        """What a run needs to go on."""
        values = {"logits": self._logits, **self._sums}
        return {name: np.array(value.numpy()) for name, value in values.items()}

    def colors(self) -> np.ndarray:
        """(V, 3) base colour."""
        return sigmoid(self._logits).numpy().reshape(-1, 3)

    def step(self, iteration: int) -> dict[str, float]:
        """Looks at the next view."""
        turn, view = divmod(iteration, len(self._sensors))
        with dr.suspend_grad():
            error = self._look(view, self._seed + iteration)
            if view == len(self._sensors) - 1:
                self._change(turn)
        return {"loss": error, "psnr": decibels(max(error, 1e-9))}

    def preview(self) -> Preview:
        """The mesh in its base colour."""
        mesh = self._mesh
        return Preview(mesh.vertices, mesh.faces, self.colors(), mesh.vertices, mesh.faces)

    def _look(self, view: int, seed: int) -> float:
        """Adds up what a view tells the vertices; returns its mean squared error."""
        if self._lights:
            self._parameters["light.to_world"] = self._lights[view]
            self._parameters.update()
        image = mi.render(
            self._scene, sensor=self._sensors[view], integrator=self._integrator, spp=_SPP, seed=seed % 2**32
        )
        rendered, target = (
            dr.unravel(mi.Vector4f, values)
            for values in (image.array, mi.Float(self._targets[view].rgba.ravel()))
        )
        known = mi.Float(np.asarray(self._targets[view].known).ravel())
        covered = (rendered.w > COVERED) & (target.w > COVERED) & (known > COVERED)
        rendered, target = (mi.Color3f(rgba.x, rgba.y, rgba.z) for rgba in (rendered, target))
        ray = self._views.pixel_rays(view)
        found = self._scene.ray_intersect_preliminary(ray, coherent=True)
        covered &= found.is_valid() & (found.shape == mi.ShapePtr(self._shape))
        normal = found.compute_surface_interaction(ray, mi.RayFlags.Minimal, covered).n
        # Highlights have less to say. The noise is in the render alone, so sums over the image have no bias.
        dark = dr.opaque(mi.Float, self._dark)
        scale = dr.rcp(dr.maximum(target, 0) + dark)
        values = {
            "images": (target + dark) * scale,
            "renders": dr.minimum((rendered + dark) * scale, _OUTLIER),
        }
        facing = dr.abs(dr.dot(normal, ray.d))
        uv = found.prim_uv
        for corner, share in enumerate((1 - uv.x - uv.y, uv.x, uv.y)):
            vertex = dr.gather(mi.UInt32, self._faces, 3 * found.prim_index + corner, covered)
            for name, value in values.items():
                dr.scatter_add(self._sums[name], share * facing * value, vertex, covered)
        error = dr.mean(dr.squared_norm(rendered - target)) / 3
        dr.eval(self._sums, error)
        return float(error[0])

    def _change(self, turn: int) -> None:
        """Ends a round. After two of them steps get smaller: noise averages out (Robbins and Monro 1951)."""
        vertex = dr.arange(mi.UInt32, len(self._mesh.vertices))
        images, renders, color, logits = (
            dr.gather(mi.Color3f, values, vertex)
            for values in (self._sums["images"], self._sums["renders"], sigmoid(self._logits), self._logits)
        )
        told = dr.log((images + _PRIOR) / (renders + _PRIOR))
        logits += told * dr.minimum(dr.rcp(1 - color), _STEEPEST) / dr.opaque(mi.Float, max(turn, 1))
        dr.scatter(self._logits, logits, vertex, mode=dr.ReduceMode.Permute)
        self._sums = {name: dr.zeros_like(values) for name, values in self._sums.items()}
        dr.eval(self._logits, self._sums)
        self._show()

    def _show(self) -> None:
        self._parameters[self._color] = sigmoid(self._logits)
        self._parameters.update()


def _logit(color: np.ndarray) -> np.ndarray:
    color = np.clip(color, _SATURATED, 1 - _SATURATED)
    return np.log(color / (1 - color)).astype(np.float32)
