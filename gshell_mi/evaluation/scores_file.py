"""Files of scores: replaced only if they are of this package, so a mistyped name costs nothing."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ..errors import UserError
from ..files import replacing
from ..own_folder import TAG, check_own_file


def check_scores_file(path: Path) -> None:
    """Raises ``UserError`` if something that is no file of scores is in the place of one."""
    check_own_file(path, option="--json")


def write_scores(path: Path, scores: dict[str, Any]) -> None:
    """Writes scores as JSON, with a word of who wrote them (``by``).

    Raises:
        UserError: it cannot be written, or something that is no file of scores is in its place.
    """
    check_scores_file(path)
    try:
        with replacing(path) as partial:
            partial.write_text(json.dumps({"by": TAG} | scores, indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        raise UserError(
            f"'{path}' cannot be written ({error.strerror or error}); choose another place with --json."
        ) from error
