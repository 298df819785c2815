"""Names of files to be written, checked before the work."""

from __future__ import annotations

from pathlib import Path

from .errors import UserError

#: Bytes that a name may have, with room for what temporary names add to it; file systems allow 255.
_LONGEST = 200


def check_output_name(path: Path, what: str) -> None:
    """Raises ``UserError`` if ``path`` cannot be the name of a file.

    Args:
        what: what it is called in the message, such as ``The output``.

    >>> check_output_name(Path("out/mine.xml"), "The output")
    """
    name = path.name
    if name in ("", "..") or "\0" in str(path):
        raise UserError(f"{what} '{path}' is no file name; give one such as 'mine' and its suffix.")
    size = max(len(part.encode(errors="surrogateescape")) for part in path.parts)
    if size > _LONGEST:
        raise UserError(f"{what} '{str(path)[:40]} ...' has a name of {size} bytes, which no file system "
                        f"takes; give a shorter one.")
