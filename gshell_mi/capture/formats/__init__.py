"""One module per capture format: ``find(source)`` says whether a path is one, ``read(source)`` reads it."""

from __future__ import annotations

from pathlib import Path

from ...errors import UserError
from ..frames import Capture
from . import colmap, idr, llff, mitsuba, nerf

#: In the order in which a folder is tried: data sets that come as several are best in the first.
FORMATS = {"nerf": nerf, "idr": idr, "colmap": colmap, "llff": llff, "mitsuba": mitsuba}


def read_capture(
    source: str | Path,
    *,
    format: str | None = None,
    images: str | Path | None = None,
    opencv_axes: bool = False,
) -> Capture:
    """Reads a capture of any format.

    A Mitsuba variant must be set.

    Args:
        source: the capture's folder or its main file.
        format: a name in ``FORMATS``; default: the first that fits.
        images: folder of the images, where the format does not say.
        opencv_axes: for ``nerf``: camera axes are right, down, forward instead of right, up, backward.

    Raises:
        UserError: it is none of them, or malformed.
    """
    source = Path(source)
    if not source.exists():
        raise UserError(f"Capture '{source}' does not exist; give the folder or file of one.")
    if images is not None and not Path(images).is_dir():
        raise UserError(f"Image folder '{images}' does not exist; correct --images.")
    if format is not None and format not in FORMATS:
        raise UserError(f"--format '{format}' is unknown; choose {', '.join(FORMATS)}.")
    name = format or next((name for name, module in FORMATS.items() if module.find(source)), None)
    if name is None or not FORMATS[name].find(source):
        raise UserError(
            f"'{source}' is no {'capture of the format ' + name if name else 'known capture'}: a folder with "
            f"transforms*.json (NeRF), cameras*.npz (IDR, NeuS), sparse/0 (COLMAP), poses_bounds.npy (LLFF) "
            f"or an XML file of Mitsuba sensors is needed, or mere photographs or a video; Metashape and "
            f"RealityScan export to COLMAP."
        )
    if opencv_axes and name != "nerf":
        raise UserError(
            f"--opencv-axes is for NeRF's transforms.json, but '{source}' is of the format "
            f"{name}; leave it out."
        )
    arguments = {"opencv_axes": True} if opencv_axes else {}
    return FORMATS[name].read(source, Path(images) if images else None, **arguments)
