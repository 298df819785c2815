"""Files that are whole or not there, and locks that die with their owner."""

from __future__ import annotations

import os
import re
import secrets
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from .errors import UserError

try:
    import fcntl
except ImportError:  # Windows has none: nothing is locked there, and what a kill left behind stays
    fcntl = None

#: How the names of files begin that are being written.
PARTIAL = ".partial."

#: Such a name: as no user's file has one, it may be removed.
_OURS = re.compile(re.escape(PARTIAL) + r"[0-9a-f]{12}(\..*)?")

#: Seconds after which a partial file that nobody holds is a killed run's; it is locked once it is there.
_JUST_MADE = 1.0

#: Folders that this process has looked through for such files.
_swept: set[Path] = set()

_held = threading.local()


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yields a path to write to, of the same suffix; what is there at the end becomes ``path`` in one step.

    It is a new file of a name that nobody can foretell, so nothing that lies there is written through. A kill
    in between leaves an older ``path`` as it was, and a hidden file that the next run which writes into the
    folder removes.

    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "scores.json"
    >>> with replacing(path) as partial:
    ...     _ = partial.write_text("{}")
    ...     path.exists()
    False
    >>> [entry.name for entry in path.parent.iterdir()]
    ['scores.json']
    """
    path = Path(path)
    if path.parent.absolute() not in _swept:
        _swept.add(path.parent.absolute())
        remove_stale(path.parent)
    partial = path.with_name(f"{PARTIAL}{secrets.token_hex(6)}{path.suffix[:32]}")
    try:
        handle = os.open(partial, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o666)
    except OSError as error:  # of a name that nobody knows
        raise OSError(error.errno, error.strerror, str(path)) from error
    try:
        _try_lock(handle)
        yield partial
        os.replace(partial, path)
    finally:
        os.close(handle)
        partial.unlink(missing_ok=True)


def remove_stale(folder: Path) -> None:
    """Removes what killed runs were writing in a folder; what runs are writing now is left alone."""
    for path in folder.glob(f"{PARTIAL}*"):
        if not _OURS.fullmatch(path.name):
            continue
        try:
            handle = os.open(path, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0))
        except OSError:  # a link, or gone
            continue
        try:
            if time.time() - os.fstat(handle).st_mtime > _JUST_MADE and _try_lock(handle) is True:
                path.unlink(missing_ok=True)
        except OSError:
            pass  # not ours to remove
        finally:
            os.close(handle)


@contextmanager
def locked(folder: Path, *, wait: bool = False) -> Iterator[None]:
    """Keeps other runs out of a folder that exists; the lock goes with the process, however that ends.

    A thread that holds the lock may take it again.

    Args:
        wait: for another run to end, instead of complaining.

    Raises:
        UserError: another run is writing into the folder.
    """
    if fcntl is None:
        yield
        return
    holders = _held.__dict__.setdefault("folders", set())
    handle = os.open(folder, os.O_RDONLY)
    try:
        status = os.fstat(handle)
        key = (status.st_dev, status.st_ino)
        if key in holders:
            yield
            return
        if _try_lock(handle, wait=wait) is False:
            raise UserError(
                f"Another run is writing into '{folder}'; wait for its end, or choose another place with -o."
            )
        holders.add(key)
        try:
            yield
        finally:
            holders.discard(key)
    finally:
        os.close(handle)


def _try_lock(handle: int, *, wait: bool = False) -> bool | None:
    """Locks an open file or folder; False if somebody else has, None where there are no locks."""
    if fcntl is None:
        return None
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return None
    return True


def name_trouble(name: str, *, in_scene: bool = True) -> str | None:
    """Why a name cannot be that of a file that is written; None if it can.

    Args:
        in_scene: Mitsuba reads it in XML as well, where a $ begins a parameter.

    >>> name_trouble("view_003"), name_trouble("../view"), name_trouble("$spp")
    (None, "has a '/'", "has a '$', which Mitsuba takes for a parameter")
    """
    if name in ("", ".", ".."):
        return "is no name"
    for character in "/\\":
        if character in name:
            return f"has a '{character}'"
    if in_scene and "$" in name:
        return "has a '$', which Mitsuba takes for a parameter"
    if not name.isprintable():
        return "has characters that cannot be printed"
    if len(name.encode()) > 200:
        return "is longer than 200 bytes"
    return None
