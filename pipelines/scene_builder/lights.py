"""Environment maps: an analytic sky with a soft sun, and a studio of soft boxes.

Maps are ``(height, 2 * height, 3)`` linear Rec. 709 radiance in the layout of Mitsuba's ``envmap``
(y up, equirectangular).
"""

import mitsuba as mi
import numpy as np

HEIGHT = 64


def directions(height: int = HEIGHT) -> np.ndarray:
    """Unit directions at which Mitsuba's ``envmap`` shows each pixel, ``(height, 2 * height, 3)``.

    The first and last rows lie on the poles; columns are centred half a pixel from phi = 0.
    """
    theta = np.linspace(0, np.pi, height)
    phi = (np.arange(2 * height) + 0.5) / height * np.pi
    t, p = np.meshgrid(theta, phi, indexing="ij")
    return np.stack([np.sin(p) * np.sin(t), np.cos(t), -np.cos(p) * np.sin(t)], -1)


def direction(azimuth: float, elevation: float) -> np.ndarray:
    """The unit vector at ``azimuth`` from +z towards +x and ``elevation`` above the horizon, degrees."""
    a, e = np.radians([azimuth, elevation])
    return np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])


def lobe(towards: np.ndarray, degrees: float, height: int = HEIGHT) -> np.ndarray:
    """A von Mises-Fisher lobe ``degrees`` wide (standard deviation) with integral 1 over the sphere."""
    d = directions(height)
    kappa = np.radians(degrees) ** -2
    value = np.exp(kappa * (d @ towards - 1))
    return value / (value * solid_angle(height)[:, None]).sum()


def solid_angle(height: int = HEIGHT) -> np.ndarray:
    """Solid angle that a pixel of each row stands for, ``(height,)``; 4 pi over all pixels."""
    step = np.pi / (height - 1)
    theta = np.linspace(0, np.pi, height)
    lo, hi = np.clip(theta - step / 2, 0, np.pi), np.clip(theta + step / 2, 0, np.pi)
    return (np.cos(lo) - np.cos(hi)) * np.pi / height


def sunny_sky(
    azimuth: float,
    elevation: float,
    *,
    turbidity: float = 3.0,
    sun_share: float = 0.6,
    sun_degrees: float = 5.0,
    exposure: float = 0.8,
    ground=(0.25, 0.22, 0.18),
) -> np.ndarray:
    """Mitsuba's Hosek-Wilkie sky, a sun of a few degrees and a ground that reflects both.

    ``sun_share`` is the sun's part of the irradiance on the ground. The real sun, half a degree wide,
    would fit no map of this size. ``exposure`` is the radiance of a white floor.
    """
    sun = direction(azimuth, elevation)
    to_z_up = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    sky = mi.load_dict(
        {
            "type": "sunsky",
            "sun_direction": [float(x) for x in to_z_up @ sun],
            "turbidity": turbidity,
            "albedo": 0.25,
            "sun_scale": 0.0,
        }
    )
    d = directions().reshape(-1, 3)
    si = mi.SurfaceInteraction3f()
    si.wi = -mi.Vector3f(np.ascontiguousarray((d @ to_z_up.T).T, dtype=np.float32))
    image = np.array(sky.eval(si)).T.reshape(HEIGHT, 2 * HEIGHT, 3)

    up = np.clip(directions()[..., 1], 0, None)
    weight = (up * solid_angle()[:, None])[..., None]
    image *= np.pi * exposure * (1 - sun_share) / (image * weight).sum((0, 1)).mean()
    disc = lobe(sun, sun_degrees)[..., None] * [1.0, 0.9, 0.75]
    disc *= np.pi * exposure * sun_share / (disc * weight).sum((0, 1)).mean()
    image += disc
    floor = np.asarray(ground) * (image * weight).sum((0, 1)) / np.pi
    above = np.clip(directions()[..., 1:2] / 0.1 + 0.5, 0, 1)
    return above * image + (1 - above) * floor


def studio(boxes, *, ambient=(0.35, 0.36, 0.38)) -> np.ndarray:
    """A dim room with soft boxes ``(azimuth, elevation, degrees, colour)``, colour in irradiance."""
    image = np.ones((HEIGHT, 2 * HEIGHT, 3)) * ambient
    # Brighter above than below, so that the room has a floor.
    image *= 0.75 + 0.25 * directions()[..., 1:2]
    for azimuth, elevation, degrees, colour in boxes:
        image += lobe(direction(azimuth, elevation), degrees)[..., None] * np.asarray(colour)
    return image
