"""The fit from top to bottom: its stages, each of which starts where the one before has ended."""

from __future__ import annotations

from ..parametrisation import parametrisation_named
from ..scene import FitScene
from .config import FitConfig
from .lattices import Lattices
from .stage import Stage
from .stages.cavities import Cavities
from .stages.exposures import Exposures
from .stages.fine_folds import FineFolds
from .stages.hull import Given, Hull
from .stages.joint import Joint
from .stages.light_frame import LightFrame
from .stages.occlusion import Occlusion
from .stages.openings import Openings
from .stages.poses import Poses
from .stages.refinement import Refinement
from .stages.revision import Revision
from .stages.revoxelise import Revoxelise
from .stages.rims import Rims
from .stages.smoothing import Smoothing
from .stages.texture import Texture
from .stages.volume import Volume


def pipeline(scene: FitScene, lattices: Lattices, config: FitConfig) -> list[Stage]:
    """The stages of a fit.

    Args:
        scene: may give the fields to start from.
        lattices: that the stages work on.
        config: the settings.
    """
    given = bool(scene.subject.filename)
    start: list[Stage] = [Given()]
    if not given:
        start = [
            *([Occlusion(config.occlusion)] if config.occlusion.most else []),  # masks that are wrong
            Hull(config.hull),  # what the masks leave
        ]
    if config.light_frame == "find" and not config.light_is_given:
        start.append(LightFrame(config.gains))  # whether the light turns with the camera
    found = config.exposures == "find" and not config.geometry_only
    exposures: list[Stage] = [Exposures(config.gains)] if found else []
    if given and not Given.is_closed(scene, lattices, config):
        start += exposures  # a gain for each view
    else:
        start += [
            Openings(config.openings),  # where the hull is open
            *exposures,
            Cavities(config.cavities),  # what the hull bridges
            Refinement("refinement", config.refinement, first=True),  # moves whole parts ...
            Refinement("folds", config.folds, first=False),  # ... then details
            Revoxelise(),  # fields of what has moved
        ]
    if config.volume.iterations and not given:
        start += [
            Volume(config.volume),  # another start, if it is better
            FineFolds(config.folds),  # details that its lattice holds
        ]
    # Networks are not tied to a lattice: theirs is the last one from the start.
    explicit = parametrisation_named(config.model.field).is_explicit
    refines = config.poses == "refine"
    posed = [Poses("poses", config.cameras)] if refines else []
    aligned = [Poses("alignment", config.cameras, last=True)] if refines else []
    revises = config.openings.revise and not (given or config.watertight)
    if config.iterations and config.detail.iterations and explicit:
        start += [
            Joint("joint", config.joint, config.iterations, lattices.late),  # shape, material and light
            *posed,  # corrects the cameras
            *([Revision(config.openings)] if revises else []),  # what is open after all
            Joint(  # the same on the last lattice
                "detail", config.detail, config.detail.iterations, before=config.iterations
            ),
            *aligned,  # further, by what is better now
            *([Rims(config.openings)] if revises else []),  # where openings end
        ]
    else:
        start.append(Joint("joint", config.joint, config.iterations, lattices.last))
    if config.iterations and config.smoothing.most:
        start.append(Smoothing(config.smoothing))  # what bumps are noise
    if config.iterations and config.texture.rounds:
        start.append(Texture(config.texture))  # colours as fine as the images
    return start
