"""The kinds of garments: how each draws its numbers, and the template and cut that they stand for.

A garment is a G-Shell: where ``s = 0`` and ``cut >= 0``. The y axis points up, and x to the wearer's left;
everything lies within [-1, 1]^3.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import numpy as np

from .shapes import column, limb, smooth_cut, smooth_step, smooth_union

#: A cut that takes nothing away.
_NOTHING = 10.0


@dataclass(frozen=True)
class Kind:
    """A kind of garment."""

    draw: Callable[[np.random.Generator], dict[str, float]]
    """Its parameters."""
    fields: Callable
    """From points and parameters to the template's field and the cut."""
    loops: Callable[[dict[str, float]], int]
    """Boundary loops that it has."""


def _between(rng: np.random.Generator, **ranges: tuple[float, float]) -> dict[str, float]:
    return {name: float(rng.uniform(*ends)) for name, ends in ranges.items()}


def _folds(rng: np.random.Generator, top: float, bottom: float, most: float) -> dict[str, float]:
    """Folds that hang from ``top`` and are deepest at ``bottom``."""
    count = int(rng.integers(5, 14))
    deepest = min(most, 0.55 / count) if rng.random() < 0.85 else 0.0
    return {
        "fold_count": count,
        "fold_top": top,
        "fold_bottom": bottom,
        **_between(
            rng,
            fold_depth=(0.3 * deepest, deepest),
            fold_phase=(0, 2 * np.pi),
            fold_turn=(-0.8, 0.8),
            fold_second=(0, 0.6),
            fold_second_phase=(0, 2 * np.pi),
        ),
    }


def _no_folds() -> dict[str, float]:
    return {
        "fold_count": 6,
        "fold_top": 1.0,
        "fold_bottom": -1.0,
        "fold_depth": 0.0,
        "fold_phase": 0.0,
        "fold_turn": 0.0,
        "fold_second": 0.0,
        "fold_second_phase": 0.0,
    }


def _chance(rng: np.random.Generator, probability: float) -> float:
    return float(rng.random() < probability)


def _tilted(p, level, tilt_x, tilt_z):
    """Height over a plane that goes through ``level`` on the axis."""
    return p.y - level - tilt_x * p.x - tilt_z * p.z


def _opening(p, half_width, slope, level):
    """Outside of a gap in front that is ``half_width`` at ``level`` and widens downwards by ``slope``."""
    return dr.maximum(dr.abs(p.x) - dr.maximum(half_width + slope * (level - p.y), 0.02), -p.z)


def _switch(present, cut):
    """The cut where ``present`` is 1, nothing where it is 0."""
    return dr.select(present > 0.5, cut, _NOTHING)


# -- skirts ---------------------------------------------------------------------------------------------


def _draw_skirt(rng: np.random.Generator) -> dict[str, float]:
    given = _between(
        rng,
        waist=(0.17, 0.3),
        hip=(0.02, 0.16),
        length=(0.5, 1.5),
        flare=(-0.05, 0.45),
        curve=(0.6, 1.8),
        depth=(0.7, 1.0),
        tilt_x=(-0.15, 0.15),
        tilt_z=(-0.12, 0.12),
        slit_at=(-0.12, 0.12),
        slit_top=(0.3, 0.75),
        slit_width=(0.03, 0.08),
    )
    if rng.random() < 0.5:
        given["tilt_x"] *= 0.2
    top = given["length"] / 2
    return given | {"slit": _chance(rng, 0.2)} | _folds(rng, top - 0.1, -top, 0.09)


def _skirt_radius(y, top, given):
    down = dr.clip((top - y) / given["length"], 0, 1.3)
    return (
        given["waist"]
        + given["hip"] * smooth_step(down, 0, 0.35)
        + given["flare"] * dr.power(dr.maximum(down, 1e-4), given["curve"])
    )


def _skirt(p, given):
    top = given["length"] / 2
    s = column(p, _skirt_radius(p.y, top, given), given["depth"])
    cut = dr.minimum(top - p.y, _tilted(p, -top, given["tilt_x"], given["tilt_z"]))
    open_below = top - given["slit_top"] * given["length"]
    slit = dr.maximum(
        dr.maximum(
            dr.abs(p.x - given["slit_at"]) - given["slit_width"] * dr.clip((open_below - p.y) / 0.2, 0, 1),
            p.y - open_below,
        ),
        -p.z,
    )
    return s, dr.minimum(cut, _switch(given["slit"], slit))


# -- what hangs on shoulders ----------------------------------------------------------------------------


def _draw_torso(rng: np.random.Generator) -> dict[str, float]:
    given = _between(
        rng,
        chest=(0.22, 0.31),
        waist=(0.16, 0.28),
        hip=(0.2, 0.32),
        depth=(0.58, 0.85),
        shoulder_slope=(0.12, 0.5),
        arm=(0.08, 0.13),
        cuff=(0.06, 0.15),
        arm_angle=(0.55, 1.45),
        arm_lift=(-0.12, 0.12),
        neck_x=(0.1, 0.18),
        neck_y=(0.08, 0.22),
        neck_z=(0.1, 0.17),
        neck_front=(0.0, 0.07),
        vee=(0.06, 0.32),
        vee_width=(0.25, 0.6),
        tilt_x=(-0.12, 0.12),
        tilt_z=(-0.1, 0.1),
        front_gap=(0.03, 0.08),
        front_slope=(0, 0.12),
        one_angle=(0.35, 0.6),
        strapless_at=(0.18, 0.28),
    )
    given["waist"] = min(given["waist"], given["chest"])
    style = rng.choice(["sleeves", "sleeveless", "strapless", "one shoulder"], p=[0.62, 0.2, 0.1, 0.08])
    given["sleeve"] = float(rng.uniform(0.16, 0.62)) if style in ("sleeves", "one shoulder") else 0.05
    if style == "sleeveless":
        given |= {"arm": float(rng.uniform(0.1, 0.14)), "arm_angle": float(rng.uniform(1.2, 1.5))}
        given["cuff"] = given["arm"]
    return given | {
        "strapless": float(style == "strapless"),
        "one": float(style == "one shoulder"),
        "vee_neck": _chance(rng, 0.35),
        "front": 0.0,
        "mirrored": float(rng.choice([-1.0, 1.0])),
    }


def _torso_loops(given: dict[str, float]) -> int:
    if given["strapless"]:
        return 2
    return 3 if given["one"] or given["front"] else 4


_SHOULDER = 0.5


def _torso(p, given, lower):
    """A torso with arms over a lower part of the radius ``lower``."""
    radius = given["waist"] + (given["chest"] - given["waist"]) * smooth_step(p.y, 0.05, 0.3)
    radius = dr.select(p.y < 0.05, lower, radius)
    body = column(p, radius, given["depth"])
    body = smooth_cut(body, p.y - _SHOULDER + given["shoulder_slope"] * dr.abs(p.x), 0.12)
    cut = dr.full(type(p.x), _NOTHING, dr.width(p.x))
    s = body
    for side in (1.0, -1.0):
        angle = given["arm_angle"] + side * given["arm_lift"]
        direction = type(p)(side * dr.sin(angle), -dr.cos(angle), 0)
        start = type(p)(
            side * (given["chest"] - given["arm"]),
            _SHOULDER - 0.02 - given["arm"] - given["shoulder_slope"] * (given["chest"] - given["arm"]),
            0,
        )
        # To the shoulder's edge it runs inside the torso.
        end = given["arm"] + given["sleeve"]
        arm, along, away = limb(p, start, direction, end + 0.12, given["arm"], given["cuff"])
        s = smooth_union(s, arm, 0.06)
        widest = dr.maximum(given["arm"], given["cuff"])
        cut = dr.minimum(cut, dr.maximum(end - along, away - 1.7 * widest))
    neck = type(p)(0, _SHOULDER, given["neck_front"])
    across = type(p)(
        (p.x - neck.x) / given["neck_x"], (p.y - neck.y) / given["neck_y"], (p.z - neck.z) / given["neck_z"]
    )
    neckline = (dr.norm(across) - 1) * given["neck_x"]
    vee = dr.maximum(dr.abs(p.x) - given["vee_width"] * (p.y - _SHOULDER + given["vee"]), -p.z)
    neckline = dr.minimum(neckline, _switch(given["vee_neck"], vee))
    strapless = given["strapless_at"] + 0.1 * p.x * given["one_angle"] - p.y
    one = 0.2 - p.y + given["mirrored"] * p.x / given["one_angle"] * 0.45
    above = dr.minimum(cut, neckline)
    above = dr.minimum(above, _switch(given["one"], one))
    above = dr.select(given["strapless"] > 0.5, strapless, above)
    s = dr.select(given["strapless"] > 0.5, column(p, radius, given["depth"]), s)
    front = _opening(p, given["front_gap"], given["front_slope"], _SHOULDER)
    return s, dr.minimum(above, _switch(given["front"], front))


def _draw_top(rng: np.random.Generator) -> dict[str, float]:
    given = _draw_torso(rng) | _between(rng, bottom=(-0.45, -0.05))
    if not given["strapless"] and not given["one"]:
        given["front"] = _chance(rng, 0.25)
    return given | _folds(rng, 0.2, given["bottom"], 0.03)


def _top(p, given):
    lower = given["waist"] + (given["hip"] - given["waist"]) * smooth_step(0.05 - p.y, 0, 0.4)
    s, cut = _torso(p, given, lower)
    return s, dr.minimum(cut, _tilted(p, given["bottom"], given["tilt_x"], given["tilt_z"]))


def _draw_dress(rng: np.random.Generator) -> dict[str, float]:
    given = _draw_torso(rng) | _between(rng, bottom=(-0.95, -0.35), flare=(0.0, 0.5), curve=(0.7, 1.8))
    given["sleeve"] = min(given["sleeve"], 0.45)
    return given | _folds(rng, -0.05, given["bottom"], 0.08)


def _dress(p, given):
    down = dr.clip(0.05 - p.y, 0, 1)
    lower = (
        given["waist"]
        + (given["hip"] - given["waist"]) * smooth_step(down, 0, 0.35)
        + given["flare"] * dr.power(dr.maximum(down, 1e-4), given["curve"])
    )
    s, cut = _torso(p, given, lower)
    return s, dr.minimum(cut, _tilted(p, given["bottom"], given["tilt_x"], given["tilt_z"]))


# -- trousers -------------------------------------------------------------------------------------------


def _draw_trousers(rng: np.random.Generator) -> dict[str, float]:
    given = _between(
        rng,
        waist=(0.19, 0.26),
        hip=(0.25, 0.31),
        depth=(0.65, 0.85),
        rise=(0.28, 0.45),
        leg=(0.12, 0.15),
        stance=(0.03, 0.16),
        length=(0.18, 1.2),
        tilt_x=(-0.04, 0.04),
        tilt_z=(-0.1, 0.1),
        top_tilt=(-0.12, 0.12),
        flare=(-0.05, 0.06),
        stride=(-0.15, 0.15),
    )
    given["apart"] = given["leg"] + float(rng.uniform(0.02, 0.04))
    return given | _no_folds()


def _trousers(p, given):
    crotch = 0.25
    top = crotch + given["rise"]
    hips = given["waist"] + (given["hip"] - given["waist"]) * smooth_step(top - p.y, 0, 0.3)
    body = smooth_cut(column(p, hips, given["depth"]), crotch - p.y, 0.12)
    s = body
    for side in (1.0, -1.0):
        direction = dr.normalize(
            type(p)(
                side * (given["stance"] + dr.maximum(given["flare"], 0) * 1.2), -1, side * given["stride"]
            )
        )
        start = type(p)(side * given["apart"], crotch + 0.05, 0)
        leg, _, _ = limb(p, start, direction, 2.0, given["leg"], given["leg"] + 1.5 * given["flare"])
        s = smooth_union(s, leg, 0.07)
    cut = dr.minimum(
        -_tilted(p, top, given["tilt_x"], given["top_tilt"]),
        _tilted(p, crotch - given["length"], given["tilt_x"], given["tilt_z"]),
    )
    return s, cut


# -- hats and capes -------------------------------------------------------------------------------------


def _draw_hat(rng: np.random.Generator) -> dict[str, float]:
    given = _between(
        rng,
        crown=(0.26, 0.42),
        height=(0.22, 0.6),
        wall=(0.05, 0.16),
        dome=(0, 0.9),
        depth=(0.8, 1.15),
        brim=(0.02, 0.48),
        curl=(-0.5, 1.0),
        dent=(0, 0.16),
        dent_width=(0.06, 0.14),
        roll=(-0.25, 0.25),
        wave=(0, 0.07),
        wave_phase=(0, 6.28),
        off=(-0.07, 0.07),
    )
    if rng.random() < 0.5:
        given["dent"] = 0.0
    return given | {"wave_count": float(rng.integers(2, 7))} | _no_folds()


def _hat(p, given):
    r = dr.sqrt(dr.square(p.x - given["off"]) + dr.square(p.z / given["depth"]))
    turn = dr.atan2(p.z / given["depth"], p.x - given["off"])
    inside = 1 - smooth_step(r, given["crown"] - given["wall"], given["crown"] + given["wall"])
    top = given["height"] * (1 - given["dome"] * 0.5 * dr.square(dr.minimum(r / given["crown"], 1)))
    dent = given["dent"] * dr.exp(-dr.square(p.x / given["dent_width"]) - dr.square(p.z / 0.3))
    past = dr.maximum(r - given["crown"], 0)
    # The brim's waves fade towards the crown.
    brim = given["curl"] * dr.square(past) + past * (
        given["wave"] * 4 * dr.sin(given["wave_count"] * turn + given["wave_phase"])
        + given["roll"] * dr.cos(2 * turn)
    )
    s = p.y + 0.25 - (inside * (top - dent) + brim)
    return s, given["crown"] + given["wall"] + given["brim"] - r


def _draw_cape(rng: np.random.Generator) -> dict[str, float]:
    given = _between(
        rng,
        shoulder=(0.26, 0.38),
        dome=(0.2, 0.45),
        length=(0.5, 1.35),
        flare=(0.05, 0.45),
        curve=(0.7, 1.6),
        depth=(0.6, 0.9),
        neck_x=(0.1, 0.17),
        neck_y=(0.07, 0.2),
        neck_z=(0.09, 0.15),
        gap=(0.03, 0.12),
        slope=(0, 0.3),
        tilt_x=(-0.18, 0.18),
        tilt_z=(-0.15, 0.15),
    )
    return given | {"front": _chance(rng, 0.7)} | _folds(rng, 0.3, 0.6 - given["length"], 0.08)


def _cape(p, given):
    top = 0.6
    down = dr.maximum(top - p.y, 0)
    # Round over the shoulders, then a cone.
    part = dr.clip(down / given["dome"], 0, 1)
    radius = given["shoulder"] * dr.sqrt(dr.maximum(1 - dr.square(1 - part), 1e-6))
    radius += given["flare"] * dr.power(dr.maximum(down, 1e-4), given["curve"])
    s = smooth_cut(column(p, radius, given["depth"]), p.y - top, 0.06)
    neck = dr.norm(type(p)(p.x / given["neck_x"], (p.y - top) / given["neck_y"], p.z / given["neck_z"])) - 1
    cut = dr.minimum(
        neck * given["neck_x"], _tilted(p, top - given["length"], given["tilt_x"], given["tilt_z"])
    )
    front = _opening(p, given["gap"], given["slope"], top)
    return s, dr.minimum(cut, _switch(given["front"], front))


KINDS: dict[str, Kind] = {
    "skirt": Kind(_draw_skirt, _skirt, lambda _: 2),
    "dress": Kind(_draw_dress, _dress, _torso_loops),
    "top": Kind(_draw_top, _top, _torso_loops),
    "trousers": Kind(_draw_trousers, _trousers, lambda _: 3),
    "hat": Kind(_draw_hat, _hat, lambda _: 1),
    "cape": Kind(_draw_cape, _cape, lambda given: 1 if given["front"] else 2),
}
