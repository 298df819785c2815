"""Derivatives of the extraction against finite differences, and its kernels over changing topology."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from gshell_mi.extraction import extract
from gshell_mi.lattice import GRIDS, make_lattice

RESOLUTION = 7


@pytest.fixture(params=GRIDS)
def grid(request) -> str:
    return request.param


def _fields(lattice) -> dict[str, np.ndarray]:
    """A cut sphere with all values well off 0, so that small steps change no sign."""
    rng = np.random.default_rng(3)
    p = lattice.vertex_positions()
    sdf = np.linalg.norm(p, axis=1) - 0.62 + rng.uniform(-0.03, 0.03, len(p))
    msdf = 0.23 - p[:, 2] + 0.4 * p[:, 0] + rng.uniform(-0.05, 0.05, len(p))
    for field in (sdf, msdf):
        field += np.where(np.abs(field) < 0.02, np.sign(field) * 0.02, 0)
    return {"sdf": sdf, "msdf": msdf, "deform": rng.uniform(-0.9, 0.9, 3 * len(p))}


def _objective(lattice, fields: dict):
    """A smooth function of everything that the mesh offers, and the faces."""
    mesh = extract(lattice, **fields)
    x, y, z = mesh.vertices
    index = dr.arange(mi.UInt32, mesh.vertex_count)
    weight = dr.sin(1.0 + mi.Float(index % 17))
    colour = mesh.interpolate(dr.sin(3 * lattice.points(mi.Float)))
    terms = weight * (x + 2 * y * z + dr.sin(3 * z) + 0.5 * mesh.msdf + colour.x * colour.z)
    return terms, mesh.faces.numpy()


def _directional(lattice, name: str, direction: np.ndarray, step: float) -> float:
    results = []
    for sign in (1, -1):
        fields = {k: mi.Float(v.astype(np.float32)) for k, v in _fields(lattice).items()}
        fields[name] = mi.Float((_fields(lattice)[name] + sign * step * direction).astype(np.float32))
        results.append(_objective(lattice, fields))
    np.testing.assert_array_equal(results[0][1], results[1][1])
    return float((results[0][0].numpy().astype(float) - results[1][0].numpy()).sum() / (2 * step))


@pytest.mark.parametrize("name", ["sdf", "msdf", "deform"])
def test_against_finite_differences(grid, name):
    lattice = make_lattice(grid, RESOLUTION)
    rng = np.random.default_rng(5)
    base = {k: mi.Float(v.astype(np.float32)) for k, v in _fields(lattice).items()}
    mesh = extract(lattice, **base)
    assert mesh.vertex_count > mesh.kept_vertex_count > 50
    for _ in range(3):
        direction = rng.normal(size=len(_fields(lattice)[name]))
        expected = _directional(lattice, name, direction, 1e-3 if name == "deform" else 1e-4)

        fields = dict(base)
        fields[name] = mi.Float(base[name])
        dr.enable_grad(fields[name])
        dr.set_grad(fields[name], mi.Float(direction.astype(np.float32)))
        forward = dr.forward_to(dr.sum(_objective(lattice, fields)[0]))[0]

        fields[name] = mi.Float(base[name])
        dr.enable_grad(fields[name])
        dr.backward(dr.sum(_objective(lattice, fields)[0]))
        reverse = dr.grad(fields[name]).numpy() @ direction
        assert forward == pytest.approx(expected, rel=1e-2, abs=2e-2)
        assert reverse == pytest.approx(forward, rel=1e-4, abs=1e-3)


def test_derivative_of_a_sphere_volume(grid):
    lattice = make_lattice(grid, 32)
    radius = mi.Float(0.6)
    dr.enable_grad(radius)
    mesh = extract(lattice, dr.norm(lattice.points(mi.Float)) - radius)
    a, b, c = (dr.gather(type(mesh.vertices), mesh.vertices, i) for i in mesh.faces)
    volume = dr.sum(dr.dot(a, dr.cross(b, c))) / 6
    dr.backward(volume)
    assert dr.grad(radius)[0] == pytest.approx(4 * np.pi * 0.6**2, rel=8e-3)


def test_plane_of_the_cut_moves_the_rim_alone(grid):
    lattice = make_lattice(grid, 32)
    p = lattice.points(mi.Float)
    height = mi.Float(0.1234)
    dr.enable_grad(height)
    mesh = extract(lattice, dr.norm(p) - 0.6, height - p.z)
    dr.forward_from(height)
    velocity = dr.grad(mesh.vertices.z).numpy()
    assert (velocity[: mesh.kept_vertex_count] == 0).all()
    np.testing.assert_allclose(velocity[mesh.kept_vertex_count :], 1, atol=0.02)


def test_gradients_of_slivers_are_finite(grid):
    """Zeros at lattice vertices: neither infinite nor dead."""
    lattice = make_lattice(grid, 6)
    rng = np.random.default_rng(0)
    sdf = mi.Float(rng.choice([-1, 0, 0, 1e-30, 1], lattice.vertex_count).astype(np.float32))
    msdf = mi.Float(rng.choice([-1e-20, 0, 0, 1], lattice.vertex_count).astype(np.float32))
    dr.enable_grad(sdf, msdf)
    mesh = extract(lattice, sdf, msdf)
    dr.backward(dr.sum(dr.squared_norm(mesh.vertices)))
    for field in (sdf, msdf):
        gradient = dr.grad(field).numpy()
        assert np.isfinite(gradient).all() and np.abs(gradient).max() < 1e9
    crossed = (sdf.numpy() == 0) & (dr.grad(sdf).numpy() != 0)
    assert crossed.any()


def _step(lattice, rng, level=0.3):
    """Forward and backward on a random smooth surface of its own topology, as new arrays."""
    p = lattice.vertex_positions()
    a, b, c, d = rng.uniform(1, 6, 4)
    sdf = np.sin(a * p[:, 0] + d) + np.sin(b * p[:, 1]) + np.sin(c * p[:, 2] + a)
    msdf = np.sin(b * p[:, 0]) + np.cos(c * p[:, 1] + a) + level
    deform = rng.uniform(-1, 1, 3 * len(p))
    fields = [mi.Float(f.astype(np.float32)) for f in (sdf, msdf, deform)]
    dr.enable_grad(fields)
    mesh = extract(lattice, *fields, template=True)
    loss = dr.sum(dr.squared_norm(mesh.vertices)) + dr.sum(mesh.template.msdf)
    dr.backward(loss)
    dr.eval([dr.grad(f) for f in fields])
    return mesh.vertex_count


def test_no_kernel_is_recompiled_over_changing_topology(grid):
    lattice, rng = make_lattice(grid, 16), np.random.default_rng(0)
    for level in (0.3, 3, 0.3):  # a surface that is not cut has fewer and other kernels
        _step(lattice, rng, level)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        counts = {_step(lattice, rng) for _ in range(100)}
        kernels = dr.kernel_history([dr.KernelType.JIT])
    assert len(counts) > 90, "the sizes must change for this to mean something"
    assert len(kernels) > 1000
    # A kernel from the cache in memory was neither compiled nor loaded from disk.
    missed = [k for k in kernels if not k["cache_hit"] or k["cache_disk"]]
    # Arrays of exactly one element have kernels of their own, and are rare.
    assert len(missed) <= 3


def test_resolutions_share_their_kernels(grid):
    _step(make_lattice(grid, 9), np.random.default_rng(0))
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        _step(make_lattice(grid, 10), np.random.default_rng(1))
        kernels = dr.kernel_history([dr.KernelType.JIT])
    assert kernels and all(k["cache_hit"] and not k["cache_disk"] for k in kernels)
