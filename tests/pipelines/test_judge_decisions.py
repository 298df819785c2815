"""The page of what the judge decides."""

import sys
from pathlib import Path

import numpy as np
import pytest
from cap import cap

sys.path.insert(0, str(Path(__file__).parents[2] / "pipelines"))

import judge_decisions


@pytest.mark.parametrize(
    ("change", "row"),
    [
        (
            ((0.2,), (0.05,), (True,), 0.5, 0.4),
            "| mug | folds | +0.200 ± 0.050 | accepted | 0.500 → 0.400 | better |",
        ),
        (
            ((-0.2, 0.1), (0.05, 0.01), (False, True), 0.5, 0.501),
            "| mug | folds | +0.100 ± 0.010, -0.200 ± 0.050 | 1 of 2 accepted | 0.500 → 0.501 | same |",
        ),
    ],
)
def test_rows_of_changes(change, row):
    assert judge_decisions.Change("folds", *change).row("mug") == row


def test_rows_of_openings():
    row = {
        "images": "seed 0",
        "true": {"z": [5.0, 3.0], "accepted": [True, True]},
        "false": {"z": [-4.0, -9.0], "accepted": [False, False]},
    }
    assert judge_decisions.openings_row("mug", row) == (
        "| mug | seed 0 | 2 of 2 | least +3.0 | 0 of 2 | largest -4.0 |"
    )


def test_holes_are_where_the_truth_is_closed(ball):
    opened, closed = cap(ball, [0, 0, 1], 0.1), ball.vertices[:, 2] > -0.5
    label = judge_decisions.holes(ball.vertices, ball.faces, opened, closed, 3)
    assert set(np.unique(label)) == {-1, 0, 1, 2}
    assert closed[label >= 0].all() and not opened[label >= 0].any()
    centres = [ball.vertices[label == hole].mean(axis=0) for hole in range(3)]
    assert min(np.linalg.norm(a - b) for a in centres for b in centres if a is not b) > 0.3


def test_chamfer_of_what_is_moved(ball):
    moved = 1.01 * ball.vertices
    found = judge_decisions.chamfer(moved, ball.faces, ball)
    assert found == pytest.approx(100 * 0.01 / np.linalg.norm(ball.extents), rel=0.2)
