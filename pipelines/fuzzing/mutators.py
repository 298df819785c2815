"""Ways to damage a file, from single bits to its structure."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

#: Numbers that programs stumble over.
NUMBERS = (
    0,
    -1,
    1,
    2,
    255,
    256,
    65535,
    65536,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**63,
    -(2**63),
    10**40,
    10**400,
    0.5,
    -0.0,
    1e-40,
    1e-300,
    1e38,
    1e300,
    math.nan,
    math.inf,
    -math.inf,
)
#: Texts that are no names, or names of something else.
TEXTS = (
    "",
    " ",
    "/",
    ".",
    "..",
    "../../x",
    "/etc/passwd",
    "C:\\x\\y.png",
    "a\0b",
    "a\nb",
    "$spp",
    "<a>&\"'",
    "ä",
    "\ud800",
    "x" * 300,
    "x" * 70000,
    "nan",
    "1e400",
    "--help",
    "%s%n",
    "con",
    "images",
    "true",
)

_NUMBER = re.compile(rb"-?\d+\.?\d*(?:[eE][-+]?\d+)?")


def damaged_bytes(data: bytes, random: Random) -> bytes:
    """Bits flipped, parts cut out, repeated, moved or overwritten, once or a few times."""
    data = bytearray(data)
    for _ in range(random.choice((1, 1, 1, 2, 8))):
        if not data:
            break
        at = random.randrange(min(len(data), random.choice((16, 200, 10**9))))
        length = random.choice((1, 2, 4, 8, 64, 1024))
        kind = random.randrange(7)
        if kind == 0:
            data[at] ^= 1 << random.randrange(8)
        elif kind == 1:
            del data[at:]
        elif kind == 2:
            del data[at : at + length]
        elif kind == 3:
            data[at:at] = data[at : at + length] * random.choice((1, 1, 50))
        elif kind == 4:
            data[at : at + length] = random.randbytes(length)
        elif kind == 5:
            data[at : at + 4] = random.choice(
                (
                    b"\0\0\0\0",
                    b"\xff\xff\xff\xff",
                    b"\xff\xff\xff\x7f",
                    b"\0\0\xc0\x7f",
                    b"\0\0\x80\x7f",
                    b"\1\0\0\0",
                )
            )
        else:
            there = random.randrange(len(data))
            data[at : at + length] = data[there : there + length]
    return bytes(data)


def damaged_text(data: bytes, random: Random) -> bytes:
    """A number, a word or a line exchanged, dropped or repeated."""
    kind = random.randrange(5)
    numbers = list(_NUMBER.finditer(data))
    if kind <= 1 and numbers:
        found = random.choice(numbers)
        number = random.choice((*map(str, NUMBERS), "9" * 5000))
        return data[: found.start()] + number.encode() + data[found.end() :]
    if kind == 2:
        words = list(re.finditer(rb"[^\s\"'<>=,]+", data))
        if words:
            found = random.choice(words)
            text = random.choice(TEXTS).encode(errors="surrogatepass")
            return data[: found.start()] + text + data[found.end() :]
    lines = data.splitlines(keepends=True)
    if kind == 3 and lines:
        at = random.randrange(len(lines))
        lines[at : at + 1] = random.choice(([], [lines[at]] * 2, [lines[at]] * 2000, [random.choice(lines)]))
        return b"".join(lines)
    return damaged_bytes(data, random)


def damaged_xml(data: bytes, random: Random) -> bytes:
    """An element nested, emptied or exchanged, an attribute's value exchanged, or any text."""
    elements = list(re.finditer(rb"<\w+[^<>]*/?>", data))
    values = list(re.finditer(rb'"[^"]*"', data))
    kind = random.randrange(4)
    if kind == 0 and elements:
        found, depth = random.choice(elements), random.choice((1, 50, 150, 20000))
        nested = b"<bsdf>" * depth + found.group() + b"</bsdf>" * depth
        return data[: found.start()] + nested + data[found.end() :]
    if kind == 1 and values:
        found, value = random.choice(values), random.choice((*TEXTS, *map(str, NUMBERS)))
        value = value.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")
        return data[: found.start()] + f'"{value}"'.encode(errors="surrogatepass") + data[found.end() :]
    if kind == 2 and elements:
        first, second = random.choice(elements), random.choice(elements)
        return data[: first.start()] + second.group() + data[first.end() :]
    return damaged_text(data, random)


def damaged_json(data: bytes, random: Random) -> bytes:
    """A value anywhere in the document exchanged, dropped or repeated, or any text."""
    if random.random() < 0.2:
        return damaged_text(data, random)
    document = json.loads(data)
    places = list(_places(document))
    for _ in range(random.choice((1, 1, 3))):
        holder, key = random.choice(places)
        try:
            if random.random() < 0.15:
                del holder[key]
            else:
                holder[key] = _any_value(random, holder[key])
        except (IndexError, KeyError):
            continue  # an earlier change has dropped it
    try:
        return json.dumps(document).encode()
    except (RecursionError, ValueError):
        return b"[" * 100_000


def _places(value: Any):
    if isinstance(value, dict):
        entries = list(value.items())
    elif isinstance(value, list):
        entries = list(enumerate(value))
    else:
        return
    for key, inner in entries:
        yield value, key
        yield from _places(inner)


def _any_value(random: Random, old: Any) -> Any:
    kind = random.randrange(7)
    if kind <= 1:
        return random.choice(NUMBERS)
    if kind == 2:
        return random.choice(TEXTS).encode(errors="replace").decode()
    if kind == 3:
        return random.choice((None, True, False, [], {}, [[]], [None], {"a": []}))
    if kind == 4:
        return [old] * random.choice((1, 2, 1000))
    if kind == 5:
        nested: Any = old
        for _ in range(random.choice((1, 30, 900))):
            nested = [nested]
        return nested
    return {"x": old}


def damaged_array(array: np.ndarray, random: Random) -> np.ndarray:
    """Values, shape or type exchanged."""
    array = array.copy()
    if array.dtype.kind == "U":  # a document in JSON
        return np.array(damaged_json(str(array).encode(), random).decode(errors="replace"))
    kind = random.randrange(6)
    if kind <= 2 and array.size and array.dtype.kind == "f":
        flat = array.reshape(-1)
        for _ in range(random.choice((1, 1, 20))):
            value = float(random.choice([number for number in NUMBERS if number != 10**400]))
            flat[random.randrange(flat.size)] = value
        return flat.reshape(array.shape)
    if kind == 3:
        return array[: random.randrange(len(array) + 1)] if array.ndim else array[None]
    if kind == 4:
        return random.choice(
            (
                array.astype(np.float16),
                array.astype("U8"),
                array.ravel(),
                array[None],
                np.zeros((0, 3)),
                np.zeros(array.shape, bool),
                array.astype(np.complex64),
            )
        )
    return array.astype(np.float64) * random.choice((0.0, -1.0, 1e-30, 1e30))


def damage_file(path: Path, random: Random) -> None:
    """Damages a file in the way of its kind."""
    data, suffix = path.read_bytes(), path.suffix
    if suffix == ".json":
        path.write_bytes(damaged_json(data, random))
    elif suffix == ".xml":
        path.write_bytes(damaged_xml(data, random))
    elif suffix in (".npz", ".npy") and random.random() < 0.7:
        _damage_arrays(path, random)
    elif suffix in (".txt", ".obj", ".off", ".jsonl"):
        path.write_bytes(damaged_text(data, random))
    else:
        path.write_bytes(damaged_bytes(data, random))


def _damage_arrays(path: Path, random: Random) -> None:
    with np.errstate(all="ignore"):
        if path.suffix == ".npy":
            np.save(path, damaged_array(np.load(path), random))
            return
        with np.load(path) as stored:
            arrays = dict(stored)
        name = random.choice(list(arrays))
        if random.random() < 0.2:
            arrays[random.choice(("other", "header"))] = arrays.pop(name)
        else:
            arrays[name] = damaged_array(arrays[name], random)
        np.savez(path, **arrays)
