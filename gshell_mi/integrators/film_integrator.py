"""What ``reparameterised_film`` needs of an integrator whose derivative it takes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

import drjit as dr
import mitsuba as mi

from ..arrays import AnyArray
from .path_sample import PathSample

if TYPE_CHECKING:
    from .edge_table import EdgeTable
    from .shadow_boundary import BoundaryTerm

OnSample: TypeAlias = "Callable[[mi.Spectrum, mi.Float, list[mi.Float]], Any]"
"""From radiance, coverage and output variables of samples to what the film makes of them; linear in them."""


class FilmIntegrator(Protocol):
    """An integrator with a differentiable film: ``gshell_path`` or ``gshell_mask``."""

    hide_emitters: bool
    warp_radius: float
    cull_hidden: bool
    crease_angle: float
    said: set[str]

    def aov_names(self) -> list[str]: ...

    def prepare(self, sensor: mi.Sensor, seed: int, spp: int, aovs: list[str]) -> tuple[mi.Sampler, int]: ...

    def primal(self, scene: mi.Scene, sampler: mi.Sampler, ray: mi.Ray3f) -> PathSample:
        """Radiance and coverage along camera rays."""
        ...

    def boundary_terms(
        self, scene: mi.Scene, tables: list[tuple[mi.Mesh, EdgeTable]], sensor: mi.Sensor, seed: int
    ) -> Iterable[BoundaryTerm]:
        """What moves over the film other than the silhouettes."""
        ...

    def replays(self, scene: mi.Scene) -> bool:
        """Whether ``attached`` needs to know the radiance and coverage of its samples beforehand."""
        ...

    def attached(
        self,
        mode: dr.ADMode,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: mi.Ray3f,
        state: PathSample | None,
        on_sample: OnSample,
        film_terms: Sequence[AnyArray] = (),
    ) -> tuple[Any, Any]:
        """Derivatives of camera paths: in reverse mode a ``Float`` that carries them, and the samples; in
        forward mode the channels' tangents, and those of ``film_terms``."""
        ...
