"""JSON that anybody may have written."""

import pytest

from gshell_mi.json_files import read_json, read_json_object


def test_a_byte_order_mark_is_welcome(tmp_path):
    (tmp_path / "a.json").write_text('{"ä": 1}', encoding="utf-8-sig")
    assert read_json_object(tmp_path / "a.json") == {"ä": 1}


@pytest.mark.parametrize("content", [b"", b"[", b"[" * 100_000, b"9" * 5000, b"\xff"])
def test_what_is_no_json_is_a_value_error(content, tmp_path):
    (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(ValueError):
        read_json(tmp_path / "a.json")


def test_other_values_are_no_objects(tmp_path):
    (tmp_path / "a.json").write_text("[1]", encoding="utf-8")
    with pytest.raises(ValueError, match="holds a JSON list, not an object"):
        read_json_object(tmp_path / "a.json")
