"""A video to its sharpest, well spread frames."""

from __future__ import annotations

import logging
from collections.abc import Generator
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
from PIL import Image
from scipy import ndimage

from ..errors import UserError
from ..files import replacing
from .workspace import Progress, Workspace, fingerprint

SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")

#: ffmpeg's names of what such files may be; playlists, which lead to other files, are none of them.
_CONTAINERS = "mov,mp4,avi,matroska,webm"

#: Transfer functions of films of more brightness than sRGB, as ffmpeg names them and as cameras do.
_HDR = {"arib-std-b67": "HLG", "smpte2084": "HDR10, PQ"}

#: Longer side, in pixels, of the copies that are judged.
_JUDGED = 320


def is_video(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() in SUFFIXES


def cut(video: Path, workspace: Workspace, count: int, progress: Progress | None = None) -> list[Path]:
    """Writes the frames of a video that are worth fitting as PNG files.

    Args:
        video: any file that ffmpeg reads.
        workspace: keeps the frames; a second call finds them there.
        count: how many frames; a shorter video gives all that it has.

    Returns:
        The files, in the order of the video.

    Raises:
        UserError: the file cannot be read as a video, or has fewer than three frames.
    """
    folder = workspace.step("frames", {"video": fingerprint([video]), "frames": count})
    done = folder / "done"
    if not done.is_file():
        sharpness, change = _judge(video, progress)
        if len(sharpness) < 3:
            raise UserError(f"Video '{video}' has only {len(sharpness)} frames; give a longer one.")
        _write(video, choose(sharpness, change, count), folder, progress)
        done.touch()
    return sorted(folder.glob("frame_*.png"))


def notes(video: Path) -> tuple[str, ...]:
    """What the user should know of how a video is read, a sentence each.

    Raises:
        UserError: the file cannot be read as a video.
    """
    transfer = next((name for name in _HDR if name in _properties(video)["pix_fmt"]), None)
    if transfer is None:
        return ()
    return (
        f"'{video.name}' is HDR ({_HDR[transfer]}), but is read as sRGB, so its light and colours come out "
        f"wrong: convert it to SDR, or switch HDR off in the camera.",
    )


def choose(sharpness: np.ndarray, change: np.ndarray, count: int) -> np.ndarray:
    """The frames to take: as much changes from one to the next, and each is the sharpest of its stretch.

    Args:
        sharpness: (n,) of each frame, any unit.
        change: (n,) how much of the picture changed since the frame before, any unit.
        count: number of frames wanted.

    Returns:
        Up to ``count`` ascending indices.

    >>> choose(np.array([1.0, 3, 2, 1, 1, 5]), np.ones(6), 2)
    array([1, 5])
    """
    # Where the camera rests there is nothing new; a floor keeps a still video from being cut at random.
    travelled = np.cumsum(np.maximum(change, 1e-3 * max(change.max(), 1e-9)))
    stretch = np.minimum((travelled / travelled[-1] * count * (1 - 1e-9)).astype(int), count - 1)
    return np.array(
        [
            members[sharpness[members].argmax()]
            for members in (np.flatnonzero(stretch == k) for k in range(count))
            if len(members)
        ]
    )


def _frames(video: Path, pixels: str, options: list[str]) -> Generator[Any, None, None]:
    """The properties of a video, then its frames as bytes; ``-fps_mode passthrough`` among the options gives
    each stored frame once, whatever its time.

    Raises:
        UserError: ffmpeg cannot read it.
    """
    # It warns of frames that are asked for in another size.
    logging.getLogger("imageio_ffmpeg").setLevel(logging.ERROR)
    try:
        # As it is, ffmpeg would take a name for an address or a list.
        yield from imageio_ffmpeg.read_frames(
            f"file:{video.absolute()}",
            pix_fmt=pixels,
            input_params=["-format_whitelist", _CONTAINERS],
            output_params=options,
            bits_per_pixel=8 if pixels == "gray" else 24,
        )
    except (OSError, RuntimeError, KeyError, IndexError) as error:
        reason = ([line for line in str(error).splitlines() if line.strip()] or [repr(error)])[-1].strip()
        raise UserError(f"Video '{video}' cannot be read ({reason}); convert it to MP4 again.") from error


def _properties(video: Path) -> dict[str, Any]:
    opened = _frames(video, "gray", [])
    found = next(opened)
    opened.close()
    return found


def _judge(video: Path, progress: Progress | None) -> tuple[np.ndarray, np.ndarray]:
    """Per frame its sharpness and its difference from the frame before."""
    found = _properties(video)
    width, height = found["size"]
    scale = min(_JUDGED / max(width, height), 1.0)
    size = (max(round(width * scale), 2), max(round(height * scale), 2))
    expected = round(found.get("fps", 0) * found.get("duration", 0))
    stream = _frames(video, "gray", ["-s", f"{size[0]}x{size[1]}", "-fps_mode", "passthrough"])
    next(stream)
    sharpness, change, before = [], [], None
    for index, data in enumerate(stream):
        picture = np.frombuffer(data, np.uint8).reshape(size[1], size[0]).astype(np.float32)
        sharpness.append(float(ndimage.laplace(picture).std()))
        change.append(0.0 if before is None else float(np.abs(picture - before).mean()))
        before = picture
        if progress:
            progress("video", index + 1, max(expected, index + 1))
    return np.array(sharpness), np.array(change)


def _write(video: Path, chosen: np.ndarray, folder: Path, progress: Progress | None) -> None:
    stream = _frames(video, "rgb24", ["-fps_mode", "passthrough"])
    width, height = next(stream)["size"]
    wanted = set(chosen.tolist())
    for index, data in enumerate(stream):
        if index in wanted:
            picture = Image.frombytes("RGB", (width, height), data)
            with replacing(folder / f"frame_{index:06}.png") as partial:
                picture.save(partial, compress_level=1)
            wanted.remove(index)
            if progress:
                progress("frames", len(chosen) - len(wanted), len(chosen))
        if not wanted:
            break
    stream.close()
