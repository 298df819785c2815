"""Frames as files: MP4 by ffmpeg, and GIF."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO

import imageio_ffmpeg
import numpy as np
from PIL import Image

from ..errors import UserError
from ..files import name_trouble, replacing
from ..interrupt import check_interrupt
from ..own_folder import TAG, check_own_file


def write_video(frames: Iterable[np.ndarray], path: Path, fps: float, *, gif: bool = True) -> list[Path]:
    """Writes frames (h, w, 3) in [0, 1] as MP4 (H.264) and, beside it, as an endless GIF; returns the files.

    Both are there at the end, or nothing has changed. An earlier file is replaced only if it is one of these.

    Raises:
        UserError: the files cannot be written, or something else is in their place.
    """
    path = Path(path)
    if trouble := name_trouble(path.name, in_scene=False):
        raise UserError(
            f"The name of the film '{str(path)[:80]}' {trouble}; give one such as turntable.mp4 with -o."
        )
    if path.suffix.lower() not in ("", ".mp4"):
        raise UserError(
            f"The film '{str(path)[:80]}' would be an MP4; give a name that ends in .mp4 with -o."
        )
    path = path.with_suffix(".mp4")
    files = [path, path.with_suffix(".gif")] if gif else [path]
    try:
        for file in files:
            check_own_file(file)
        path.parent.mkdir(parents=True, exist_ok=True)
        with ExitStack() as stack:
            film, *animation = [stack.enter_context(replacing(file)) for file in files]
            pictures = _write_film(frames, film, fps, keep=gif)
            if gif:
                pictures[0].save(
                    animation[0],
                    save_all=True,
                    append_images=pictures[1:],
                    loop=0,
                    duration=max(20, round(1000 / fps)),
                    comment=TAG.encode(),
                )
    except OSError as error:
        raise UserError(
            f"'{path}' cannot be written ({error.strerror or error}); choose another file with -o."
        ) from error
    return files


def _write_film(frames: Iterable[np.ndarray], path: Path, fps: float, *, keep: bool) -> list[Image.Image]:
    """Writes the MP4; returns the frames in 128 colours if they are to be kept."""
    pictures, sink = [], None
    with ExitStack() as stack:
        for frame in frames:
            check_interrupt()
            pixels = np.ascontiguousarray((np.clip(frame, 0, 1) * 255 + 0.5).astype(np.uint8))
            if sink is None:
                sink = stack.enter_context(_ffmpeg(path, pixels.shape[1::-1], fps))
            sink.write(pixels.data)
            if keep:
                pictures.append(Image.fromarray(pixels).quantize(128))
    return pictures


@contextmanager
def _ffmpeg(path: Path, size: tuple[int, int], fps: float) -> Iterator[IO[bytes]]:
    """Takes 8-bit RGB frames of ``size`` (width, height); at the end, the MP4 is whole.

    Raises:
        OSError: it is not; with ffmpeg's reason.
    """
    width, height = size
    command = [
        imageio_ffmpeg.get_ffmpeg_exe(),
        "-nostdin",
        "-y",
        "-v",
        "error",
        "-f",
        "rawvideo",
        "-pix_fmt",
        "rgb24",
        "-s",
        f"{width}x{height}",
        "-r",
        f"{fps:.6g}",
        "-i",
        "-",
        "-an",
        "-c:v",
        "libx264",
        "-pix_fmt",
        "yuv420p",
        "-crf",
        "20",
        "-movflags",
        "+faststart",
        "-metadata",
        f"comment={TAG}",
        "-f",
        "mp4",
        # As it is, ffmpeg would take a name for an option, an address or a list.
        f"file:{path.absolute()}",
    ]
    with tempfile.TemporaryFile() as told:
        # Of a session of its own, or Ctrl-C would end it before us.
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=told, start_new_session=True
        )
        broken = False
        try:
            try:
                assert process.stdin is not None, "it is a pipe"
                yield process.stdin
                process.stdin.close()
            except BrokenPipeError:  # it has ended before; why, it says below
                broken = True
            if process.wait() != 0 or broken or path.stat().st_size == 0:
                told.seek(0)
                lines = told.read().decode(errors="replace").strip().splitlines() or ["no reason given"]
                raise OSError(f"ffmpeg: {lines[0].rpartition(': ')[2]}")
        finally:
            if process.poll() is None:
                process.kill()
                process.wait()
