"""What a fit refuses before it starts, or warns of."""

from __future__ import annotations

from ..errors import UserError
from ..material import given_material
from ..parametrisation import parametrisation_named
from ..scene import FitScene
from .config import FitConfig
from .joint.regularisers import check_losses
from .judge import FEWEST_VIEWS


def check_names(config: FitConfig) -> None:
    """Whether everything exists that the settings name.

    Raises:
        UserError: there is no such parametrisation or loss.
    """
    parametrisation_named(config.model.field)
    check_losses(config.losses)


def notes_on_views(scene: FitScene) -> list[str]:
    """What is hardly meant so of the training views, a sentence each; often none."""
    if len(scene.targets) >= FEWEST_VIEWS:
        return []
    return [
        f"With fewer than {FEWEST_VIEWS} training views nothing tells a true change from an accident: "
        f"openings, hollows and moved parts of the visual hull stay as they are; give more views."
    ]


def check_given(scene: FitScene, config: FitConfig) -> None:
    """Whether the scene gives what the modes of the fit take from it.

    Raises:
        UserError: the material is to be kept, but there is none; the given fields hold no surface; a
            known light shall turn with the camera; or there is a second emitter.
    """
    others = [emitter.id() for emitter in scene.scene.emitters() if emitter.id() != "light"]
    if others:
        raise UserError(
            f"Scene '{scene.path}' has another emitter beside 'light' ('{others[0]}'); a fit "
            f"explains the images by one environment: take it out, and its light is found as "
            f"part of that."
        )
    if config.light_is_given and config.light_frame == "camera":
        mode = "--geometry-only" if config.geometry_only else "--known-light"
        raise UserError(
            f"{mode} keeps the light where the scene has it, and --light-frame camera turns it with "
            f"every view; leave one of them out."
        )
    if scene.subject.surface.is_empty:
        raise UserError(
            f"The fields '{scene.subject.filename}' of the gshell shape hold no surface; leave "
            f"'filename' out of '{scene.path}' or give others."
        )
    if config.material_is_given and not given_material(scene.bsdf):
        mode = "--geometry-only" if config.geometry_only else "--fixed-material"
        raise UserError(
            f"{mode} keeps the material of the gshell shape, but '{scene.path}' gives it no "
            f'uniform one; nest a <bsdf type="principled"> with base_color, roughness and '
            f"metallic."
        )
