"""Files that are whole or not there."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yields a path to write to, of the same suffix; what is there at the end becomes ``path`` in one step.

    A kill in between leaves an older ``path`` as it was, and a hidden file that the next writing replaces.

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
    partial = path.with_name(f".partial.{path.name}")
    try:
        yield partial
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
