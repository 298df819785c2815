"""Openings: where the closed hull is open in truth, found by a radiance with opacity on its two sides.

Where it opens the wrong place it sees through it, and learns nothing of what is beside and behind. With a
trouser leg open at its back, the cap at its end explains the few views that see in as well as the dark
inside, which is not there. So if some of what it opens is not justified, it is trained once more, from where
it is opaque there and open where that is justified; and as long as that finds further openings, again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated

import drjit as dr
import mitsuba as mi
import numpy as np

from ... import losses
from ...activations import sigmoid, softplus
from ...bounds import Between
from ...images import decibels
from ...means import mean
from ...pixels import FAINT
from ...preview import Preview
from ...radiance.shown import Mesh, Shown
from ...radiance.surface_radiance import SurfaceRadiance
from ...schedules import decay_at
from ...template.msdf import clean_opacity, msdf_from_template
from ...template.sides import THIN
from ..acceptance import LEVELS, close_rejected, close_shallow, open_rejected
from ..appearance import radiance_on
from ..judge import Judge
from ..runner import Steps
from ..stage import Fit
from ..surface import Seen, Surface
from ..template import template_of

#: Logit, at most, of what has been justified before.
_OPEN = -1.0


@dataclass(frozen=True)
class OpeningsConfig:
    """Openings of the hull, by radiance and opacity."""

    iterations: Annotated[int, Between(1)] = 400
    """Steps that find where the hull is open."""
    mask: float = 0.003
    """Weight of the mask loss. The image loss also sees the mask; a large weight closes every cap before
    the images can open it."""
    daylight: float = 0.1
    """Weight of coverage where a mask shows daylight through the template: proof of openings, unlike the rest
    of the mask."""
    binary: float = 0.01
    """Final weight of the loss that makes opacity decide; ramps up over the second half."""
    closing: float = 0.0005
    """Final weight of the loss that closes what the images leave undecided."""
    chroma: float = 0.003
    """Weight of the tie between the chroma of a sheet's two sides."""
    rounds: int = 3
    """How often, at most, the steps are done again for what wrong openings have hidden."""
    revise: bool = True
    """Ask once more when the joint stage has moved the surface, and at the end how far openings reach;
    --openings.no-revise: do neither."""


class Openings:
    """Cuts the surface open where the images justify it, and finds its radiance."""

    name = "openings"

    def __init__(self, config: OpeningsConfig):
        self.config = config

    def run(self, fit: Fit, surface: Surface, steps: Steps) -> Surface:
        """The surface with openings, and what was seen of it."""
        whole = surface.with_fields(msdf=np.ones_like(surface.fields.sdf))
        template = template_of(fit.scene.subject, whole)
        vertices, faces, count = template.vertices, template.faces, self.config.iterations
        closed = fit.judge.shown(template.closed)
        appearance = radiance_on(fit, template.closed, closed)
        training = OpacityTraining(appearance, self.config)
        if not fit.config.watertight:
            steps.run(training, count, {"radiance": appearance.optimizer})
        with steps.task("verdict"):
            logits = np.ones(len(vertices))
            if not fit.config.watertight:
                min_area = fit.config.topology.min_area
                logits = find_openings(
                    appearance,
                    closed,
                    fit.judge,
                    self.config.rounds,
                    THIN * fit.cell(surface),
                    lambda logits: clean_opacity(logits, vertices, faces, min_area),
                    lambda again: steps.repeat(training, count, again * count),
                )
            opened = logits <= 0
            (appearance.refit_anew if fit.config.watertight else appearance.refit)(~opened)
        front, _ = appearance.radiance()
        msdf = msdf_from_template(logits, template.mesh, surface.lattice)
        seen = Seen.on(surface.lattice, template.mesh, front, Seen.even_light(front[~opened]))
        return replace(surface.with_fields(msdf=msdf.numpy()), seen=seen)


class OpacityTraining:
    """Trains opacity and radiance together, on random pixels of all views."""

    def __init__(self, appearance: SurfaceRadiance, config: OpeningsConfig):
        self.appearance, self.config = appearance, config

    def step(self, iteration: int) -> dict[str, float]:
        """One Adam step on a batch of random pixels; returns the losses."""
        config, appearance = self.config, self.appearance
        progress = iteration / config.iterations
        sample, radiance, alpha, _ = appearance.render(iteration)
        share, weight = appearance.pixels.share, appearance.pixels.mask_weight
        image = share * losses.l1(appearance.tone(radiance), appearance.tone(sample.radiance))
        mask = share * losses.mask_l2(alpha, sample.alpha)
        # Where a mask shows daylight within the hull, every sheet on the ray is open: no doubt, no balance.
        daylight = share * losses.mask_l2(dr.select(sample.alpha < FAINT, alpha, 0), 0)
        opacity = sigmoid(appearance.optimizer["opacity"])
        front, back = (softplus(side) for side in appearance.sides())
        # Undecided opacity must have its say first; only then is it made to decide.
        late = dr.opaque(mi.Float, max(0.0, 2 * progress - 1))
        total = (
            image
            + weight(config.mask) * mask
            + weight(config.daylight) * daylight
            + late * config.binary * losses.binary_entropy_bound(opacity)
            + late * config.closing * losses.transparency(opacity)
            + config.chroma * losses.chroma_difference(front, back)
        )
        dr.backward(total)
        appearance.update(("opacity", "radiance"), appearance.config.lr * decay_at(progress))
        error = share * mean(dr.square(dr.detach(radiance) - sample.radiance))
        return {"loss": total[0], "image": image[0], "mask": mask[0], "psnr": decibels(error[0])}

    def preview(self) -> Preview:
        """What is not clearly fading."""
        return self.appearance.preview()


def justified(
    smoothed: np.ndarray,
    logits: np.ndarray,
    clean: Callable[[np.ndarray], np.ndarray],
    judged: Callable[[np.ndarray], np.ndarray],
) -> np.ndarray:
    """Openings, proposed at one level of opacity after the other.

    Args:
        smoothed: (V,) opacity logits that propose.
        logits: (V,) negative where the surface is open already.
        clean: as of ``find_openings``.
        judged: gives (V,) proposed logits that say yes only to what is justified.

    Returns:
        (V,) logits, negative at openings.
    """
    levels = 0
    for level in LEVELS:
        # Openings of the levels before, and what is as transparent as this one.
        candidate = clean(np.minimum(logits, smoothed - level))
        if not ((candidate <= 0) & (logits > 0)).any():
            continue
        found = clean(judged(candidate))
        levels += bool(((found <= 0) & (logits > 0)).any())
        # What was proposed may have run together with what is rejected now.
        logits = np.minimum(logits, found)
        if ((found <= 0) == (candidate <= 0)).all():
            break
    # Those of one level have not been judged beside those of the next ones, through which they may be seen.
    return clean(judged(logits)) if levels > 1 else logits


def further_openings(
    template: Mesh,
    values: np.ndarray,
    proposed: np.ndarray,
    min_area: float,
    judged: Callable[[np.ndarray], np.ndarray],
) -> np.ndarray:
    """``justified``, beside openings that stay as they are.

    Args:
        template: closed.
        values: (V,) negative where it is open.
        proposed: (V,) opacity logits.
        min_area: of new openings, and of new islands, as of ``clean_opacity``.
        judged: as of ``justified``.

    Returns:
        (V,) values, negative at all openings.
    """
    given = values <= 0

    def clean(logits: np.ndarray) -> np.ndarray:
        return np.where(given, values, clean_opacity(np.where(given, values, logits), *template, min_area))

    return justified(proposed, np.where(given, values, np.abs(proposed)), clean, judged)


def find_openings(
    appearance: SurfaceRadiance,
    template: Shown,
    judge: Judge,
    rounds: int,
    thickness: float,
    clean: Callable[[np.ndarray], np.ndarray],
    train: Callable[[int], None],
) -> np.ndarray:
    """Where the images justify an opening.

    Args:
        appearance: after its training; it is trained further.
        template: that it is on, closed.
        judge: of the fit.
        rounds: in which it is trained again, at most.
        thickness: of thin parts, at most, world units.
        clean: undoes what cannot be meant in (V,) logits: cuts and islands that are too small, as
            ``clean_opacity`` does.
        train: does all steps of its training; told for which time, after the first, from 1.

    Returns:
        (V,) opacity logits, negative at openings.
    """
    opened, unjustified = (np.zeros(appearance.vertex_count, bool) for _ in range(2))
    for trained_again in range(rounds + 1):
        if trained_again:
            appearance.begin_again(unjustified, opened)
            train(trained_again)
        smoothed = appearance.smoothed_logits()
        proposed = clean(np.where(opened, np.minimum(smoothed, _OPEN), smoothed))
        logits = np.where(opened, _OPEN, np.abs(smoothed))
        logits = justified(
            smoothed,
            logits,
            clean,
            lambda candidate: open_rejected(
                clean(close_rejected(candidate, template, judge, template.whole)), template, judge
            ),
        )
        logits = clean(close_shallow(logits, template, judge, thickness))
        # A close call may come out otherwise now.
        logits = np.where(opened, np.minimum(logits, _OPEN), logits)
        unjustified |= (proposed <= 0) & (logits > 0)
        # Rims differ a little each time.
        further = clean(np.where((logits <= 0) & ~opened, -1.0, 1.0)) <= 0
        opened = logits <= 0
        if not unjustified.any() or (trained_again and not further.any()):
            break
    return logits
