"""The terms of the joint stage's loss beside image and mask; one of weight 0 is never computed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from ... import losses
from ...errors import UserError
from ...extraction.flexicubes import deviation
from ...extraction.surface_mesh import SurfaceMesh
from ...light import EnvironmentLight
from ...material import GivenMaterial, MaterialField
from ...means import mean
from ...pixels import COVERED
from ...scene import FitScene
from ...views import PinholeViews
from ...visibility import is_visible
from .config import LossConfig

#: Coverage from which on a pixel shows one surface.
_WHOLE = 0.99

#: Depths that differ by more cells than this are those of different surfaces.
_DEPTH_LIMIT = 4.0


@dataclass(frozen=True)
class Term:
    """A term of the loss.

    Attributes:
        loss: what it adds, of a step, or of a view of a step.
        per_view: whether it is the mean over the views of the step.
        needs: an attribute of ``StepView`` without which there is none, such as ``light``.
    """

    loss: Callable[[StepView], mi.Float]
    per_view: bool = False
    needs: str = ""


#: Every loss by the name of its weight.
_TERMS: dict[str, Term] = {}


def register_loss(name: str, *, per_view: bool = False, needs: str = "") -> Callable:
    """Lets ``--losses.extra`` know the decorated function, as ``name``; the rest as of ``Term``."""

    def register(loss: Callable[[StepView], mi.Float]) -> Callable[[StepView], mi.Float]:
        _TERMS[name] = Term(loss, per_view, needs)
        return loss

    return register


def registered_losses() -> list[str]:
    """The names of all losses, those included that ``LossConfig`` has weights of."""
    return sorted(_TERMS)


def check_losses(config: LossConfig) -> None:
    """Whether there are all losses that have a weight.

    Raises:
        UserError: there is no such loss.
    """
    own = vars(config).keys()
    for name in config.extra:
        if name not in _TERMS or name in own:
            known = ", ".join(sorted(_TERMS.keys() - own))
            raise UserError(f"There is no loss '{name}' for --losses.extra; there are {known or 'none'}.")


class StepView:
    """What a step of the joint stage is about: what losses are functions of.

    Args:
        given: its subject holds the attached fields and mesh of the present step.
        scene: the scene that is rendered.
        material: what is optimised; None if it is given.
        light: the same.

    Attributes:
        view: index of a view of the step.
    """

    def __init__(
        self,
        given: FitScene,
        scene: mi.Scene,
        material: MaterialField | GivenMaterial | None,
        light: EnvironmentLight | None,
    ):
        self.given, self.scene, self.material, self.light = given, scene, material, light
        self.subject, self.view = given.subject, 0
        self.depths = any(target.depth is not None for target in given.targets)
        self.cubes = self.subject.lattice.weight_count

    def look_from(self, view: int) -> None:
        """Goes on to another view of the step."""
        self.view = view
        self.__dict__.pop("first_hits", None)

    def step_on(self) -> None:
        """Goes on to the next step."""
        self.__dict__.pop("template", None)

    def in_cells(self, name: str) -> mi.Float:
        """``sdf`` or ``msdf`` on the lattice, attached."""
        return getattr(self.subject, name) / self.subject.lattice.spacing

    @cached_property
    def views(self) -> PinholeViews:
        """The cameras."""
        return PinholeViews.from_sensors(self.given.sensors)

    @cached_property
    def template(self) -> SurfaceMesh:
        """The watertight template of the present step, attached."""
        return self.subject.template()

    @cached_property
    def first_hits(self) -> tuple[mi.Ray3f, mi.PreliminaryIntersection3f]:
        """The rays through the pixels' centres of the view, and what they meet first."""
        with dr.suspend_grad():
            ray = self.views.pixel_rays(self.view)
            return ray, self.scene.ray_intersect_preliminary(ray)

    def on_subject(self, hit: mi.PreliminaryIntersection3f) -> mi.Bool:
        """Whether rays meet the surface that is sought."""
        return hit.is_valid() & (hit.shape == mi.ShapePtr(self.subject))

    @property
    def alpha(self) -> mi.Float:
        """Coverage of the view's pixels."""
        return mi.Float(self.given.targets[self.view].rgba[..., 3].ravel())

    @property
    def known(self) -> mi.Bool:
        """Which of the view's pixels are known as a whole."""
        return mi.Float(np.float32(self.given.targets[self.view].known).ravel()) > COVERED

    @property
    def color(self) -> mi.Color3f:
        """The view's target."""
        return mi.Color3f(np.ascontiguousarray(self.given.targets[self.view].rgba[..., :3].reshape(-1, 3).T))

    def is_visible(self, points: mi.Point3f) -> mi.Bool:
        """Whether the view frames points and nothing is before them."""
        return is_visible(self.scene, self.views, dr.opaque(mi.UInt32, self.view), points)


class Regularisers:
    """Losses of the subject's fields, the material and the light.

    Args:
        step: what they are functions of.
        config: the weights.
    """

    def __init__(self, step: StepView, config: LossConfig):
        check_losses(config)
        self._step = step
        weights = vars(config) | config.extra
        self._terms = {
            name: (weights[name], term)
            for name, term in _TERMS.items()
            if weights.get(name, 0) > 0 and (not term.needs or getattr(step, term.needs))
        }

    def __call__(self, views: Sequence[int]) -> tuple[mi.Float, dict[str, mi.Float]]:
        """The weighted sum, and every loss of its own, for a step on the views with these indices."""
        self._step.step_on()
        total, values = mi.Float(0), {}
        for name, (weight, term) in self._terms.items():
            values[name] = self._mean(term, views) if term.per_view else term.loss(self._step)
            total += weight * values[name]
        return total, values

    def _mean(self, term: Term, views: Sequence[int]) -> mi.Float:
        total = mi.Float(0)
        for view in views:
            self._step.look_from(view)
            total += term.loss(self._step)
        return total / len(views)


@register_loss("depth", per_view=True, needs="depths")
def _depth(step: StepView) -> mi.Float:
    """Difference to the view's depth map."""
    target = step.given.targets[step.view]
    if target.depth is None:
        return mi.Float(0)
    distance = mi.Float(target.depth.ravel())
    ray, hit = step.first_hits
    interaction = hit.compute_surface_interaction(ray, mi.RayFlags.All)
    # Where a pixel is covered in part, its depth is a mixture of two surfaces.
    valid = step.on_subject(hit) & (distance > 0) & (step.alpha > _WHOLE) & step.known
    # From the measured point to the tangent plane: at grazing angles a small step changes depth a lot.
    scale = dr.abs(dr.dot(dr.detach(interaction.n), ray.d)) / step.subject.cell_size
    return losses.depth_l1(dr.select(valid, interaction.t * scale, 0), distance * scale, valid, _DEPTH_LIMIT)


@register_loss("flexicubes_deviation", needs="cubes")
def _flexicubes_deviation(step: StepView) -> mi.Float:
    """How far vertices of FlexiCubes are from the points that they are means of."""
    spread = deviation(step.subject.surface, step.subject.lattice, step.subject.deform)
    return mean(spread) / step.subject.lattice.spacing


@register_loss("material_smoothness", needs="material")
def _material_smoothness(step: StepView) -> mi.Float:
    """Differences of the material along edges."""
    assert step.material is not None, "the loss needs it"
    surface, total = step.subject.surface, mi.Float(0)
    for field in step.material.values().values():
        channels = dr.width(field) // step.subject.lattice.vertex_count
        values = surface.interpolate(field, channels)
        total += losses.edge_smoothness(values, mi.Vector3u(surface.faces))
    return total


@register_loss("light_grey", needs="light")
def _light_grey(step: StepView) -> mi.Float:
    """Grey-world prior of the light."""
    assert step.light is not None, "the loss needs it"
    return losses.grey_world(dr.unravel(mi.Color3f, step.light.radiance.array))
