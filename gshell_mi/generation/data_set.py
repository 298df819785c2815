"""Folders of converted objects, in shards that are whole or not there."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import UserError
from ..files import replacing
from ..json_files import read_json_object
from ..own_folder import OwnFolder
from .converted import POINTS, Row
from .fields import TruncatedFields

#: Objects per shard; what a kill may cost.
SHARD = 32

_CONFIG = "dataset.json"


@dataclass(frozen=True)
class Record:
    """What is known of an object besides its fields."""

    name: str
    kind: str
    loops: int
    held_out: bool
    chamfer: float
    loops_kept: bool


@dataclass(frozen=True)
class Shard:
    """Some objects of a set."""

    records: list[Record]
    rejected: list[dict]
    """``name`` and ``reason``."""
    sdf: np.ndarray
    """(k, N, N, N) float16."""
    msdf: np.ndarray
    """(k, N, N, N) float16."""
    points: np.ndarray
    """(k, 2048, 3) float16."""

    def fields(self, index: int) -> TruncatedFields:
        return TruncatedFields.stored(self.sdf[index], self.msdf[index])


class Split(NamedTuple):
    """The n objects of a set that are to be learned, or those held out."""

    records: list[Record]
    sdf: np.ndarray
    """(n, N, N, N) float16: signed distances."""
    msdf: np.ndarray
    """(n, N, N, N) float16."""
    points: np.ndarray
    """(n, 2048, 3) float16."""


@dataclass(frozen=True)
class DataSet:
    """A folder that ``python -m gshell_mi.dataset`` has written."""

    path: Path
    config: dict
    """What its shards have in common: ``side``, ``classes``, ``shards`` and the sources' digest."""

    @classmethod
    def open(cls, path: Path) -> DataSet:
        """Raises ``UserError`` if there is no complete data set."""
        if not path.exists():
            raise UserError(f"'{path}' does not exist; check the path.")
        if not OwnFolder(path, "dataset").is_marked() or not (path / _CONFIG).is_file():
            raise UserError(f"'{path}' is no data set; make one with python -m gshell_mi.dataset.")
        try:
            config = read_json_object(path / _CONFIG)
            config = {
                "side": int(config["side"]),
                "classes": [str(name) for name in config["classes"]],
                "shards": int(config["shards"]),
                "digest": str(config["digest"]),
            }
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UserError(f"'{path / _CONFIG}' is damaged ({error}); make the data set again.") from error
        found = cls(path, config)
        missing = [i for i in range(config["shards"]) if not found.shard_path(i).is_file()]
        if missing:
            raise UserError(
                f"'{path}' is not finished: {len(missing)} of {config['shards']} shards are "
                f"missing; run the same gshell_mi.dataset command again to go on."
            )
        return found

    @staticmethod
    def shard_name(number: int) -> str:
        return f"shards/{number:05d}.npz"

    def shard_path(self, number: int) -> Path:
        return self.path / self.shard_name(number)

    def shard(self, number: int) -> Shard:
        """Raises ``UserError`` if it is damaged."""
        return read_shard(self.shard_path(number), self.config["side"])

    @property
    def side(self) -> int:
        return self.config["side"]

    @property
    def classes(self) -> list[str]:
        return self.config["classes"]

    def shards(self) -> Iterator[Shard]:
        for number in range(self.config["shards"]):
            yield self.shard(number)

    @cached_property
    def records(self) -> list[Record]:
        """Of all objects, in order."""
        return [
            record
            for number in range(self.config["shards"])
            for record in read_records(self.shard_path(number))
        ]

    def load(self, *, held_out: bool) -> Split:
        """``load_splits`` of one split."""
        return self.load_splits(held_out)[0]

    def load_splits(self, *splits: bool) -> list[Split]:
        """Some splits, of which True is what is held out, in one pass, as shards take long to unpack.

        Raises:
            UserError: one has no objects, or a shard is damaged.
        """
        found: list[tuple[list[Record], list]] = [([], []) for _ in splits]
        for shard in self.shards():
            for held_out, (records, parts) in zip(splits, found, strict=True):
                chosen = [i for i, record in enumerate(shard.records) if record.held_out == held_out]
                records += [shard.records[i] for i in chosen]
                parts.append((shard.sdf[chosen], shard.msdf[chosen], shard.points[chosen]))
        for held_out, (records, _) in zip(splits, found, strict=True):
            self._check_some(records, held_out=held_out)
        return [
            Split(records, *(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))
            for records, parts in found
        ]

    def load_points(self, *, held_out: bool) -> tuple[list[Record], np.ndarray]:
        """Records and points (n, 2048, 3) float16 of one split, without the fields.

        Raises:
            UserError: there are none, or a shard is damaged.
        """
        records, parts = [], []
        for number in range(self.config["shards"]):
            found, points = read_points(self.shard_path(number))
            chosen = [i for i, record in enumerate(found) if record.held_out == held_out]
            records += [found[i] for i in chosen]
            parts.append(points[chosen])
        self._check_some(records, held_out=held_out)
        return records, np.concatenate(parts)

    def _check_some(self, records: list[Record], *, held_out: bool) -> None:
        if not records:
            split = "held-out" if held_out else "training"
            raise UserError(
                f"'{self.path}' has no {split} objects; make a larger set, or another --held-out."
            )


def write_config(folder: OwnFolder, config: dict) -> None:
    folder.claim(_CONFIG)
    with replacing(folder.path / _CONFIG) as partial:
        partial.write_text(json.dumps(config, indent=1) + "\n", encoding="utf-8")


def read_config(path: Path) -> dict | None:
    """The configuration of a set that may not be finished; None where there is none that can be read."""
    try:
        return read_json_object(path / _CONFIG)
    except (OSError, ValueError):
        return None


def write_shard(path: Path, rows: list[Row], rejected: list[dict], side: int, held_out: float) -> None:
    """Writes the objects of one shard, in one step."""
    records = [
        {
            "name": row.source.name,
            "kind": row.source.kind,
            "loops": row.loops,
            "held_out": row.source.is_held_out(held_out),
            "chamfer": round(row.chamfer, 5),
            "loops_kept": row.loops_kept,
        }
        for row in rows
    ]
    shape = (len(rows), side, side, side)
    with replacing(path) as partial:
        np.savez_compressed(
            partial,
            sdf=np.array([row.fields.sdf for row in rows], np.float16).reshape(shape),
            msdf=np.array([row.fields.msdf for row in rows], np.float16).reshape(shape),
            points=np.array([row.points for row in rows], np.float16).reshape(len(rows), POINTS, 3),
            records=np.array(json.dumps(records)),
            rejected=np.array(json.dumps(rejected)),
        )


def read_records(path: Path) -> list[Record]:
    """What is known of a shard's objects, without their fields. Raises ``UserError`` if it is damaged."""
    try:
        with np.load(path) as archive:
            return _records(archive)
    except Exception as error:  # NumPy's readers raise whatever they stumble over
        raise _damaged(path, error) from error


def read_points(path: Path) -> tuple[list[Record], np.ndarray]:
    """A shard's records and points, without its fields. Raises ``UserError`` if it is damaged."""
    try:
        with np.load(path) as archive:
            records, points = _records(archive), archive["points"]
            if points.shape != (len(records), POINTS, 3):
                raise ValueError(f"points of shape {points.shape}")
    except Exception as error:  # NumPy's readers raise whatever they stumble over
        raise _damaged(path, error) from error
    return records, points


def _records(archive) -> list[Record]:
    return [Record(**record) for record in json.loads(str(archive["records"]))]


def _damaged(path: Path, error: Exception) -> UserError:
    return UserError(
        f"Shard '{path}' cannot be read ({type(error).__name__}); remove it and run the same "
        f"gshell_mi.dataset command again, which makes it anew."
    )


def read_shard(path: Path, side: int) -> Shard:
    """Raises ``UserError`` if the shard is damaged or of another size."""
    try:
        with np.load(path) as archive:
            records = _records(archive)
            shard = Shard(
                records,
                json.loads(str(archive["rejected"])),
                archive["sdf"],
                archive["msdf"],
                archive["points"],
            )
    except Exception as error:  # NumPy's readers raise whatever they stumble over
        raise _damaged(path, error) from error
    shape = (len(records), side, side, side)
    found = (shard.sdf.shape, shard.msdf.shape, shard.points.shape)
    if found != (shape, shape, (len(records), POINTS, 3)):
        raise UserError(
            f"Shard '{path}' does not fit its set; remove it and run the same gshell_mi.dataset "
            f"command again, which makes it anew."
        )
    if not (np.isfinite(shard.sdf).all() and np.isfinite(shard.msdf).all()):
        raise UserError(
            f"Shard '{path}' holds NaN or infinity; remove it and run the same gshell_mi.dataset "
            f"command again, which makes it anew."
        )
    return shard
