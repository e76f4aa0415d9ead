"""Many scenes at once: each is what it is alone, in a store that goes on where it was stopped."""

import inspect
import sys

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import wholearm_jax as wa
from wholearm_jax import batch_command, command
from wholearm_jax.batch import check_chunks, from_result
from wholearm_jax.store import StoreError, identity, open_store
from wholearm_jax.survey import influences, survey
from wholearm_jax.variation import stack, vary

pytest.importorskip("zarr")
ARRIVAL, SEED, COUNT = 0.02, 3, 6


@pytest.fixture(scope="module")
def scene():
    return wa.load("heptagon")


@pytest.fixture(scope="module")
def schedule(scene):
    return wa.quasistatic(scene)


@pytest.fixture(scope="module")
def ensemble(scene):
    return vary(scene, {"vertices": 0.0002, "friction": "10%"}, seed=SEED)


@pytest.fixture(scope="module")
def checked(ensemble, schedule):
    return wa.check(ensemble, schedule, count=COUNT, arrival=ARRIVAL, tolerance=1e-10)


def assert_as_alone(checked, ensemble, schedule, number):
    """A scene's result is what `simulate` says of it."""
    alone = from_result(wa.simulate(ensemble.draw(number), schedule, arrival=ARRIVAL))
    for name, value in alone._asdict().items():
        # The place of a least force, unlike the force, is known to the square root of rounding.
        near = 1e-6 if name == "time" else 1e-9
        np.testing.assert_allclose(getattr(checked, name)[number], value, atol=near, rtol=near, err_msg=name)


def test_each_scene_is_what_simulate_says_of_it_alone(ensemble, schedule, checked):
    assert not ensemble.same_wires
    for number in range(3):
        assert_as_alone(checked, ensemble, schedule, number)


def test_scenes_with_the_same_wires_side_by_side_are_what_they_are_alone(scene, schedule):
    loose = vary(scene, {"friction": "10%", "mass": "5%"}, seed=SEED)
    assert loose.same_wires
    checked = wa.check(loose, schedule, count=2, arrival=ARRIVAL, tolerance=1e-10)
    assert checked.margin[0] != checked.margin[1]
    for number in range(2):
        assert_as_alone(checked, loose, schedule, number)


def test_a_scene_that_cannot_be_followed_disturbs_no_other(ensemble, schedule, checked):
    scenes = [ensemble.draw(number) for number in range(3)]
    apart = eqx.tree_at(lambda s: s.start, scenes[1], scenes[1].start.at[1].set(jnp.nan))
    mixed = wa.check([scenes[0], apart, scenes[2]], schedule, arrival=ARRIVAL, tolerance=1e-10)
    assert mixed.status[1] == wa.Status.NO_CONVERGENCE
    assert not np.any(np.isnan(mixed.margin))
    for row in (0, 2):
        assert mixed.margin[row] == pytest.approx(checked.margin[row], rel=1e-9)
        assert mixed.status[row] == checked.status[row]


def test_a_draw_depends_on_its_number_alone(scene, ensemble):
    more = vary(scene, {"mass": "5%", "vertices": 0.0002, "friction": "10%"}, seed=SEED)
    one, other = ensemble.draw(7).object, more.draw(7).object
    assert np.array_equal(one.vertices, other.vertices)
    assert np.array_equal(one.friction, other.friction)
    assert one.mass != other.mass
    assert not np.array_equal(one.vertices, ensemble.draw(8).object.vertices)
    assert np.array_equal(one.vertices[7], one.vertices[6])  # padding
    assert np.all(np.abs(one.vertices - scene.object.vertices) <= 0.0002)


def test_polygons_of_different_size_stack(scene):
    nine = eqx.tree_at(lambda s: s.object.vertices, scene, jnp.concatenate([scene.object.vertices] * 2))
    both = stack([scene, nine])
    assert both.object.vertices.shape == (2, 16, 2)
    with pytest.raises(ValueError, match="same phases"):
        stack([scene, wa.load("flight")])


def test_amounts_that_are_not_are_refused(scene):
    for bad in ({"colour": 1}, {"friction": "ten"}, {"friction": "-1%"}, {"inertia": "5%"}):
        with pytest.raises(ValueError, match=next(iter(bad))):
            vary(scene, bad)


def test_the_survey_counts_and_ranks(scene, checked):
    told = survey(scene, [checked], COUNT)
    assert told.holds + sum(told.failures.values()) == COUNT
    assert told.holds == int((checked.status == 0).sum())
    x = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    x[:, 2] = 0
    found = influences(3 * x[:, 1] + 0.1 * x[:, 0], x)
    assert found[1] > 0.95
    assert abs(found[0]) < 0.3
    assert found[2] == 0


def test_a_store_of_something_else_is_refused(tmp_path):
    wanted = identity(10, 4, seed=1)
    open_store(tmp_path / "a.zarr", wanted)
    assert open_store(tmp_path / "a.zarr", wanted).chunks == 3
    with pytest.raises(StoreError, match="another seed"):
        open_store(tmp_path / "a.zarr", wanted | {"seed": 2})
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("mine")
    with pytest.raises(StoreError, match="not a store"):
        open_store(tmp_path / "mine", wanted)
    assert (tmp_path / "mine" / "thesis.txt").read_text() == "mine"


def test_a_store_goes_on_and_ends_the_same(tmp_path, ensemble, schedule):
    """Chunk by chunk, in another order, over a chunk left half written: bit for bit the same."""
    wanted = identity(COUNT, 2, seed=SEED)
    whole, broken = (open_store(tmp_path / name, wanted) for name in ("whole", "broken"))
    found = dict(check_chunks(ensemble, schedule, COUNT, chunk=2, arrival=ARRIVAL, tolerance=1e-10))
    for number, part in found.items():
        whole.write(number, part._asdict())
    broken.write(1, found[1]._asdict())
    broken.array("margin")[0:2] = [7.0, 7.0]  # stopped before `done`
    again = open_store(tmp_path / "broken", wanted)
    missing = [k for k in range(again.chunks) if not again.done()[k]]
    assert missing == [0, 2]
    for number, part in check_chunks(
        ensemble, schedule, COUNT, chunk=2, arrival=ARRIVAL, tolerance=1e-10, wanted=missing[::-1]
    ):
        again.write(number, part._asdict())
    for number in range(3):
        for one, other in zip(whole.read(number), again.read(number), strict=True):
            assert one.tobytes() == other.tobytes()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "--count"),
        (["--count", "4", "--vary", "colour=1"], "colour"),
        (["--polygons", "absent.npz"], "absent.npz"),
        (["--count", "4", "--vary", "mass=1%", "--processes", "2"], "--coordinator"),
    ],
)
def test_bad_input_of_the_command(tmp_path, monkeypatch, capsys, arguments, said):
    monkeypatch.setenv("JAX_ENABLE_COMPILATION_CACHE", "true")
    monkeypatch.setenv("XLA_FLAGS", "")
    torque = tmp_path / "zero.csv"
    torque.write_text("t,tau1,tau2\n0,0,0\n2,0,0\n")
    line = ["wholearm", "check", "heptagon", "--torque", str(torque), "--out", str(tmp_path / "r.zarr"), *arguments]
    monkeypatch.setattr(sys, "argv", line)
    with pytest.raises(SystemExit) as caught:
        command.main()
    err = capsys.readouterr().err
    assert caught.value.code == 2
    assert err.count("\n") == 1
    assert said in err


def test_scenes_that_vary_arrive_as_the_command_line_says():
    """In Python as by `wholearm check`: near the end, as no varied plan ends where torques were not made for it."""
    assert inspect.signature(wa.check).parameters["arrival"].default == batch_command.ARRIVAL
