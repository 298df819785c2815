"""JSON from files that anybody may have written."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def read_json(path: Path) -> Any:
    """What a JSON file holds; a byte order mark is welcome.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is no JSON, not UTF-8, nested too deeply, or holds an integer of thousands of digits.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    except (json.JSONDecodeError, UnicodeDecodeError):
        raise
    except ValueError:  # Python's own limit
        raise ValueError("it holds an integer of thousands of digits") from None


def read_json_object(path: Path) -> dict[str, Any]:
    """The same of a file whose outermost value must be an object; ``ValueError`` if it is another."""
    found = read_json(path)
    if not isinstance(found, dict):
        raise ValueError(f"it holds a JSON {type(found).__name__}, not an object")
    return found
