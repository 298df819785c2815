"""Lips at rims go; rims that are right stay where they are."""

import dataclasses

import numpy as np
import trimesh
from scripted_judge import ScriptedJudge

from gshell_mi.fit.lips import told_without_lips, without_lips
from gshell_mi.fit.surface import Surface

BALL = trimesh.creation.icosphere(5)
HEIGHT, FACES = np.array(BALL.vertices[:, 2]), np.array(BALL.faces)

#: A bowl is open above this height.
RIM = 0.0


def told(values: np.ndarray, noise: float = 0.05) -> np.ndarray:
    """Above the rim a surface explains the images a little worse than none, below it far better."""
    judge = ScriptedJudge(
        len(HEIGHT),
        lambda opaque: np.where(HEIGHT > RIM, np.where(opaque, 1.0, 0.8), np.where(opaque, 0.3, 3.0)),
        noise,
    )
    return told_without_lips(values, judge.shown((BALL.vertices, FACES)), judge)


def test_lips_go_and_the_rim_stays():
    lip = np.where(BALL.vertices[:, 0] > 0.3, 0.12, 0.0)
    found = told(RIM + lip - HEIGHT)
    # What vertices tell is smoothed along the rim, so that a lip's ends are rounded.
    within = BALL.vertices[:, 0] > 0.5
    edge = BALL.edges_unique_length.max()
    assert (found[within & (HEIGHT > RIM + 1.5 * edge)] <= 0).all()
    assert (found[HEIGHT < RIM - edge] > 0).all()


def test_a_rim_that_is_right_stays():
    values = RIM - HEIGHT
    np.testing.assert_array_equal(told(values), values)


def test_what_is_no_surer_than_noise_stays():
    values = RIM + 0.1 - HEIGHT
    np.testing.assert_array_equal(told(values, noise=0.5), values)


def test_closed_and_watertight_surfaces_stay(exact):
    fields = exact.scene.subject.fields()
    closed = Surface(fields).with_fields(msdf=np.ones_like(fields.msdf))
    assert without_lips(exact, closed) is closed
    opened = closed.with_fields(msdf=fields.lattice.vertex_positions()[:, 1].astype(np.float32))
    watertight = dataclasses.replace(exact, config=dataclasses.replace(exact.config, watertight=True))
    assert without_lips(watertight, opened) is opened
