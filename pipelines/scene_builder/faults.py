"""What sets a photographed capture apart from a clean one, each with its own switch and size.

Every function takes its own random numbers (``Dice``): switching one fault off changes nothing of the others.
"""

import math
from dataclasses import dataclass, fields

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

from gshell_mi.errors import UserError

#: Pixels over which the outline of a mask wavers.
_WAVER = 10.0
#: Linear radiance of the stand.
STAND_GREY = 0.3
#: Degrees above and below the horizon in which a view counts as level.
LEVEL_DEGREES = 20.0


@dataclass(frozen=True)
class Faults:
    """Sizes of the faults; 0 switches one off. The defaults are those of a careful amateur."""

    relief: float = 0.4
    """Fine relief pressed into the surface: its amplitude in per cent of the object's largest extent."""
    print: float = 1.0
    """Fine colour printed onto the surface: 1 is full contrast."""
    gloss: float = 0.65
    """Gloss: the object's own roughness is multiplied by 1 minus this."""
    pose_degrees: float = 0.12
    """Errors of the cameras' orientations, root mean square in degrees."""
    pose_percent: float = 0.12
    """Errors of the cameras' places, root mean square in per cent of the distance to the object."""
    exposure_stops: float = 0.1
    """Differences of exposure between views, standard deviation in stops."""
    white_balance: float = 2.0
    """Differences of white balance between views, standard deviation in per cent of each channel."""
    mask_pixels: float = 1.5
    """How far the outlines of the masks waver, root mean square in pixels."""
    mask_erosion: float = 0.5
    """By how many pixels all masks are too small."""
    stand: float = 4.0
    """In level views, what is lower than this, in per cent of the object's height, is hidden by a stand, and
    is not in the masks."""
    close_ups: float = 0.25
    """Share of the views that are close-ups, which cut the object off."""
    noise: float = 1.5
    """Noise of the sensor, standard deviation in steps of 1/255 of the sRGB values."""
    jpeg: int = 94
    """Quality of the JPEG files; 0 writes PNG files."""

    def __post_init__(self):
        for field in fields(self):
            value, limit = getattr(self, field.name), _MOST.get(field.name, math.inf)
            if not 0 <= value <= limit:
                bound = "not be negative" if limit == math.inf else f"lie in 0 to {limit:g}"
                raise UserError(f"--{field.name.replace('_', '-')} must {bound}, and is {value:g}.")


_MOST = {"print": 1, "gloss": 0.95, "stand": 50, "close_ups": 0.9, "jpeg": 100}

#: No faults at all.
CLEAN = Faults(**{field.name: 0 for field in fields(Faults)})


class Dice:
    """Random numbers by seed, fault and view: none depends on what else was drawn."""

    def __init__(self, seed: int):
        self.seed = seed

    def __call__(self, fault: str, view: int = 0) -> np.random.Generator:
        return np.random.default_rng([self.seed, view, *fault.encode()])


def wrong_pose(pose: np.ndarray, degrees: float, percent: float, rng: np.random.Generator) -> np.ndarray:
    """A (4, 4) camera-to-world pose as somebody has found it.

    Args:
        pose: the true one of a camera that photographs an object at the origin.
        degrees: root mean square of the angle that it is turned by, about any axis.
        percent: root mean square of the distance that it is moved by, of that to the origin.
    """
    turn, move = rng.standard_normal((2, 3)) / math.sqrt(3)
    wrong = pose.copy()
    wrong[:3, :3] = Rotation.from_rotvec(math.radians(degrees) * turn).as_matrix() @ pose[:3, :3]
    wrong[:3, 3] += percent / 100 * np.linalg.norm(pose[:3, 3]) * move
    return wrong


def exposure(stops: float, white_balance: float, rng: np.random.Generator) -> tuple[float, np.ndarray]:
    """One view's exposure in stops and white balance, factors (3,) with geometric mean 1."""
    error = float(rng.normal(0, 1)) * stops
    balance = rng.normal(0, 1, 3) * white_balance / 100
    return error, np.exp(balance - balance.mean())


def wrong_mask(coverage: np.ndarray, waver: float, erosion: float, rng: np.random.Generator) -> np.ndarray:
    """A mask (h, w) in [0, 1] as somebody has cut it.

    Args:
        coverage: the true one.
        waver: root mean square of how far its outline strays, in pixels.
        erosion: pixels by which it is too small.
    """
    inside = coverage > 0.5
    if not (waver or erosion) or inside.all() or not inside.any():
        return coverage
    # To the outline, which runs between pixels.
    within = np.where(
        inside, ndimage.distance_transform_edt(inside) - 0.5, 0.5 - ndimage.distance_transform_edt(~inside)
    )
    return (within + waver * _smooth_noise(coverage.shape, _WAVER, rng) > erosion).astype(float)


def is_level(pose: np.ndarray) -> bool:
    """Whether a camera stands so low that it sees the stand from the side."""
    place = pose[:3, 3]
    return abs(place[1]) < math.sin(math.radians(LEVEL_DEGREES)) * np.linalg.norm(place)


def behind_stand(
    linear: np.ndarray, coverage: np.ndarray, hidden: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The image (h, w, 3) and the coverage (h, w) with a stand before the share ``hidden`` (h, w) of each
    pixel."""
    share = hidden[..., None]
    return linear * (1 - share) + STAND_GREY * share, coverage - hidden


def wall(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Linear radiance (h, w, 1) of an unevenly lit grey wall."""
    return (0.18 + 0.02 * _smooth_noise(shape, 40.0, rng))[..., None]


def with_noise(encoded: np.ndarray, steps: float, rng: np.random.Generator) -> np.ndarray:
    """sRGB values with a sensor's noise of ``steps`` / 255."""
    return encoded + steps / 255 * rng.standard_normal(encoded.shape)


def _smooth_noise(shape: tuple[int, int], scale: float, rng: np.random.Generator) -> np.ndarray:
    noise = ndimage.gaussian_filter(rng.standard_normal(shape), scale, mode="wrap")
    return noise / noise.std()
