"""A fit scene that takes seconds: an open half-sphere under 12 small views, rendered by stock Mitsuba."""

from pathlib import Path

import mitsuba as mi
import numpy as np
import trimesh

RADIUS = 0.6
VIEWS = 12
SIZE = 48

#: Options of the command that make the fit short. Those of the openings suit so small a scene and few steps.
SHORT = (
    "--openings.iterations",
    "100",
    "--radiance.batch",
    "16384",
    "--radiance.smoothing",
    "8",
    "--openings.mask",
    "0.01",
    "--openings.binary",
    "0.015",
    "--openings.closing",
    "0.003",
    "--cavities.iterations",
    "10",
    "--cavities.batch",
    "4096",
    "--volume.iterations",
    "0",
    "--refinement.iterations",
    "8",
    "--folds.iterations",
    "0",
    "--iterations",
    "12",
    "--render.spp",
    "2",
    "--render.primal-spp",
    "4",
    "--render.max-depth",
    "2",
    "--texture.rounds",
    "0",
    "--occlusion.most",
    "0",
    "--model.light-height",
    "8",
    "--no-report",
)

#: Added to these where openings do not matter: hardly any steps, and the template stays closed.
CLOSED = (
    "--openings.iterations",
    "5",
    "--openings.rounds",
    "0",
    "--cavities.iterations",
    "4",
    "--refinement.iterations",
    "2",
    "--smoothing.most",
    "0",
    "--openings.no-revise",
)


def half_sphere(segments: int = 32) -> trimesh.Trimesh:
    """The half y <= 0 of a sphere about the origin; open at the top, facing outwards."""
    rings = segments // 4
    angle = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    polar = np.linspace(0, np.pi / 2, rings + 1)[1:]
    points = np.stack(
        [
            np.outer(np.sin(polar), np.cos(angle)),
            np.outer(-np.cos(polar), np.ones(segments)),
            np.outer(np.sin(polar), np.sin(angle)),
        ],
        axis=-1,
    ).reshape(-1, 3)
    around = np.roll(np.arange(segments), -1)
    faces = [[0, 1 + i, 1 + around[i]] for i in range(segments)]
    for ring in range(rings - 1):
        low, high = 1 + ring * segments, 1 + (ring + 1) * segments
        for i in range(segments):
            faces += [[low + i, high + i, high + around[i]], [low + i, high + around[i], low + around[i]]]
    return trimesh.Trimesh(RADIUS * np.concatenate([[[0, -1, 0]], points]), faces, process=False)


def sensors_xml(views: int = VIEWS, size: int = SIZE) -> list[str]:
    """One perspective sensor per view, spread over the sphere."""
    index = np.arange(views) + 0.5
    y = 1 - 2 * index / views
    angle = np.pi * (1 + 5**0.5) * index
    origins = 3 * np.stack([np.sqrt(1 - y**2) * np.cos(angle), y, np.sqrt(1 - y**2) * np.sin(angle)], axis=1)
    return [
        f"""\
    <sensor type="perspective" id="view_{i:03}">
        <float name="fov" value="32"/>
        <transform name="to_world">
            <lookat origin="{x:.6f}, {y:.6f}, {z:.6f}" target="0, 0, 0" up="0, 1, 0"/>
        </transform>
        <film type="hdrfilm">
            <integer name="width" value="{size}"/> <integer name="height" value="{size}"/>
            <string name="pixel_format" value="rgba"/>
        </film>
    </sensor>"""
        for i, (x, y, z) in enumerate(origins)
    ]


def write_scene(folder: Path, views: int = VIEWS) -> Path:
    """Writes ``bowl.xml`` and ``bowl/reference.xml`` without targets; returns the former."""
    (folder / "bowl").mkdir(parents=True)
    _write_truth(folder / "bowl" / "truth.ply")
    sensors = "\n".join(sensors_xml(views))
    light = '<emitter type="constant" id="light"/>'
    path = folder / "bowl.xml"
    path.write_text(f"""\
<scene version="3.0.0">
    <shape type="gshell" id="subject"> <integer name="resolution" value="20"/> </shape>
    {light}
{sensors}
</scene>
""")
    (folder / "bowl" / "reference.xml").write_text(f"""\
<scene version="3.0.0">
    <integrator type="path"> <boolean name="hide_emitters" value="true"/> </integrator>
    <shape type="ply" id="subject">
        <string name="filename" value="truth.ply"/>
        <bsdf type="twosided"> <bsdf type="diffuse">
            <texture type="mesh_attribute" name="reflectance">
                <string name="name" value="vertex_color"/>
            </texture>
        </bsdf> </bsdf>
    </shape>
    {light}
{sensors}
</scene>
""")
    return path


def _write_truth(path: Path) -> None:
    """The half-sphere in a chequered print: on a plain one, light from everywhere would leave the inside
    as even as a lid."""
    truth = half_sphere()
    x, y, z = truth.vertices.T
    dark = (np.floor(np.arctan2(z, x) * 8 / np.pi + 0.5) + np.floor(6 * y / RADIUS)) % 2
    mesh = mi.Mesh("truth", len(truth.vertices), len(truth.faces))
    color = np.outer(0.7 - 0.55 * dark, [1, 0.7, 0.5]).astype(np.float32)
    mesh.add_attribute("vertex_color", 3, color.ravel())
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = truth.vertices.astype(np.float32).ravel()
    parameters["faces"] = truth.faces.astype(np.uint32).ravel()
    parameters.update()
    mesh.write_ply(str(path))


def write_fit_scene(folder: Path, views: int = VIEWS) -> Path:
    """The same with targets and without the reference."""
    path = write_scene(folder, views)
    truth = mi.load_file(str(folder / "bowl" / "reference.xml"))
    for index, sensor in enumerate(truth.sensors()):
        image = mi.render(truth, sensor=index, spp=64, seed=index)
        mi.Bitmap(image).write(str(folder / "bowl" / f"{sensor.id()}.exr"))
    (folder / "bowl" / "reference.xml").unlink()
    return path
