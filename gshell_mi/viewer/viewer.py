"""The server of the live view, on viser (Yi et al. 2025)."""

from __future__ import annotations

import contextlib
import io
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from ..errors import UserError
from ..export.gltf import glb_bytes
from ..images import over_white
from ..views import PinholeViews
from .own_origin import free_port, guarded_server
from .parts import mesh_parts, template_part

if TYPE_CHECKING:
    from ..fit import Preview
    from ..scene import FitScene

#: Seconds between updates, at least.
_INTERVAL = 2.0

#: Fraction of the time that updates may take; where one takes long, the next comes later.
_SHARE = 0.02

#: Longest side of the targets shown in the cameras, pixels, and the number of cameras that have one.
_THUMBNAIL, _THUMBNAILS = 128, 60

#: Length of the camera frusta as a fraction of the distance to the object.
_FRUSTUM = 0.12

#: Sine of the angle at which the page first looks down.
_FROM_ABOVE = 0.4


class Viewer:
    """A page that shows a fit's mesh, its template, its cameras and its losses while it runs.

    It is an ``Observer`` of ``fit_scene``. The page belongs to this machine alone: only browsers on it (or
    behind ``ssh -L 8080:localhost:8080``) can open it, and pages of other sites cannot read it.

    Args:
        port: of the server; if it is taken, the next one that is free.

    Raises:
        UserError: viser is not installed, or ``port`` is none.

    ::

        with Viewer() as viewer:
            print(viewer.url)
            fit_scene("scenes/tshirt.xml", observer=viewer)
    """

    def __init__(self, port: int = 8080):
        try:
            import viser
        except ImportError as error:
            raise UserError(
                "The live view needs viser, which is not installed; run 'pip install "
                "gshell_mi[viewer]' or leave out --viewer."
            ) from error
        port = free_port(port)
        with _quiet(), guarded_server():
            self._server = viser.ViserServer(host="127.0.0.1", port=port, label="gshell_mi", verbose=False)
        self._stage, self._due = "", 0.0
        self._losses: list[float] = []
        gui = self._server.gui
        self._status = gui.add_markdown("Reading the targets ...")
        self._curve = gui.add_uplot(
            (np.zeros(1), np.ones(1)),
            ({"label": "step"}, {"label": "loss", "stroke": "#c2571a"}),
            scales={"x": {"time": False}, "y": {"distr": 3}},
            aspect=1.6,
        )
        self._handles: dict[str, list] = {}
        for name, shown in (("open mesh", True), ("template", False), ("cameras", False)):
            box = gui.add_checkbox(name, shown)
            self._handles[name] = [box]
            box.on_update(lambda _, name=name: self._toggle(name))

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://localhost:{self._server.get_port()}"

    def close(self) -> None:
        """Stops the server."""
        with _quiet():
            self._server.stop()

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- Observer

    def begin(self, given: FitScene) -> None:
        """Shows the cameras with their targets."""
        import viser.transforms

        views = PinholeViews.from_sensors(given.sensors)
        box = np.array(given.subject.to_world.matrix)
        centre = box[:3, 3]
        up = -views.bases[:, :, 1].mean(0)
        up /= np.linalg.norm(up)
        self._server.scene.set_up_direction(tuple(up))
        outwards = views.origins - centre
        heights = outwards @ up / np.linalg.norm(outwards, axis=1)
        start = self._server.initial_camera
        # The browser's field of view is wide.
        start.position = centre + 0.5 * outwards[np.argmin(np.abs(heights - _FROM_ABOVE))]
        start.look_at, start.up = centre, up
        pictured = set(np.linspace(0, len(views) - 1, min(_THUMBNAILS, len(views))).astype(int).tolist())
        for index, name in enumerate(views.ids):
            origin, (across, down, _) = views.origins[index], views.bases[index].T
            axes = [across / np.linalg.norm(across), down / np.linalg.norm(down)]
            rotation = np.stack([*axes, np.cross(*axes)], axis=1)
            handle = self._server.scene.add_camera_frustum(
                f"/cameras/{name}",
                fov=2 * np.arctan(np.linalg.norm(down) / 2),
                aspect=float(np.linalg.norm(across) / np.linalg.norm(down)),
                scale=_FRUSTUM * float(np.linalg.norm(origin - centre)),
                image=_thumbnail(given.targets[index].rgba) if index in pictured else None,
                thickness=1.5,
                thickness_units="screen",
                visible=False,
                wxyz=viser.transforms.SO3.from_matrix(rotation).wxyz,
                position=origin,
            )
            self._handles["cameras"].append(handle)

    def step(
        self, stage: str, iteration: int, count: int, values: dict[str, float], preview: Callable[[], Preview]
    ) -> None:
        """Shows the state of the fit, if the last time is long enough ago."""
        if stage != self._stage:
            self._stage, self._due, self._losses = stage, 0.0, []
        self._losses.append(values["loss"])
        begin = time.monotonic()
        if begin < self._due and iteration + 1 < count:
            return
        self._show(preview())
        self._status.content = (
            f"**{stage}**, step {iteration + 1} of {count}\n\n"
            f"loss {values['loss']:.4f}, PSNR {values['psnr']:.1f} dB"
        )
        losses = np.maximum(np.array(self._losses), 1e-8)  # of a logarithmic axis
        self._curve.data = (np.arange(iteration + 1 - len(losses), iteration + 1, dtype=float), losses)
        self._server.flush()
        end = time.monotonic()
        self._due = end + max(_INTERVAL, (end - begin) / _SHARE)

    def stage_done(self, stage: str, preview: Callable[[], Preview]) -> None:
        """Shows what a stage has left that makes no steps; of others, steps have been shown."""
        if stage == self._stage:
            return
        self._stage, self._due, self._losses = stage, 0.0, []
        self._show(preview())
        self._status.content = f"**{stage}** is done."
        self._server.flush()

    # --- the scene

    def _show(self, preview: Preview) -> None:
        for name, parts in (("open mesh", mesh_parts(preview)), ("template", template_part(preview))):
            box, *_ = self._handles[name]
            data = glb_bytes(parts)
            handle = self._server.scene.add_glb(f"/{name}", data, visible=box.value)
            self._handles[name] = [box, handle]

    def _toggle(self, name: str) -> None:
        box, *shown = self._handles[name]
        for handle in shown:
            handle.visible = box.value


def _quiet() -> contextlib.AbstractContextManager:
    """viser tells of its starting and stopping on stdout, where a command's result goes."""
    return contextlib.redirect_stdout(io.StringIO())


def _thumbnail(rgba: np.ndarray) -> np.ndarray:
    step = max(1, round(max(rgba.shape[:2]) / _THUMBNAIL))
    return (over_white(rgba[::step, ::step]) * 255 + 0.5).astype(np.uint8)
