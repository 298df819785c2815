"""The joint stage: geometry, material and light by differentiable path tracing."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from ... import losses
from ...errors import UserError
from ...fields import LatticeFields
from ...fields.smoothing import LatticeDiffusion
from ...images import decibels
from ...light import EnvironmentLight
from ...material import GivenMaterial, MaterialField, principled
from ...means import mean
from ...outliers import finite
from ...parametrisation import StepRules, make_parametrisation, parametrisation_named
from ...preview import Preview
from ...scene import FitScene
from ...schedules import decay_at
from ...tempered_adam import TemperedAdam
from ...template.msdf import without_specks
from ...timing import phase
from .regularisers import Regularisers, StepView

if TYPE_CHECKING:
    from ..config import FitConfig
    from ..stages.joint import JointConfig

#: Between the first sampler seeds of fits whose seeds are neighbours: no step shares its samples.
_SEEDS_APART = 1 << 20

#: Steps after which blocks that the surface has left are dropped.
_RESCAN = 50


class JointStage:
    """Adam on what parametrises the lattice fields, the material and the environment map.

    The subject's shape holds the starting geometry. For the first part of the stage only material and
    light move: geometry gradients mean nothing while the shading is wrong. If both are given, there is no
    such part. Where both are sought, the base colour's steps grow slowly: an image knows their product only,
    and what colours have taken up of the shading the light never gets back. Roughness and metallic do not
    wait: while they do, a light that is mirrored is sought as if it fell on plaster.

    Args:
        given: the scene with its targets.
        material: a ``GivenMaterial`` stays as it is.
        light: None keeps the scene's.
        config: what all stages know.
        stage: settings of the stage; default: those of the joint stage.
        name: of the stage.
        iterations: its steps; default: those of the joint stage.
        before: steps of stages whose random numbers those of this one follow.
        turns: (N, 3, 3) how the light has turned in each view; None if it stays.
    """

    def __init__(
        self,
        given: FitScene,
        material: MaterialField | GivenMaterial,
        light: EnvironmentLight | None,
        config: FitConfig,
        *,
        stage: JointConfig | None = None,
        name: str = "joint",
        iterations: int | None = None,
        before: int = 0,
        turns: np.ndarray | None = None,
    ):
        self.given, self.material, self.light, self.config = given, material, light, config
        self.stage, self.name = stage or config.joint, name
        self.iterations = config.iterations if iterations is None else iterations
        self._before = before
        self.subject = given.subject
        self.subject.set_bsdf(mi.load_dict(principled()))
        for name, field in material.values().items():
            self.subject.attach_attribute(name, field)
        self.scene = optimised_scene(given, light)
        self.parameters = mi.traverse(self.scene)
        self._turns = turns if light else None
        #: Per view the share of each pixel that is known, None if that is all. The rest is black in images.
        self._known = [
            None if target.is_known else mi.TensorXf(np.asarray(target.known)[..., None])
            for target in given.targets
        ]
        self._targets = [
            mi.TensorXf(target.rgba) if share is None else mi.TensorXf(target.rgba) * share
            for target, share in zip(given.targets, self._known, strict=True)
        ]
        self._sees_masks = all(target.has_alpha for target in given.targets) and not config.geometry_only
        if config.geometry_only:
            self.subject.shade_flat()
        self.integrator = mi.load_dict(
            {
                "type": "gshell_path",
                "max_depth": config.render.max_depth,
                "gradient_depth": config.render.gradient_depth,
                "reparam_depth": config.render.reparam_depth,
                "hide_emitters": True,
            }
        )
        resting = {"msdf"} if config.watertight else set()
        if not parametrisation_named(config.model.field).moves_weights:
            resting.add("weights")
        moving = [name for name in self.subject.field_names if name not in resting]
        start = {name: self.parameters[f"subject.{name}"] for name in moving}
        stage = self.stage
        rules = StepRules(
            stage.geometry_lr, stage.msdf_lr, stage.deform_lr, stage.geometry_smoothing, stage.geometry_detail
        )
        self.geometry = make_parametrisation(
            config.model.field, start, self.subject.lattice, rules, seed=config.seed
        )
        #: The lattice fields of the present step, with gradients enabled; none before the geometry moves.
        self.fields: dict[str, mi.Float] = {}
        self.material_optimizer = mi.ad.Adam(lr=stage.material_lr, params=material.parameters)
        # What a mean over all pixels says of one texel may be smaller than the epsilon that is usual.
        self.light_optimizer = TemperedAdam(
            lr=stage.light_lr, epsilon=1e-12, params={"log_radiance": light.log_radiance} if light else None
        )
        sought = material if material.parameters else None
        self._regularisers = Regularisers(StepView(given, self.scene, sought, light), config.losses)

    @property
    def optimizers(self) -> dict[str, mi.ad.Adam]:
        others = {"material": self.material_optimizer, "light": self.light_optimizer}
        return self.geometry.optimizers | others

    def step(self, iteration: int) -> dict[str, float]:
        """One step on ``render.views`` views; returns the losses.

        Raises:
            UserError: the steps before have left no surface.
        """
        given = not (self.material_optimizer.state or self.light_optimizer.state)
        moving = given or iteration >= self.stage.warmup * self.iterations
        with phase("scene update"):
            self.apply(geometry=moving)
        views = self._views(iteration)
        images, color, mask, sought = [], mi.Float(0), mi.Float(0), mi.Float(0)
        for turn, view in enumerate(views):
            image = self._render(view, self.seed(iteration, turn))
            with phase("losses") as compute:
                of_color, of_mask = self._image_loss(view, image), self._mask_loss(view, image)
                of_view = (of_color + self.config.losses.mask * of_mask) / len(views)
                compute(of_view)
            if self._turns is not None:
                # The light has to be where it was when the image is differentiated. If it stays, one pass
                # through the extraction serves all views.
                with phase("backward"):
                    dr.backward(of_view, flags=dr.ADFlag.ClearVertices)
            else:
                sought += of_view
            color, mask = color + dr.detach(of_color) / len(views), mask + dr.detach(of_mask) / len(views)
            images.append(dr.detach(image))
        with phase("losses") as compute:
            regularisation, terms = self._regularisers(views)
            total = color + self.config.losses.mask * mask + dr.detach(regularisation)
            sought += regularisation
            compute(total, sought)
        with phase("backward") as compute:
            if dr.grad_enabled(sought):
                dr.backward(sought)
            parameters = (self.fields, self.material_optimizer, self.light_optimizer)
            compute(*(dr.grad(value) for values in parameters for value in values.values()))
        progress = iteration / max(self.iterations, 1)
        with phase("optimiser"):
            diffuse = LatticeDiffusion(self.subject.lattice, cells=self.subject.surface.cells)
            if moving:
                gradients = {name: dr.grad(field) for name, field in self.fields.items()}
                self.geometry.step(gradients, progress, iteration, diffuse)
            self._step_material(progress, diffuse)
            self._step_light(progress)
        self._follow_surface(rescan=(iteration + 1) % _RESCAN == 0)
        error = mi.Float(
            sum(
                mean(dr.square(dr.detach(image)[..., :3] - self._targets[view][..., :3]))
                for view, image in zip(views, images, strict=True)
            )
            / len(views)
        )
        return {
            "loss": total[0],
            "image": color[0],
            "mask": mask[0],
            **{name: value[0] for name, value in terms.items()},
            "psnr": decibels(error[0]),
        }

    def seed(self, iteration: int, turn: int = 0) -> int:
        """Of the samples of a step's view; the next number is that of its gradient's."""
        turn += (self._before + iteration) * self.config.render.views
        return (self.config.seed * _SEEDS_APART + 2 * turn) % 2**32

    def finish(self) -> None:
        """Leaves the last step's parameters in the scene, without what noise has cut out or left floating."""
        self.apply(geometry=True)
        subject = self.subject
        self.parameters["subject.msdf"] = without_specks(
            subject.msdf, subject.template(), subject.lattice, self.config.topology.min_area
        )
        self.parameters.update()

    def moved_fields(self) -> LatticeFields:
        """The geometry, after ``finish``."""
        fields = self.subject.fields()
        return fields if fields.weights is None or fields.weights.any() else replace(fields, weights=None)

    def model(self) -> dict[str, np.ndarray]:
        """Material and light as a stage on a finer lattice starts from, as host arrays, after ``finish``."""
        arrays = {name: field.numpy() for name, field in self.material.parameters.items()}
        return arrays | ({"log_radiance": self.light.log_radiance.numpy()} if self.light else {})

    def preview(self) -> Preview:
        """The mesh of the last step in its base colour."""
        surface = self.subject.surface
        with dr.suspend_grad():
            colors = surface.interpolate(self.material.values()["vertex_color"], 3).numpy().T
            template_vertices, template_faces, _ = self.subject.template().to_numpy()
        vertices, faces, _ = surface.to_numpy()
        return Preview(vertices, faces, colors, template_vertices, template_faces)

    def _views(self, iteration: int) -> list[int]:
        """Those of a step: every view once per round, in an order that depends on seed and round alone."""
        count, views, each = len(self.given.sensors), [], self.config.render.views
        first = (self._before + iteration) * each
        for turn in range(first, first + each):
            order = np.random.default_rng((self.config.seed, turn // count)).permutation(count)
            views.append(int(order[turn % count]))
        return views

    def _render(self, view: int, seed: int) -> mi.TensorXf:
        config = self.config.render
        if self.light and self._turns is not None:
            self.parameters["light.to_world"] = self.light.turned(self._turns[view])
            self.parameters.update()
        with phase("render") as compute:
            image = mi.render(
                self.scene,
                self.parameters,
                sensor=self.given.sensors[view],
                integrator=self.integrator,
                spp=config.primal_spp,
                spp_grad=config.spp,
                seed=seed,
                seed_grad=seed + 1,
            )
            if (known := self._known[view]) is not None:
                image = image * known
            compute(image)
        return image

    def _image_loss(self, view: int, image: mi.TensorXf) -> mi.Float:
        return losses.IMAGE_LOSSES[self.config.losses.image](image[..., :3], self._targets[view][..., :3])

    def _mask_loss(self, view: int, image: mi.TensorXf) -> mi.Float:
        if not self._sees_masks:
            return mi.Float(0)
        return losses.mask_l2(image[..., 3], self._targets[view][..., 3])

    def apply(self, *, geometry: bool) -> None:
        """Puts what is optimised into the scene, with gradients enabled; the geometry only if asked."""
        if geometry:
            self.fields = self.geometry.fields()
            dr.enable_grad(self.fields)
            for name, field in self.fields.items():
                self.parameters[f"subject.{name}"] = field
        self.material.parameters = {name: self.material_optimizer[name] for name in self.material.parameters}
        for name, field in self.material.values().items():
            self.parameters[f"subject.lattice_{name}"] = field
        if self.light:
            self.light.log_radiance = self.light_optimizer["log_radiance"]
            self.light.update(self.parameters)
        self.parameters.update()
        if self.subject.surface.is_empty:
            raise UserError(
                f"The {self.name} stage has left no surface; start again with --overwrite and a smaller "
                f"--{self.name}.geometry-lr."
            )

    def _follow_surface(self, *, rescan: bool) -> None:
        """Moves the blocks that the fields are stored in, and all that is stored with them."""
        carried = self.subject.follow(rescan=rescan)
        if carried is None:
            return
        self.geometry.carry(carried)
        carried.optimizer(self.material_optimizer, self.material.on_lattice)
        self.material.carry(carried)

    def _step_material(self, progress: float, diffuse: LatticeDiffusion) -> None:
        config, optimizer = self.stage, self.material_optimizer
        if not optimizer.state:
            return
        # One derivative that is no number would spread over all others, and stay in the optimiser for good.
        gradients = {name: finite(dr.grad(optimizer[name])) for name in optimizer.keys()}
        gradients |= diffuse.together(
            {name: gradients[name] for name in self.material.on_lattice}, config.material_smoothing
        )
        for name, gradient in gradients.items():
            dr.set_grad(optimizer[name], gradient)
        rates = dict.fromkeys(optimizer.keys(), decay_at(progress) * config.material_lr)
        if self.light and progress < config.color_hold:
            rates["vertex_color"] *= (progress / config.color_hold) ** 2
        optimizer.set_learning_rate(rates)
        optimizer.step()

    def _step_light(self, progress: float) -> None:
        optimizer = self.light_optimizer
        if self.light is None or not optimizer.state:
            return
        gradient = finite(dr.grad(optimizer["log_radiance"]))
        dr.set_grad(optimizer["log_radiance"], gradient / self.light.solid_angles)
        optimizer.set_learning_rate(decay_at(progress) * self.stage.light_lr)
        optimizer.step()


def optimised_scene(given: FitScene, light: EnvironmentLight | None) -> mi.Scene:
    """The fit scene with the light to optimise in place of its own, and without its sensors."""
    return mi.load_dict({"type": "scene", "subject": given.subject, **other_objects(given, light)})


def other_objects(given: FitScene, light: EnvironmentLight | None) -> dict:
    """All of the fit scene but its gshell shape and its sensors, with the light to optimise."""
    objects = {"light": light.emitter() if light else given.light}
    for index, shape in enumerate(given.scene.shapes()):
        if shape is not given.subject:
            objects[f"shape_{index}"] = shape
    return objects
