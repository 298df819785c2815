"""How the documentation's site shows docstrings."""

import importlib.util
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "pipelines" / "site_docstrings.py"


@pytest.fixture(scope="module")
def site():
    pytest.importorskip("griffe", reason="needs the documentation's tools: pip install '.[docs]'")
    spec = importlib.util.spec_from_file_location("site_docstrings", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_doctests_become_code_and_what_is_returned_prose(site):
    docstring = """\
Doubles.

Args:
    x: a number.

    >>> twice(2)
    4

Returns:
    So much: twice
    as much.

Raises:
    ValueError: never.

>>> twice(1)
2"""
    assert (
        site.shown(docstring)
        == """\
Doubles.

Args:
    x: a number.

    ```pycon
    >>> twice(2)
    4
    ```

**Returns:** So much: twice
as much.

Raises:
    ValueError: never.

```pycon
>>> twice(1)
2
```"""
    )


def test_comments_of_values(site):
    lines = ["#: How many,", "#: at most.", "COUNT = 3", "size: int  #: in pixels", "other = 1"]
    found = [site.comment_at(lines, number) for number in (3, 4, 5)]
    assert found == ["How many,\nat most.", "in pixels", ""]
