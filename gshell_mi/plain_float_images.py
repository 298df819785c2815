"""Radiance HDR and portable float maps: formats that Mitsuba reads without checking what they promise.

A damaged Radiance file writes past the end of Mitsuba's memory, and a header of absurd size is made room for.
So these files are read here, and whatever Mitsuba would read otherwise than it is meant is refused.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import BinaryIO

import numpy as np

#: A file whose header promises more pixels is refused before they are made room for.
MOST_PIXELS = 1 << 28
#: Longer headers are no headers.
_LONGEST_HEADER = 1 << 16
#: Scanlines of other widths are never packed; Radiance keeps the width in 15 bits.
_NARROWEST_PACKED, _WIDEST_PACKED = 8, 0x7FFF
#: Values that two bytes of a packed scanline can stand for.
_LONGEST_RUN = 127


def is_radiance(path: Path) -> bool:
    """Whether a file is Radiance HDR by its first bytes, whatever its name."""
    return _starts(path, 2) == b"#?"


def is_float_map(path: Path) -> bool:
    """Whether a file is a portable float map (PFM) by its first bytes, whatever its name."""
    return _starts(path, 2) in (b"PF", b"Pf")


def radiance_size(path: Path) -> tuple[int, int]:
    """(width, height) of a Radiance file.

    Raises:
        ValueError: it is damaged, or of a kind that Mitsuba does not read.
    """
    with open(path, "rb") as file:
        return _radiance_header(file)


def read_radiance(path: Path) -> np.ndarray:
    """The pixels of a Radiance file (RGBE), (height, width, 3) float32, linear.

    Raises:
        ValueError: it is damaged, or of a kind that Mitsuba does not read.
    """
    with open(path, "rb") as file:
        width, height = _radiance_header(file)
        left = os.path.getsize(path) - file.tell()
        packed = _NARROWEST_PACKED <= width <= _WIDEST_PACKED and _is_packed(_peek(file, 4))
        row = 4 + 8 * -(-width // _LONGEST_RUN) if packed else 4 * width
        if row * height > left:
            raise ValueError(f"its header promises {width} x {height} pixels, for which it is too short")
        stored = file.read()
    rgbe = _unpacked(stored, width, height) if packed else _flat(stored, width, height)
    # An exponent of 0 means black, whatever the colour.
    scale = np.ldexp(np.float32(1), rgbe[..., 3:].astype(np.int32) - (128 + 8)) * (rgbe[..., 3:] > 0)
    return rgbe[..., :3] * scale.astype(np.float32)


def float_map_size(path: Path) -> tuple[int, int]:
    """(width, height) of a portable float map.

    Raises:
        ValueError: it is damaged.
    """
    with open(path, "rb") as file:
        return _float_map_header(file)[:2]


def read_float_map(path: Path) -> np.ndarray:
    """The pixels of a portable float map, (height, width, 3 or 1) float32, times the scale in its header.

    Raises:
        ValueError: it is damaged.
    """
    with open(path, "rb") as file:
        width, height, channels, scale = _float_map_header(file)
        count = width * height * channels
        if 4 * count > os.path.getsize(path) - file.tell():
            raise ValueError(f"its header promises {width} x {height} pixels, for which it is too short")
        values = np.frombuffer(file.read(4 * count), "<f4" if scale <= 0 else ">f4")
    rows = values.reshape(height, width, channels)[::-1]  # the lowest row comes first
    return rows.astype(np.float32) * np.float32(abs(scale))


def _starts(path: Path, count: int) -> bytes:
    with open(path, "rb") as file:
        return file.read(count)


def _peek(file: BinaryIO, count: int) -> bytes:
    found = file.read(count)
    file.seek(-len(found), os.SEEK_CUR)
    return found


def _checked_size(width: int, height: int) -> tuple[int, int]:
    if min(width, height) < 1 or width * height > MOST_PIXELS:
        raise ValueError(f"its header promises {width} x {height} pixels")
    return width, height


def _radiance_header(file: BinaryIO) -> tuple[int, int]:
    """(width, height); the file is left where the pixels begin."""
    kind = None
    while file.tell() < _LONGEST_HEADER and (line := file.readline(_LONGEST_HEADER)):
        text = line.removesuffix(b"\n").removesuffix(b"\r")
        if not line.endswith(b"\n") or b"\r" in text or b"\0" in text:
            raise ValueError("its header is damaged")  # Mitsuba may see other lines in it
        if text.startswith(b"FORMAT="):
            kind = text.removeprefix(b"FORMAT=").strip()
        if text.lstrip(b" ,\t").startswith(b"-Y") or re.match(rb"[-+][XY] +\d+ +[-+][XY] +\d", text):
            if kind != b"32-bit_rle_rgbe":
                raise ValueError(f"its colours are stored as {(kind or b'nothing known').decode('latin-1')}")
            if not (found := re.fullmatch(rb"-Y +(\d{1,9}) +\+X +(\d{1,9}) *", text)):
                raise ValueError("its rows do not begin at the top left; write it upright")
            return _checked_size(int(found[2]), int(found[1]))
    raise ValueError("its header says no size")


def _is_packed(start: bytes) -> bool:
    return len(start) == 4 and start[:2] == b"\2\2" and start[2] < 128


def _flat(stored: bytes, width: int, height: int) -> np.ndarray:
    pixels = np.frombuffer(stored, np.uint8, 4 * width * height).reshape(height, width, 4)
    # The oldest way to pack: how often the last pixel is repeated. Mitsuba takes it for a colour.
    if (pixels[..., :3] == 1).all(axis=-1).any():
        raise ValueError("it is packed in the oldest way; write it again")
    return pixels


def _unpacked(stored: bytes, width: int, height: int) -> np.ndarray:
    """(height, width, 4) uint8 of scanlines that are packed channel by channel."""
    rows, at = np.empty((height, 4 * width), np.uint8), 0
    start = bytes((2, 2, width >> 8, width & 255))
    for row in rows:
        if stored[at : at + 4] != start:
            # Here Mitsuba would begin to read a whole image anew, into memory that ends with this one.
            raise ValueError("a scanline is damaged")
        at = _unpack(stored, at + 4, row, width)
    return np.moveaxis(rows.reshape(height, 4, width), 1, -1)


def _unpack(stored: bytes, at: int, row: np.ndarray, width: int) -> int:
    """Fills one row of four channels, none of which a run leaves; returns where the next scanline begins."""
    filled = 0
    for end in range(width, 5 * width, width):
        while filled < end:
            code = stored[at] if at + 1 < len(stored) else 0
            repeated = code > 128
            count = code - 128 if repeated else code
            if count == 0 or filled + count > end or (not repeated and at + 1 + count > len(stored)):
                raise ValueError("a scanline is damaged or cut off")
            if repeated:
                row[filled : filled + count] = stored[at + 1]
            else:
                row[filled : filled + count] = np.frombuffer(stored, np.uint8, count, at + 1)
            at += 2 if repeated else 1 + count
            filled += count
    return at


def _float_map_header(file: BinaryIO) -> tuple[int, int, int, float]:
    """(width, height, channels, scale); the file is left where the pixels begin."""
    found = re.match(rb"P([Ff])\s+(\d{1,9})\s+(\d{1,9})\s+([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s", file.read(256))
    if not found:
        raise ValueError("its header is damaged")
    width, height = _checked_size(int(found[2]), int(found[3]))
    scale = float(found[4])
    if not 0 < abs(scale) < np.inf:
        raise ValueError("its header is damaged")
    file.seek(found.end())
    return width, height, 3 if found[1] == b"F" else 1, scale
