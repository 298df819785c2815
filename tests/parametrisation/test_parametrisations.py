"""All parametrisations: where they start, where a step leads, and that they can be put down and taken up."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from gshell_mi import CubeLattice, FlexiCubesLattice, TetLattice, UserError, extract
from gshell_mi.extras import network
from gshell_mi.optimizer_arrays import optimizer_arrays, restore_optimizer
from gshell_mi.parametrisation import StepRules, make_parametrisation
from gshell_mi.parametrisation.parametrisation import touched
from gshell_mi.topology import topology

RADIUS = 0.55
PARAMETRISATIONS = ("explicit", "flexicubes", "multiresolution", "hashgrid", "sinusoidal")
NETWORKS = ("hashgrid", "sinusoidal")


@pytest.fixture(autouse=True)
def small_batches(monkeypatch):
    monkeypatch.setattr(network, "_BATCH", 1024)
    monkeypatch.setattr(network, "_EIKONAL_BATCH", 256)
    monkeypatch.setattr(network, "_PADDING", 1024)


def bowl(lattice) -> dict[str, mi.Float]:
    """A sphere that is cut open at z = 0.2."""
    p = lattice.points(mi.Float)
    start = {
        "sdf": dr.norm(p) - RADIUS,
        "msdf": 0.2 - p.z,
        "deform": dr.zeros(mi.Float, 3 * lattice.vertex_count),
    }
    if lattice.weight_count:
        start["weights"] = dr.zeros(mi.Float, lattice.weight_count)
    return start


def fitted(name: str, lattice, start, steps: int, monkeypatch):
    """The parametrisation at the start, to which a network has been fitted."""
    made = make_parametrisation(name, start, lattice, seed=3)
    if made.fitting_steps:
        monkeypatch.setattr(type(made), "fitting_steps", steps)
        losses = [made.fit_step(iteration)["loss"] for iteration in range(steps)]
        assert losses[-1] < 0.05 * losses[0]
        made.begin()
    return made


def move(made, lattice, progress: float, iteration: int) -> float:
    """One step towards a sphere of radius 0.6; returns the volume's error before it."""
    fields = made.fields()
    dr.enable_grad(fields)
    mesh = extract(lattice, fields["sdf"], None, fields["deform"], weights=fields.get("weights"))
    loss = dr.mean(dr.square(dr.norm(mesh.vertices) - 0.6))
    dr.backward(loss)
    made.step({name: dr.grad(field) for name, field in fields.items()}, progress, iteration)
    return loss[0]


def test_an_unknown_name():
    lattice = TetLattice(4)
    words = "field 'wavelet' is not available; choose one of explicit, flexicubes, multires"
    with pytest.raises(UserError, match=words):
        make_parametrisation("wavelet", bowl(lattice), lattice)


@pytest.mark.parametrize(
    "lattice", [TetLattice(10), CubeLattice(9), FlexiCubesLattice(8)], ids=lambda lattice: lattice.grid
)
@pytest.mark.parametrize("name", ["explicit", "multiresolution"])
def test_grids_start_exactly(name, lattice):
    start = bowl(lattice)
    fields = make_parametrisation(name, start, lattice).fields()
    assert set(fields) == set(start)
    for key, field in fields.items():
        np.testing.assert_array_equal(field.numpy(), start[key].numpy())
        assert not dr.grad_enabled(field)


@pytest.mark.parametrize("name", NETWORKS)
def test_networks_learn_the_start(name, monkeypatch):
    lattice = TetLattice(16)
    start = bowl(lattice)
    fields = fitted(name, lattice, start, 300, monkeypatch).fields()
    near = np.abs(start["sdf"].numpy()) < lattice.spacing
    for key in ("sdf", "msdf"):
        error = (fields[key].numpy() - start[key].numpy())[near]
        assert np.sqrt(np.mean(error**2)) < 0.2 * lattice.spacing
    vertices, faces, _ = extract(lattice, **fields).to_numpy()
    counts = topology(vertices, faces)
    assert (counts.components, counts.boundary_loops) == (1, 1)


@pytest.mark.parametrize("name", PARAMETRISATIONS)
def test_steps_follow_the_gradient(name, monkeypatch):
    lattice = FlexiCubesLattice(12) if name == "multiresolution" else TetLattice(12)
    made = fitted(name, lattice, bowl(lattice), 200, monkeypatch)
    errors = [move(made, lattice, 0.0, iteration) for iteration in range(25)]
    assert errors[-1] < 0.5 * errors[0]


def test_a_multiresolution_step_is_the_derivative():
    """Adam's first step has the sign of the gradient, and a coarse value that of the vertices around it."""
    lattice = TetLattice(8)
    made = make_parametrisation("multiresolution", bowl(lattice), lattice, StepRules(rate=1.0))
    gradient = np.zeros(lattice.vertex_count, np.float32)
    gradient[4 + 9 * (4 + 9 * 4)] = 1  # the middle
    count = lattice.vertex_count
    none = {"msdf": dr.zeros(mi.Float, count), "deform": dr.zeros(mi.Float, 3 * count)}
    before = made.fields()["sdf"].numpy()
    made.step({"sdf": mi.Float(gradient)} | none, 0.0)
    moved = (before - made.fields()["sdf"].numpy()).reshape(9, 9, 9) / (lattice.spacing / 4)
    # Levels of 8, 4, 2 and 1 cells: the middle is a vertex of the first three, and of the last the centre of
    # its one cell, whose eight corners all move by a whole step.
    assert moved[4, 4, 4] == pytest.approx(4, rel=1e-4)
    assert moved[4, 4, 5] == pytest.approx(0 + 0.5 + 0.75 + 1, rel=1e-4)
    assert moved[0, 0, 0] == pytest.approx(1, rel=1e-4)


@pytest.mark.parametrize("name", PARAMETRISATIONS)
def test_kept_and_taken_up_again(name, monkeypatch):
    lattice = TetLattice(8)
    start = bowl(lattice)
    whole, stopped = (fitted(name, lattice, start, 100, monkeypatch) for _ in range(2))
    for iteration in range(4):
        move(whole, lattice, 0.2, iteration)
    for iteration in range(2):
        move(stopped, lattice, 0.2, iteration)
    arrays = {}
    for key, optimizer in stopped.optimizers.items():
        arrays |= optimizer_arrays(key, optimizer)
    resumed = make_parametrisation(name, start, lattice, seed=3)
    resumed.begin()
    for key, optimizer in resumed.optimizers.items():
        restore_optimizer(key, optimizer, arrays)
    for iteration in range(2, 4):
        move(resumed, lattice, 0.2, iteration)
    for key, field in whole.fields().items():
        np.testing.assert_allclose(resumed.fields()[key].numpy(), field.numpy(), atol=2e-5)


def test_broken_gradients_are_left_out():
    lattice = TetLattice(6)
    for name in ("explicit", "multiresolution"):
        made = make_parametrisation(name, bowl(lattice), lattice)
        gradients = {key: dr.full(mi.Float, np.nan, dr.width(field)) for key, field in made.fields().items()}
        made.step(gradients, 0.0)
        assert all(np.isfinite(field.numpy()).all() for field in made.fields().values())


def test_offsets_stay_in_their_range():
    lattice = TetLattice(6)
    for name in ("explicit", "multiresolution"):
        made = make_parametrisation(name, bowl(lattice), lattice, StepRules(deform_rate=3.0))
        pull = {
            "sdf": dr.zeros(mi.Float, 343),
            "msdf": dr.zeros(mi.Float, 343),
            "deform": dr.full(mi.Float, -1, 3 * 343),
        }
        made.step(pull, 0.0)
        deform = made.fields()["deform"].numpy()
        assert deform.max() == 1 and deform.min() >= -1


def test_touched_vertices():
    gradients = {"sdf": mi.Float([0, 1, 0, 0]), "deform": mi.Float([0] * 9 + [0, -2, 0])}
    assert touched(gradients, 4).numpy().tolist() == [1, 3]


def test_one_vertex_does_not_hold_up_the_others():
    """A derivative ten thousand times as large as all others, once, is felt as one of thirty times."""
    lattice = TetLattice(16)
    moved = {}
    for outlier in (1.0, 30.0, 1e4, dr.inf):
        made = make_parametrisation("explicit", {"sdf": dr.zeros(mi.Float, lattice.vertex_count)}, lattice)
        for iteration in range(10):
            gradient = np.ones(lattice.vertex_count, np.float32)
            gradient[7] = outlier if iteration == 0 else 1
            made.step({"sdf": mi.Float(gradient)}, 0.5, iteration)
        moved[outlier] = -np.median(made.fields()["sdf"].numpy())
    assert moved[1.0] > 0
    assert moved[dr.inf] > 0.99 * moved[1.0]
    assert moved[1e4] > 0.95 * moved[30.0] > 0.05 * moved[1.0]


def test_a_rim_moves_where_it_hardly_shows_and_a_surface_goes_by_what_shows_most():
    lattice, names = TetLattice(8), ("sdf", "msdf")
    made = make_parametrisation("explicit", bowl(lattice), lattice, StepRules(smoothing=0.0))
    before = {name: field.numpy() for name, field in made.fields().items()}
    gradient = np.zeros(lattice.vertex_count, np.float32)
    gradient[100:200], gradient[300] = 1.0, 0.01
    made.step({name: mi.Float(gradient) for name in names}, progress=0.0)
    moved = {name: np.abs(made.fields()[name].numpy() - before[name]) / lattice.spacing for name in names}
    np.testing.assert_allclose(moved["sdf"][[100, 300, 400]], [0.08, 0.0008, 0], rtol=0.01, atol=1e-6)
    np.testing.assert_allclose(moved["msdf"][[100, 300, 400]], [0.24, 0.024, 0], rtol=0.01, atol=1e-6)


def test_steps_fall_tenfold_and_those_of_a_rim_a_hundredfold():
    lattice, names = TetLattice(8), ("sdf", "msdf")
    pull = np.zeros(lattice.vertex_count, np.float32)
    pull[300] = 1
    first = {}
    for progress, fallen in ((0.0, {"sdf": 1, "msdf": 1}), (1.0, {"sdf": 0.1, "msdf": 0.01})):
        made = make_parametrisation(
            "explicit", bowl(lattice), lattice, StepRules(0.1, 0.2, 0.02, smoothing=0.0, detail=0.0)
        )
        before = made.fields()
        made.step({name: mi.Float(pull) for name in names}, progress)
        moved = {name: abs(made.fields()[name][300] - before[name][300]) for name in names}
        first = first or moved
        for name in names:
            assert moved[name] == pytest.approx(fallen[name] * first[name], rel=0.01)
