"""Captures of every format with known cameras, written from first principles, not with the code under test.

The object is a textured ball; its images are computed in closed form, lens distortion included.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

BALL, RADIUS = np.array([0.3, -0.2, 0.1]), 0.7


@dataclass(frozen=True)
class KnownCamera:
    """A camera by where it stands and looks; pixel coordinates from the corner of the upper left pixel."""

    origin: np.ndarray
    forward: np.ndarray
    up: np.ndarray
    width: int = 60
    height: int = 44
    fx: float = 70.0
    fy: float = 70.0
    cx: float = 30.0
    cy: float = 22.0
    lens: dict = field(default_factory=dict)

    @property
    def right(self) -> np.ndarray:
        return np.cross(self.forward, self.up)

    def ideal(self, points: np.ndarray) -> np.ndarray:
        """(right, down) over depth."""
        d = points - self.origin
        return np.stack([d @ self.right, -(d @ self.up)], axis=1) / (d @ self.forward)[:, None]

    def project(self, points: np.ndarray, distorted: bool = True) -> np.ndarray:
        q = self.ideal(points)
        q = distort(q, **self.lens) if distorted else q
        return q * [self.fx, self.fy] + [self.cx, self.cy]

    def render(self, distorted: bool = True, samples: int = 4) -> np.ndarray:
        """(h, w, 4) linear premultiplied: pixels are averages over samples x samples points."""
        n = samples
        v, u = (np.mgrid[: self.height * n, : self.width * n] + 0.5) / n
        q = np.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy], axis=-1)
        q = undistort(q, **self.lens) if distorted and self.lens else q
        d = self.forward + q[..., :1] * self.right - q[..., 1:] * self.up
        d /= np.linalg.norm(d, axis=-1, keepdims=True)
        to_ball = BALL - self.origin
        along = d @ to_ball
        room = RADIUS**2 - (to_ball @ to_ball - along**2)
        p = self.origin + (along - np.sqrt(np.maximum(room, 0)))[..., None] * d
        color = 0.5 + 0.35 * np.sin(4 * p + [0, 1, 2])
        rgba = np.concatenate([color, np.ones_like(color[..., :1])], axis=-1) * (room > 0)[..., None]
        return rgba.reshape(self.height, n, self.width, n, 4).mean(axis=(1, 3))


def distort(q, k1=0.0, k2=0.0, p1=0.0, p2=0.0, k3=0.0, k4=0.0):
    """OpenCV's documentation, "Camera Calibration and 3D Reconstruction", and one more radial term."""
    x, y = q[..., 0], q[..., 1]
    r = np.sqrt(x**2 + y**2)
    f = 1 + k1 * r**2 + k2 * r**4 + k3 * r**6 + k4 * r**8
    return np.stack(
        [x * f + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2), y * f + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y],
        axis=-1,
    )


def undistort(q, **lens):
    ideal = q.copy()
    for _ in range(60):  # converges for lenses as mild as these
        ideal += q - distort(ideal, **lens)
    assert np.abs(distort(ideal, **lens) - q).max() < 1e-9
    return ideal


def known_cameras(count=12, up=(0, 0, 1), **intrinsics) -> list[KnownCamera]:
    """All around the ball, none aimed quite at its centre."""
    rng = np.random.default_rng(5)
    up = np.array(up, float)
    cameras = []
    for k in range(count):
        z = 1 - (2 * k + 1) / count
        a = k * np.pi * (3 - 5**0.5)
        direction = np.array([np.sqrt(1 - z * z) * np.cos(a), np.sqrt(1 - z * z) * np.sin(a), z])
        origin = BALL + (3.0 + 0.3 * rng.random()) * direction
        forward = BALL + 0.1 * rng.standard_normal(3) - origin
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, up)
        right /= np.linalg.norm(right)
        cameras.append(KnownCamera(origin, forward, np.cross(right, forward), **intrinsics))
    return cameras


def points(count=200) -> np.ndarray:
    rng = np.random.default_rng(1)
    p = rng.standard_normal((count, 3))
    return BALL + RADIUS * p / np.linalg.norm(p, axis=1, keepdims=True)


# --- images


def encoded(linear: np.ndarray) -> np.ndarray:
    return np.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055
    )


def straight_png(rgba: np.ndarray) -> np.ndarray:
    color = encoded(rgba[..., :3] / np.maximum(rgba[..., 3:], 1e-6))
    return (np.concatenate([color, rgba[..., 3:]], axis=-1) * 255 + 0.5).astype(np.uint8)


def write_image(path: Path, camera: KnownCamera, mask: Path | None = None) -> None:
    """PNG with alpha; or, with the path of a mask, RGB on grey and the mask apart."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rgba = camera.render()
    if mask is None:
        Image.fromarray(straight_png(rgba)).save(path)
        return
    mask.parent.mkdir(parents=True, exist_ok=True)
    for target, values in ((path, encoded(rgba[..., :3] + 0.2 * (1 - rgba[..., 3:]))), (mask, rgba[..., 3])):
        Image.fromarray((values * 255 + 0.5).astype(np.uint8)).save(target)


# --- formats


def write_nerf(folder: Path, cameras: list[KnownCamera], flavour: str = "blender") -> Path:
    """Blender's (angle, no suffix, z up), instant-ngp's (shared intrinsics) or nerfstudio's (per frame)."""
    frames = []
    for k, c in enumerate(cameras):
        matrix = np.eye(4)
        matrix[:3] = np.stack([c.right, c.up, -c.forward, c.origin], axis=1)
        name = f"train/r_{k}" if flavour == "blender" else f"images/frame_{k:05}.png"
        write_image(folder / (name + (".png" if flavour == "blender" else "")), c)
        frame = {
            "file_path": "./" + name if flavour == "blender" else name,
            "transform_matrix": matrix.tolist(),
        }
        if flavour == "nerfstudio":
            frame |= _intrinsics(c)
        frames.append(frame)
    first, document = cameras[0], {"frames": frames}
    if flavour == "blender":
        document["camera_angle_x"] = 2 * np.arctan(first.width / 2 / first.fx)
    elif flavour == "ngp":
        document |= _intrinsics(first) | {"aabb_scale": 4, "camera_angle_x": 0.1}
    else:
        document["camera_model"] = "OPENCV"
    name = "transforms_train.json" if flavour == "blender" else "transforms.json"
    (folder / name).write_text(json.dumps(document))
    return folder


def _intrinsics(c: KnownCamera) -> dict:
    return {"fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy, "w": c.width, "h": c.height, **c.lens}


def write_colmap(
    folder: Path, cameras: list[KnownCamera], model: str = "PINHOLE", binary: bool = True
) -> Path:
    """sparse/0, images/ and masks/; a camera per image, numbered out of order."""
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    entries = []
    for k, c in enumerate(cameras):
        name = f"IMG {k:02}.png"
        write_image(folder / "images" / name, c, folder / "masks" / (name + ".png"))
        to_camera = np.stack([c.right, -c.up, c.forward])
        x, y, z, w = Rotation.from_matrix(to_camera).as_quat()
        lens = [c.lens.get(key, 0.0) for key in ("k1", "k2", "p1", "p2")]
        shared = [c.fx, c.cx, c.cy]
        parameters = {
            "SIMPLE_PINHOLE": shared,
            "PINHOLE": [c.fx, c.fy, c.cx, c.cy],
            "SIMPLE_RADIAL": [*shared, lens[0]],
            "RADIAL": [*shared, *lens[:2]],
            "OPENCV": [c.fx, c.fy, c.cx, c.cy, *lens],
        }[model]
        entries.append((100 - k, c, parameters, [w, x, y, z, *(-to_camera @ c.origin)], name))
    if binary:
        number = ["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"].index(model)
        data = struct.pack("<Q", len(entries))
        for i, c, p, _, _ in entries:
            data += struct.pack(f"<iiQQ{len(p)}d", i, number, c.width, c.height, *p)
        (sparse / "cameras.bin").write_bytes(data)
        data = struct.pack("<Q", len(entries))
        for i, _, _, pose, name in reversed(entries):
            data += struct.pack("<i7di", i + 7, *pose, i) + name.encode() + b"\0"
            data += struct.pack("<Q", 2) + struct.pack("<ddqddq", 1.5, 2.5, -1, 3.5, 4.5, 8)
        (sparse / "images.bin").write_bytes(data)
    else:
        text = "".join(
            f"{i} {model} {c.width} {c.height} {' '.join(map(repr, map(float, p)))}\n"
            for i, c, p, _, _ in entries
        )
        (sparse / "cameras.txt").write_text("# Camera list\n" + text)
        text = "".join(
            f"{i + 7} {' '.join(map(repr, map(float, pose)))} {i} {name}\n"
            + ("1.5 2.5 -1\n" if i % 2 else "\n")
            for i, _, _, pose, name in entries
        )
        (sparse / "images.txt").write_text("# Image list with two lines of data per image:\n" + text)
    return folder


def write_idr(folder: Path, cameras: list[KnownCamera]) -> Path:
    """cameras_sphere.npz, image/ and mask/ (numbered differently); pixels with integer centres."""
    arrays = {}
    for k, c in enumerate(cameras):
        write_image(folder / "image" / f"{k:06}.png", c, folder / "mask" / f"{k:03}.png")
        intrinsic = np.array([[c.fx, 0, c.cx - 0.5], [0, c.fy, c.cy - 0.5], [0, 0, 1]])
        to_camera = np.stack([c.right, -c.up, c.forward])
        world = np.eye(4)
        # A projection may come with any factor.
        factor = -2.5 if k % 2 else 40.0
        world[:3] = factor * intrinsic @ np.column_stack([to_camera, -to_camera @ c.origin])
        scale = np.diag([1.2 * RADIUS] * 3 + [1.0])
        scale[:3, 3] = BALL
        arrays |= {
            f"world_mat_{k}": world,
            f"scale_mat_{k}": scale,
            f"world_mat_inv_{k}": np.linalg.inv(world),
        }
    np.savez(folder / "cameras_sphere.npz", **arrays)
    return folder


def write_llff(folder: Path, cameras: list[KnownCamera], shrunk: int = 1) -> Path:
    """poses_bounds.npy and images/ with alpha; the file's intrinsics may be of larger originals."""
    rows = []
    for k, c in enumerate(cameras):
        write_image(folder / "images" / f"image{k:03}.png", c)
        matrix = np.stack(
            [-c.up, c.right, -c.forward, c.origin, [shrunk * c.height, shrunk * c.width, shrunk * c.fx]],
            axis=1,
        )
        rows.append([*matrix.ravel(), 1.0, 9.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return folder


def write_mitsuba(folder: Path, cameras: list[KnownCamera]) -> Path:
    """sensors.xml and OpenEXR images."""
    import mitsuba as mi

    sensors = []
    for k, c in enumerate(cameras):
        mi.Bitmap(c.render().astype(np.float32)).write(str(folder / f"shot_{k}.exr"))
        target = c.origin + c.forward
        numbers = ["{}, {}, {}".format(*map(repr, map(float, v))) for v in (c.origin, target, c.up)]
        fov = np.degrees(2 * np.arctan(c.width / 2 / c.fx))
        sensors.append(f"""<sensor type="perspective" id="shot_{k}"> <float name="fov" value="{fov}"/>
            <transform name="to_world">
                <lookat origin="{numbers[0]}" target="{numbers[1]}" up="{numbers[2]}"/> </transform>
            <film type="hdrfilm"> <integer name="width" value="{c.width}"/>
                <integer name="height" value="{c.height}"/> <rfilter type="box"/> </film> </sensor>""")
    (folder / "sensors.xml").write_text('<scene version="3.0.0">' + "\n".join(sensors) + "</scene>")
    return folder


LENS = {"k1": -0.12, "k2": 0.04, "p1": 0.003, "p2": -0.002}
OFF_CENTRE = {"cx": 31.7, "cy": 20.4}

#: Name: function of a folder that writes the capture there, and the true cameras.
CAPTURES = {
    "Blender": (known_cameras(), write_nerf),
    "instant-ngp": (known_cameras(**OFF_CENTRE, fy=71.5, lens=LENS), lambda f, c: write_nerf(f, c, "ngp")),
    "nerfstudio": (
        [
            KnownCamera(
                c.origin,
                c.forward,
                c.up,
                fx=70 + k,
                fy=70 + k,
                cx=30 + k / 7,
                cy=22 - k / 9,
                lens=LENS | {"k3": 0.01, "k4": -0.01},
            )
            for k, c in enumerate(known_cameras())
        ],
        lambda f, c: write_nerf(f, c, "nerfstudio"),
    ),
    **{
        f"COLMAP {model} {'binary' if binary else 'text'}": (
            known_cameras(**OFF_CENTRE, **options, up=(0.1, -1, 0.2)),
            lambda f, c, m=model, b=binary: write_colmap(f, c, m, b),
        )
        for binary in (True, False)
        for model, options in {
            "SIMPLE_PINHOLE": {},
            "PINHOLE": {"fy": 68.0},
            "SIMPLE_RADIAL": {"lens": {"k1": 0.1}},
            "RADIAL": {"lens": {"k1": -0.1, "k2": 0.05}},
            "OPENCV": {"fy": 71.0, "lens": LENS},
        }.items()
    },
    "IDR": (known_cameras(**OFF_CENTRE, fy=70.4, up=(0, -1, 0)), write_idr),
    "LLFF": (known_cameras(), write_llff),
    "LLFF of larger originals": (known_cameras(), lambda f, c: write_llff(f, c, shrunk=4)),
    "Mitsuba": (known_cameras(up=(0, 1, 0)), write_mitsuba),
}
