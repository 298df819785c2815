"""Curves of logs that no fit wrote."""

import json
from xml.dom import minidom

from gshell_mi.report.curves import curves

STEPS = [{"stage": "joint", "iteration": step, "loss": 1 / (1 + step), "psnr": 20 + step}
         for step in range(5)]


def drawn(tmp_path, *lines):
    (tmp_path / "log.jsonl").write_bytes(b"\n".join(lines))
    return curves(tmp_path / "log.jsonl")


def test_names_are_escaped(tmp_path):
    hostile = "<script>alert(1)</script>"
    lines = [json.dumps({"stage": hostile, "iteration": step, hostile: 1.0 + step, "a\"b": 2.0}).encode()
             for step in range(3)]
    (drawing,) = drawn(tmp_path, *lines)
    document = minidom.parseString(drawing)
    assert not document.getElementsByTagName("script")
    titles = [title.firstChild.data for title in document.getElementsByTagName("title")]
    assert titles == [hostile, 'a"b']


def test_lines_that_say_nothing_are_left_out(tmp_path):
    good = [json.dumps(step).encode() for step in STEPS]
    bad = [b"", b"nonsense", b"5", b"[]", b"{}", b"\xff\xfe", b"[" * 100_000, b'{"stage": 5, "iteration": 1}',
           b'{"stage": "joint", "iteration": "x", "loss": 1}',
           b'{"stage": "joint", "iteration": 2, "loss": "x"}']
    assert drawn(tmp_path, *bad[:5], *good, *bad[5:]) == drawn(tmp_path, *good)
    assert len(drawn(tmp_path, *good)) == 2
