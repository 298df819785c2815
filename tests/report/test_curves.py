"""Curves of a fit's log, and of logs that no fit wrote."""

import json
import re
from xml.etree import ElementTree

import numpy as np
import pytest

from gshell_mi.report.curves import curves

SVG = "{http://www.w3.org/2000/svg}"


def test_curves(tmp_path):
    log = tmp_path / "log.jsonl"
    assert curves(log) == []
    steps = [{"stage": "joint", "iteration": i, "loss": 10.0**-i, "psnr": i} for i in range(3)]
    log.write_text("".join(json.dumps(step) + "\n" for step in steps))
    losses, psnr = curves(log)
    points = np.array([p.split(",") for p in re.search(r'points="([^"]*)"', losses)[1].split()], float)
    assert np.ptp(np.diff(points, axis=0), axis=0) == pytest.approx(0, abs=0.2), "straight when logarithmic"
    assert points[0, 1] < points[-1, 1] and "PSNR" in psnr
    many = {f"loss_number_{i}": 1.0 + i for i in range(12)}
    log.write_text(json.dumps({"stage": "joint", "iteration": 0, **many}) + "\n")
    rows = [
        re.findall(r">([^<]+)</tspan>", row)
        for row in re.findall(r"<text[^>]*>(<tspan.*?)</text>", curves(log)[0])
    ]
    told = [name for row in rows for name in row]
    assert told == [name.replace("_", " ") for name in many], "a legend of rows that fit"
    assert all(sum(map(len, row)) <= 70 for row in rows)
    log.write_text(json.dumps({"stage": "joint", "iteration": 0, "loss": float("nan")}) + "\n")
    assert "polyline" not in "".join(curves(log))


def test_a_loss_that_starts_from_nothing_does_not_press_the_others(tmp_path):
    """And what jumps from step to step has a running mean."""
    log = tmp_path / "log.jsonl"
    steps = [
        {"stage": "joint", "iteration": i, "loss": 0.1 + 0.05 * (i % 2), "light_grey": 1e-8 if i < 9 else 0.1}
        for i in range(200)
    ]
    log.write_text("".join(json.dumps(step) + "\n" for step in steps))
    jumping, mean, _, _ = (
        np.array([p.split(",") for p in points.split()], float)[:, 1]
        for points in re.findall(r'points="([^"]*)"', curves(log)[0])
    )
    assert np.ptp(jumping) > 100 and np.ptp(mean[20:-20]) < 0.1 * np.ptp(jumping)


HOSTILE = [
    "garbage",
    "",
    "5",
    "[]",
    '"joint"',
    "[" * 9000,
    "\0\0",
    '{"stage": 5, "iteration": 0, "loss": 1}',
    '{"stage": "joint"}',
    '{"stage": "joint", "iteration": "x", "loss": 1}',
    '{"stage": "joint", "iter',
    '{"stage": "joint", "iteration": 1e999, "loss": 1}',
    "\udcff",
    '{"stage": "joint", "iteration": 0, "loss": "<b>", "a": [1], "b": {}, "c": null, "d": true}',
    '{"stage": "joint", "iteration": 0, "loss": 1' + "0" * 400 + "}",
]


@pytest.mark.parametrize("line", HOSTILE)
def test_lines_that_are_no_steps(tmp_path, line):
    log = tmp_path / "log.jsonl"
    step = json.dumps({"stage": "joint", "iteration": 3, "loss": 0.5})
    log.write_text(f"{line}\n{step}\n", errors="surrogateescape")
    (drawing,) = curves(log)
    assert "joint: losses" in drawing and drawing.count("<polyline") == 1


HOSTILE_NAMES = [
    "<script>alert(1)</script>",
    "<img src=x onerror=alert(1)>",
    '"><script>',
    "</title><script>",
    'a"b',
]


@pytest.mark.parametrize("name", HOSTILE_NAMES)
def test_names_are_escaped(tmp_path, name):
    log = tmp_path / "log.jsonl"
    log.write_text(
        "".join(
            json.dumps({"stage": name, "iteration": i, name: 0.5, "other": 0.25}) + "\n" for i in range(3)
        )
    )
    (drawing,) = curves(log)
    document = ElementTree.fromstring(drawing)
    assert {element.tag.removeprefix(SVG) for element in document.iter()} == {
        "svg",
        "text",
        "path",
        "polyline",
        "title",
        "tspan",
    }
    assert [title.text for title in document.iter() if title.tag.endswith("title")] == [name, "other"]
    assert document.get("aria-label") == f"{name}: losses"
