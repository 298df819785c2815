"""How much memory a fit will take, said before it starts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .. import memory
from ..fields.thin_parts import thin_part_refinement
from ..lattice import make_lattice
from ..parametrisation import parametrisation_named
from .config import FitConfig

# Bytes, measured on llvm_ad_rgb: peak resident memory of short fits (all stages, a few steps each) with 32 to
# 128 cells, 12 to 100 views and 128 to 800 pixels per side. pipelines/calibrate_memory.py repeats it.
_PROGRAM = 280 * 2**20  # Python, Mitsuba, LLVM and its kernels
_ASSET = 350 * 2**20  # baking the textures of mesh.glb
_PER_PIXEL = 88  # of all targets: NumPy's copy, pools of stages and judge, outlines
_PER_CORRECTED = 16  # of all targets once more, if their exposures differ
_PER_VERTEX = 490  # of the lattice: fields and material, their Adam moments and gradients
_PER_HULL_SAMPLE = 75  # of the visual hull, which is finer than the lattice, and ...
_PER_VOTE = 4  # ... what it keeps there per view that has to see daylight
_PER_SQUARE_CELL = 37_000  # resolution squared, as the surface grows: meshes, edge lists, derivatives
_PER_WEIGHT = 20  # of FlexiCubes, if they are optimised: its gradient and Adam's moments, too ...
_WEIGHTS_PER_SQUARE_CELL = 900  # ... where only blocks around the surface have some
_PER_RAY = 300  # that a step of the stages up to the volume follows
_PER_TEXEL = 100  # of the light: its values, gradient, Adam's moments and the table it is sampled by
_PER_SIGHTING = 160  # of a place of the surface that poses compare, by one of all views: a third sees it
_PER_SQUARE_VOXEL = 19_000  # of the radiance volume's side squared: a tablecloth fills 57 voxels each, of 340


@dataclass(frozen=True)
class MemoryEstimate:
    """Peak memory of a fit in bytes, by what takes it.

    Attributes:
        program: what every fit takes, whatever its size.
        hull: the visual hull, gone before the samples come.
        lattice: fields and the surface in them.
        targets: the images.
        samples: one rendered view.
        volume: the radiance volume, gone before the samples come.
        rays: those that a step follows at once, and places that are compared.
        light: the environment map.
    """

    program: int
    hull: int
    lattice: int
    targets: int
    samples: int
    volume: int
    rays: int
    light: int

    @classmethod
    def of(
        cls, config: FitConfig, resolution: int, sizes: np.ndarray, *, grid: str = "tet", report: bool = True
    ) -> MemoryEstimate:
        """Estimates it.

        Args:
            config: the settings.
            resolution: cells per side of the lattice.
            sizes: (N, 2) width and height of the views in pixels.
            grid: the kind of lattice.
            report: whether mesh.glb and report.html are written.

        >>> few, many = (MemoryEstimate.of(FitConfig(), 64, np.full((n, 2), 256)) for n in (24, 48))
        >>> many.targets == 2 * few.targets and many.hull > few.hull and many.lattice == few.lattice
        True
        """
        # Fields in blocks follow the surface.
        whole, early = resolution, min(resolution, config.lattice.start_resolution)
        moves = parametrisation_named(config.model.field).moves_weights
        weights = make_lattice(grid, resolution).weight_count if moves else 0
        if resolution >= config.lattice.band_resolution and make_lattice(grid, 1).fits_in_blocks:
            whole = min(resolution, config.lattice.start_resolution)
            weights = min(weights, _WEIGHTS_PER_SQUARE_CELL * resolution**2)
        vertices = make_lattice(grid, whole).vertex_count
        pixels = np.asarray(sizes, np.int64).prod(axis=1)
        corrected = _PER_CORRECTED if config.exposures == "find" else 0
        votes = config.hull.daylight_votes * len(pixels)
        hull_samples = (thin_part_refinement(early) * early + 1) ** 3
        return cls(
            program=_PROGRAM + (_ASSET if report else 0),
            hull=int((_PER_HULL_SAMPLE + _PER_VOTE * votes) * hull_samples),
            lattice=_PER_VERTEX * vertices + _PER_SQUARE_CELL * resolution**2 + _PER_WEIGHT * weights,
            targets=(_PER_PIXEL + corrected) * int(pixels.sum()),
            samples=memory.PER_SAMPLE * int(pixels.max()) * max(config.render.primal_spp, config.render.spp),
            volume=_PER_SQUARE_VOXEL * config.volume.side**2 if config.volume.iterations else 0,
            rays=max(
                _PER_RAY * config.radiance.batch,
                *(_PER_RAY * fog.batch for fog in (config.cavities, config.volume) if fog.iterations),
                _PER_SIGHTING * config.cameras.places * len(pixels) if config.poses == "refine" else 0,
            ),
            light=_PER_TEXEL * 2 * config.model.light_height**2,
        )

    @property
    def total(self) -> int:
        joint = self.lattice + self.samples + self.light
        return self.program + self.targets + max(self.hull, self.volume, self.rays, joint)

    def require(self, free: int | None) -> None:
        """Refuses, by a ``UserError`` that says what to lower, a fit that needs more than ``free`` bytes."""
        cures = {
            "program": "close other programs",
            "hull": "lower --resolution or use fewer views",
            "lattice": "lower --resolution",
            "targets": "use fewer or smaller views (--max-size of the import)",
            "volume": "lower --volume.side",
            "rays": "lower --radiance.batch, --cavities.batch, --volume.batch and --cameras.places",
            "light": "lower --model.light-height",
            "samples": "lower --render.primal-spp and --render.spp, or use smaller views (--max-size of the "
            "import)",
        }
        largest = max(cures, key=lambda name: getattr(self, name))
        share = getattr(self, largest) / memory.GIB
        memory.require(self.total, free, "The fit", f"{cures[largest]}, which makes up {share:.1f} GiB")
