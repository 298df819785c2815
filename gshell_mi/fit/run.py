"""The fit from start to end, with checkpoints: hull, ghost, carving, refinement, folds, joint and detail
stage, export."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np
import trimesh

from ..errors import UserError
from ..export import FitFolder, export_fit, write_metrics
from ..export.asset import write_asset
from ..fields import LatticeFields
from ..fields.interpolation import Interpolation
from ..fields.lattice_fields import closed_at_border
from ..fields.thin_parts import thickened, thin_part_refinement
from ..fields.visual_hull import visual_hull
from ..interrupt import Interrupt
from ..lattice import CubeLattice, Lattice, make_lattice
from ..memory import GIB, free_memory_of_variant, peak_memory
from ..report import write_report
from ..scene import load_fit_scene
from ..scene_inputs import scene_inputs
from ..topology import topology
from ..triangles import positive_part
from ..views import PinholeViews
from .bookkeeping.bookkeeping import Bookkeeping, checkpoint_path
from .bookkeeping.checkpoint import Checkpoint, optimizer_arrays, restore_optimizer
from .bookkeeping.fingerprint import check_fingerprint, fingerprint
from .bookkeeping.observer import Observer
from .bookkeeping.progress import Progress
from .carving.carving import carve
from .carving.radiance_volume import RadianceVolume as Fog
from .carving.vessels import hollowed_vessels
from .config import FitConfig, default_output
from .cut.recast import recast
from .cut.spare_sides import Cut, without_spare_sides
from .cut.unseen import without_unseen
from .findings import findings
from .ghost.ghost_template import GhostTemplate, closed_template, ghost_template
from .ghost.opening import clean_opacity, msdf_from_template, splat_to_lattice
from .ghost.pixels import PixelPool
from .ghost.radiance_ghost import RadianceGhost
from .ghost.rounds import find_openings
from .joint.depth import check_depth
from .joint.field_fitting import FieldFitting
from .joint.joint import JointStage
from .joint.second_look import SecondLook
from .judge import judge
from .memory import MemoryEstimate
from .radiance.volume import RadianceVolume
from .radiance.volume_surface import volume_surface
from .refinement.rounds import Moved, RefinementRounds
from .start import (
    EARLY_GRIDS,
    TYPICAL_REFLECTANCE,
    block_arrays,
    check_given,
    fit_lattice,
    start_fields,
    start_light,
    start_material,
    volume_lattice,
)

#: What the joint stage starts from.
_SURFACE = ("sdf", "msdf", "radiance", "known")

#: Every eighth view is kept from the refinement and judges it.
_HOLD_OUT = 8


@dataclass(frozen=True)
class FitResult:
    """What a fit leaves behind.

    Attributes:
        output: the folder.
        metrics: the contents of ``metrics.json``.
    """

    output: Path
    metrics: dict


def fit_scene(scene: str | Path, output: str | Path | None = None, *, targets: str | Path | None = None,
              config: FitConfig | None = None, resume: bool = False, overwrite: bool = False,
              report: bool = True, quiet: bool = True, observer: Observer | None = None) -> FitResult:
    """Reconstructs the gshell shape of a fit scene, its material and its light.

    A Mitsuba ``llvm`` or ``cuda`` variant must be set.

    Args:
        scene: the fit scene's XML file.
        output: the folder to write; default ``out/<scene stem>``.
        targets: folder of the target images; default beside the XML.
        config: settings.
        resume: continue from the checkpoint in ``output``.
        overwrite: replace an earlier fit in ``output``.
        report: also write ``mesh.glb`` and ``report.html``.
        quiet: no progress bar.
        observer: is told of every step, such as ``viewer.Viewer``.

    Raises:
        UserError: of anything that the user can mend.
    """
    config = config or FitConfig()
    scene = Path(scene)
    output = Path(output) if output else default_output(scene)
    with (Interrupt() as interrupt, Progress(quiet=quiet) as progress,
          FitFolder(output, resume=resume, overwrite=overwrite) as folder):
        fit = _Fit(scene, folder, targets, config, resume, report, progress, interrupt, observer)
        metrics = fit.run()
        return FitResult(output, metrics)


class _Fit:
    def __init__(self, scene: Path, folder: FitFolder, targets: str | Path | None, config: FitConfig,
                 resume: bool, report: bool, progress: Progress, interrupt: Interrupt,
                 observer: Observer | None):
        self.config, self.folder, self.report = config, folder, report
        self.output = output = folder.place
        self.progress, self.interrupt = progress, interrupt
        self.checkpoint = Checkpoint("hull", 0, _plain(config))
        if resume:
            self.checkpoint = Checkpoint.load(checkpoint_path(output))
            _same_config(self.checkpoint.config, _plain(config))
        self.books = Bookkeeping(output, self.checkpoint, config.checkpoint_seconds, progress, interrupt,
                                 observer)
        with progress.stage("targets", None):
            self.scene = load_fit_scene(scene, Path(targets) if targets else None,
                                        before_targets=self._check_memory, on_reference=progress.reference)
            self.views = PinholeViews.from_sensors(self.scene.sensors)
            check_given(self.scene, config)
            check_depth(self.scene, self.views)
            self.last_lattice = last = fit_lattice(self.scene.subject, config)
            found = fingerprint(self.scene, last)
            if resume:
                check_fingerprint(self.checkpoint.inputs, found)
            self.checkpoint.inputs = found
            folder.check(scene_inputs(scene) | self.scene.target_files, self.views.ids)
        if not all(target.has_alpha for target in self.scene.targets):
            progress.warn("some targets have no alpha: coverage is taken as 1 and the mask losses are off.")
        for note in self.scene.notes:
            progress.warn(note)
        # Given fields may have detail that no coarser lattice holds.
        coarse = last.resolution if self.scene.subject.filename else config.start_resolution
        self.lattice = make_lattice(EARLY_GRIDS[last.grid], min(last.resolution, coarse))
        # The same vertices, but joined as in the end.
        self.late_lattice = make_lattice(last.grid, self.lattice.resolution)
        # Networks are not tied to a lattice: theirs is the last one from the start.
        steps = config.iterations and config.detail_iterations and config.field == "explicit"
        self.joint_lattice = self.late_lattice if steps else last
        self.pixels = PixelPool(self.views, self.scene.targets)
        # Nothing is written before all is known to be in order.
        folder.prepare()
        if observer:
            observer.begin(self.scene)

    def run(self) -> dict:
        """Returns the metrics."""
        try:
            if self.checkpoint.stage == "hull":
                self._hull()
            self.books.rewind_log()
            if self.checkpoint.stage == "ghost":
                self._ghost()
            if self.checkpoint.stage == "carving":
                self._carve()
            if self.checkpoint.stage in ("refinement", "folds"):
                self._refine()
            if self.checkpoint.stage == "volume":
                self._volume()
            joint = self._joint()
            self.interrupt.check()
            with self.progress.stage("export", None), self.books.timed("export"):
                metrics = export_fit(self.output, self.scene, joint.material, joint.light,
                                     self.config.triptychs, joint.detail)
                metrics["config"] = _plain(self.config)
                metrics |= findings(self.scene, self.views, joint.scene, self.progress.warn)
                metrics["warnings"] = self.progress.warnings
            metrics = self._write_metrics(metrics)
            if self.report:
                self._write_documents()
                metrics = self._write_metrics(metrics)
            self.folder.finish()
        except OSError as error:
            raise UserError(f"'{error.filename or self.output}' cannot be written "
                            f"({error.strerror or error}); free some space or mend its permissions, then "
                            f"continue with --resume.") from error
        return metrics

    def _check_memory(self, subject: mi.Shape, sensors: list[mi.Sensor]) -> None:
        """Says how much memory the fit needs, and refuses it if that much is not free."""
        sizes = np.array([sensor.film().crop_size() for sensor in sensors])
        lattice = fit_lattice(subject, self.config)
        if self.config.volume_iterations and not subject.filename:
            lattice = volume_lattice(lattice, self.config)
        self.memory = MemoryEstimate.of(self.config, lattice.resolution, sizes, grid=lattice.grid,
                                        report=self.report)
        free = free_memory_of_variant()
        told = "" if free is None else f"; {free / GIB:.1f} GiB are free"
        self.progress.tell(f"memory: about {self.memory.total / GIB:.1f} GiB{told}")
        self.memory.require(free)

    # --- stages

    def _hull(self) -> None:
        if self.scene.subject.filename:
            self._start_from_file()
            return
        with self.progress.stage("visual hull", len(self.views)) as advance, self.books.timed("hull"):
            to_world = mi.Transform4f(self.scene.subject.to_world)
            finer = thin_part_refinement(self.lattice.resolution)
            samples = CubeLattice(finer * self.lattice.resolution)
            points = to_world @ mi.Point3f(samples.points(mi.Float))
            world = visual_hull(points, self.views, [target.rgba[..., 3] for target in self.scene.targets],
                                daylight_votes=self.config.hull_daylight_votes, progress=advance)
            cell = self.lattice.spacing
            solid = np.clip(world.numpy() / self.scene.subject.length_scale, -1, 1) / cell
            grown = thickened(solid.reshape((samples.stride,) * 3), finer)
            vertices = self.lattice.points(mi.Float)
            sdf, hull = (Interpolation(mi.Float(cell * field.ravel()), samples)(vertices).numpy()
                         for field in (grown, solid))
            sdf, hull = (closed_at_border(field, self.lattice) for field in (sdf, hull))
        if not (sdf < 0).any():
            raise UserError(
                f"The masks of the targets have no common volume in the box of '{self.scene.path}'; check "
                f"the cameras, the alpha of the targets and the gshell shape's to_world.")
        self.books.enter("ghost", sdf=sdf, hull=hull)

    def _start_from_file(self) -> None:
        """Starts from the fields that the scene's gshell shape was given, openings included."""
        fields = self.scene.subject.fields().to_lattice(self.lattice.resolution, self.lattice.grid)
        if self.config.watertight or (fields.msdf > 0).all():
            self.books.enter("ghost", sdf=fields.sdf, hull=fields.sdf)
            return
        count = self.lattice.vertex_count
        brightness = self.pixels.mean_radiance()
        self.books.enter("joint", sdf=fields.sdf, msdf=fields.msdf, deform=fields.deform,
                         radiance=np.zeros((count, 3), np.float32), known=np.zeros(count, bool),
                         light=np.float32(brightness / TYPICAL_REFLECTANCE))

    def _ghost(self) -> None:
        """Finds the openings of the template, and its radiance."""
        state = self.checkpoint.arrays
        closed = dict(state) | {"msdf": np.ones_like(state["sdf"])}
        template = ghost_template(self.scene.subject, closed, self.lattice)
        vertices, faces = template.vertices, template.faces
        ghost = RadianceGhost(template.start, faces, self.views, self.pixels, self.config)
        count = self.config.ghost_iterations
        if not self.config.watertight:
            self.books.iterate("ghost", count, ghost, {"ghost": ghost.optimizer}, state)
        with self.progress.stage("openings", None), self.books.timed("ghost"):
            logits = np.ones(len(vertices))
            if not self.config.watertight:
                logits = find_openings(ghost, vertices, faces, lambda again: self.books.repeat(
                    "ghost", count, ghost, first=again * count))
            opened = logits <= 0
            ghost.refit(~opened)
        if opened.all():
            raise UserError(f"The radiance ghost found nothing opaque in '{self.scene.path}'; give it more "
                            f"steps with --ghost-iterations, or check the cameras.")
        front, _ = ghost.radiance()
        msdf = msdf_from_template(logits, template.mesh, self.lattice)
        radiance, known = splat_to_lattice(mi.Float(front.ravel()), template.mesh, self.lattice)
        light = float(np.median(front[~opened].mean(axis=1)))
        radiance = radiance.numpy().reshape(-1, 3)
        self.books.enter("carving", sdf=state["sdf"], hull=state["hull"], msdf=msdf.numpy(),
                         radiance=radiance, known=known.numpy(),
                         light=np.float32(light / TYPICAL_REFLECTANCE))

    def _carve(self) -> None:
        """Hollows out what the hull bridges."""
        count = self.config.carving_iterations
        carved = None
        # The volume lives on a lattice of cubes.
        cubes = self.lattice.vertex_count == self.lattice.stride**3
        if cubes:
            known, unknown = self._split_pixels()
            if self.checkpoint.iteration == 0:
                self._hollow_vessels(known, unknown)
        state = self.checkpoint.arrays
        if cubes and count:
            _, vertices, faces = closed_template(self.scene.subject, state["hull"], self.lattice)
            volume = Fog(state["hull"].reshape((self.lattice.stride,) * 3), vertices, faces,
                                    self.scene.subject.to_world, self.views, known, self.config,
                                    self.checkpoint.iteration)
            self.books.iterate("carving", count, volume, volume.optimizers, state)
            with self.progress.stage("hollows", None), self.books.timed("carving"):
                carved = carve(self.scene.subject, state, self.lattice, volume, known, unknown)
        self.checkpoint.facts["carved"] = carved is not None
        kept = {name: state[name] for name in ("hull", *_SURFACE)}
        self.books.enter("refinement", **(kept | (carved or {})), light=state["light"])

    def _hollow_vessels(self, known: PixelPool, unknown: PixelPool) -> None:
        """Makes hollows of the openings that are no openings but mouths of vessels."""
        state = self.checkpoint.arrays
        with self.progress.stage("vessels", None), self.books.timed("carving"):
            hollowed = hollowed_vessels(self.scene.subject, state, self.lattice, self.views, known, unknown,
                                        self.config)
        self.checkpoint.facts["vessel"] = hollowed is not None
        if hollowed:
            self.checkpoint.arrays = state | hollowed

    def _refine(self) -> None:
        """Moves the template inside the hull, and the fields with it."""
        state = self.checkpoint.arrays
        template = ghost_template(self.scene.subject, state, self.late_lattice)
        rounds = []
        if self.config.refinement_iterations:
            rounds = RefinementRounds(template, self.scene, self.views, *self._split_pixels(), self.config,
                                      self.books).run(state)
        # Without a refinement, what was grown for being thin shrinks back.
        radiance = template.mesh.interpolate(mi.Float(state["radiance"].ravel()), 3).numpy().T
        found, taken = {name: state[name] for name in _SURFACE}, "start"
        with self.books.timed("refinement"):
            for moved in (*rounds, Moved("start", template.start, radiance, np.inf)):
                if fields := self._recast(template, moved):
                    found, taken = fields, moved.stage
                    break
        facts = self.checkpoint.facts
        facts["refinement_kept"] = taken != "start"
        if rounds and self.config.folds_iterations:
            facts["folds_kept"] = taken == "folds"
        volume = self.config.volume_iterations and not self.scene.subject.filename
        self.books.enter("volume" if volume else "joint", **found | self._without_unseen(found),
                         light=state["light"])

    def _volume(self) -> None:
        """Starts the joint stage from the surface of a radiance volume if unseen views tell for it."""
        state, subject, config = self.checkpoint.arrays, self.scene.subject, self.config
        subject.set_fields(self._fields(state))
        surface = subject.surface.to_numpy()[:2]
        volume = self._radiance_volume(state, surface)
        self.books.iterate("volume", config.volume_iterations, volume, volume.optimizers, state,
                           volume.arrays)
        with self.progress.stage("depth maps", len(self.views)) as advance, self.books.timed("volume"):
            lattice = self._volume_lattice()
            found = volume_surface(volume, self.scene, lattice, advance)
            moved = found and Moved("volume", found.positions, found.radiance, np.inf)
            fields = found and self._recast(found.template, moved)
        kept = {name: state[name] for name in _SURFACE} | {"light": state["light"]}
        if fields:
            with self.progress.stage("verdict", None), self.books.timed("volume"):
                subject.set_fields(self._fields(fields))
                verdict = judge(_as_fine(surface, subject.cell_size), subject.surface.to_numpy()[:2],
                                self.views, self.scene.targets, config)
            self.checkpoint.facts["volume"] = dataclasses.asdict(verdict)
            self.checkpoint.facts["volume_kept"] = verdict.accepted
            if verdict.accepted:
                kept |= fields | self._without_unseen(fields)
        self.books.enter("joint", **kept)

    def _radiance_volume(self, state: Mapping[str, np.ndarray],
                         surface: tuple[np.ndarray, np.ndarray]) -> RadianceVolume:
        """A radiance volume inside the visual hull, or that of the checkpoint."""
        side, subject = RadianceVolume.first_side(self.config), self.scene.subject
        centre = (np.arange(side, dtype=np.float32) + 0.5) * (2 / side) - 1
        z, y, x = (axis.ravel() for axis in np.meshgrid(centre, centre, centre, indexing="ij"))
        points = mi.Transform4f(subject.to_world) @ mi.Point3f(x, y, z)
        hull = visual_hull(points, self.views, [target.rgba[..., 3] for target in self.scene.targets])
        hull = np.clip(hull.numpy() / subject.length_scale, -1, 1).reshape((side,) * 3)
        return RadianceVolume(hull, subject.to_world, self.views, self.pixels, self.config, surface, state)

    def _volume_lattice(self) -> Lattice:
        """What the joint stage has if it starts from the volume."""
        return volume_lattice(self.last_lattice, self.config)

    def _fields(self, arrays: Mapping[str, np.ndarray]) -> LatticeFields:
        closed = LatticeFields.closed(arrays["sdf"], self.last_lattice.grid)
        return dataclasses.replace(closed, msdf=arrays["msdf"])

    def _recast(self, template: GhostTemplate, moved: Moved) -> dict[str, np.ndarray] | None:
        """Fields of a moved template, cut as well as can be; None if no cut comes out whole, or it has not
        moved."""
        if (moved.positions == template.vertices).all():
            return None
        for cut in self._cuts(template, moved.positions):
            fields = recast(self.scene.subject, template.vertices, cut.positions, template.faces, cut.logits,
                            moved.radiance, self.config.ghost_min_area, cut.topology, cut.fewest_loops)
            if fields:
                return fields
        return None

    def _without_unseen(self, surface: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """The mSDF that cuts away what no view sees, if there is such."""
        if self.config.watertight or self.config.unseen_area >= 1:
            return {}
        msdf = without_unseen(self.scene.subject, self._fields(surface), self.views, self.config.unseen_area)
        return {} if msdf is None else {"msdf": msdf.numpy()}

    def _cuts(self, template: GhostTemplate, moved: np.ndarray) -> list[Cut]:
        """How to cut a moved template, the best first."""
        # What has become too small by moving is noise, and no reason to leave all where it was.
        logits = clean_opacity(template.logits, moved, template.faces, self.config.ghost_min_area)
        found = topology(*positive_part(template.vertices, template.faces, logits))
        as_found = Cut(logits, moved, found, found.boundary_loops)
        if self.config.watertight or not self.config.sheet_thickness:
            return [as_found]
        cut = without_spare_sides(as_found, template.vertices, template.faces, self.scene.subject.cell_size,
                                  self.config.sheet_thickness, self.config.ghost_min_area)
        return [cut, as_found] if cut else [as_found]

    def _split_pixels(self) -> tuple[PixelPool, PixelPool]:
        """Pixels to learn the shape from, and those of views kept apart to judge it."""
        every = np.arange(len(self.views))
        held_out = every[::_HOLD_OUT]
        seen = np.setdiff1d(every, held_out) if len(every) > 1 else every
        known, unknown = (PixelPool(self.views, self.scene.targets, chosen) for chosen in (seen, held_out))
        return known, unknown

    def _joint(self) -> JointStage:
        """The joint stage on the lattice that the fit ends on; on a coarser one first, if there is one."""
        if self.checkpoint.facts.get("volume_kept"):
            self.last_lattice = self.joint_lattice = self._volume_lattice()
        if self.joint_lattice == self.last_lattice:
            return self._joint_stage("joint", self.last_lattice, self.config).joint
        if self.checkpoint.stage in ("field", "joint"):
            coarse = self._joint_stage("joint", self.joint_lattice, self.config)
            self.books.enter("detail", **coarse.joint.outcome(), **coarse.state(),
                             light=self.checkpoint.arrays["light"])
        return self._joint_stage("detail", self.last_lattice, self.config.for_detail()).joint

    def _joint_stage(self, name: str, lattice: Lattice, config: FitConfig) -> SecondLook:
        start = dict(self.checkpoint.arrays)
        fields = start_fields(self.scene.subject, start, lattice, config)
        self.scene.subject.set_fields(fields)
        joint = JointStage(self.scene, start_material(self.scene, start, fields.lattice, config),
                           start_light(self.scene, start, config), config,
                           config.color_voxels * self.last_lattice.resolution)
        if joint.detail and "detail_places" in start:
            joint.restore_detail(start)
        self._fit_field(joint)
        look = SecondLook(joint, self.views, self.pixels, self.checkpoint.arrays)
        if self.checkpoint.stage == name:
            self.books.iterate(name, config.iterations, look, joint.optimizers, start,
                               lambda: (look.state() | block_arrays(self.scene.subject.fields())
                                        | joint.detail_arrays()))
        else:
            for optimizer_name, optimizer in joint.optimizers.items():
                restore_optimizer(optimizer_name, optimizer, self.checkpoint.arrays)
        changed = look.finish()
        if changed is not None:
            self.checkpoint.facts["openings_changed"] = changed
        if self.checkpoint.stage == name and lattice == self.last_lattice:
            self.books.leave()
        return look

    def _write_metrics(self, metrics: dict) -> dict:
        mib = {"estimated_memory_mib": self.memory.total, "peak_memory_mib": peak_memory()}
        metrics = metrics | self.checkpoint.facts | {name: round(size / 2**20) for name, size in mib.items()}
        return write_metrics(self.output, metrics, self.checkpoint.seconds)

    def _fit_field(self, joint: JointStage) -> None:
        """Brings what parametrises the geometry to where the joint stage starts."""
        state, geometry = self.checkpoint, joint.geometry
        fitted = geometry.fitting_steps == 0 or any(name.startswith("geometry/") for name in state.arrays)
        if state.stage == "joint" and not fitted:
            self.books.enter("field", **state.arrays)
        if state.stage == "field":
            start = {name: array for name, array in state.arrays.items() if "/" not in name}
            self.books.iterate("field", geometry.fitting_steps, FieldFitting(joint), geometry.optimizers,
                               start)
            geometry.begin()
            for name, optimizer in geometry.optimizers.items():
                start |= optimizer_arrays(name, optimizer)
            self.books.enter("joint", **start)
        elif state.stage == "joint" and state.iteration == 0 and geometry.fitting_steps:
            for name, optimizer in geometry.optimizers.items():
                restore_optimizer(name, optimizer, state.arrays)

    def _write_documents(self) -> None:
        """The asset and the report; for want of them a fit is not lost."""
        try:
            with self.progress.stage("mesh.glb", None), self.books.timed("asset"):
                write_asset(self.output)
            with self.progress.stage("report", None), self.books.timed("report"):
                write_report(self.output)
        except UserError as error:
            self.progress.warn(str(error))


def _as_fine(surface: tuple[np.ndarray, np.ndarray], length: float) -> tuple[np.ndarray, np.ndarray]:
    """A mesh whose edges are at most about as long as given: its radiance may be as fine."""
    vertices, faces = surface
    edges = vertices[faces] - vertices[np.roll(faces, 1, axis=1)]
    if len(faces) and np.median(np.linalg.norm(edges, axis=-1)) > 1.5 * length:
        return trimesh.remesh.subdivide(vertices, faces)
    return surface


def _plain(config: FitConfig) -> dict:
    return dataclasses.asdict(config)


def _same_config(before: dict, now: dict) -> None:
    for name, value in now.items():
        if before.get(name) != value and name != "checkpoint_seconds":
            raise UserError(f"The checkpoint was made with {name} = {before.get(name)}, not {value}; "
                            f"resume with the same settings or start again with --overwrite.")
