"""Many scenes at once: each is what it is alone, in a store that goes on where it was stopped."""

import inspect
import sys
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import layered, layered_file

import wholearm_jax as wa
from wholearm_jax.cli import app as command
from wholearm_jax.cli import check as batch_command
from wholearm_jax.core.errors import SceneError, StoreError
from wholearm_jax.core.status import Status
from wholearm_jax.ensembles import summary as survey_module
from wholearm_jax.ensembles.batch import check_in_chunks
from wholearm_jax.ensembles.ensemble import make_ensemble
from wholearm_jax.ensembles.passes import check_block, trace_block
from wholearm_jax.ensembles.scene_batch import stack_scenes
from wholearm_jax.ensembles.scene_check import COARSE_PASS, BatchResult, NextPass, check_scene, from_result
from wholearm_jax.ensembles.summary import rank_correlations, summarise
from wholearm_jax.files.check_store import fingerprint, open_store, store_metadata
from wholearm_jax.files.polygons_npz import count_polygons, read_polygons
from wholearm_jax.files.scene_toml import to_dict
from wholearm_jax.model.outline import find_defect
from wholearm_jax.model.schedule import TorqueSchedule, pad_schedule
from wholearm_jax.phases.plan_schedule import has_torque_jumps
from wholearm_jax.phases.plan_tracing import trace_paths_in_one_program

pytest.importorskip("zarr")
ARRIVAL, SEED, COUNT = 0.02, 3, 6


@pytest.fixture(scope="module")
def scene():
    return layered("heptagon")


@pytest.fixture(scope="module")
def schedule(scene):
    return wa.quasistatic(scene)


@pytest.fixture(scope="module")
def ensemble(scene):
    return make_ensemble(scene, {"vertices": 0.0002, "friction": "10%"}, seed=SEED)


@pytest.fixture(scope="module")
def drawn(ensemble):
    return [ensemble.draw(number) for number in range(COUNT)]


@pytest.fixture(scope="module")
def checked(drawn, schedule):
    return wa.check(drawn, schedule, arrival=ARRIVAL, tolerance=1e-10)


def assert_as_alone(checked, scene, schedule, number):
    """A scene's result is what `simulate` says of it."""
    alone = from_result(wa.simulate(scene, schedule, arrival=ARRIVAL))
    for name, value in alone._asdict().items():
        # The place of a least force, unlike the force, is known to the square root of rounding.
        near = 1e-6 if name == "time" else 1e-9
        np.testing.assert_allclose(getattr(checked, name)[number], value, atol=near, rtol=near, err_msg=name)


def test_each_scene_is_what_simulate_says_of_it_alone(drawn, schedule, checked):
    for number in range(3):
        assert_as_alone(checked, drawn[number], schedule, number)


def test_margins_are_right_to_what_is_said_by_default(ensemble, schedule, checked):
    """A coarser level computes them: 1e-6 N, and all else to as many digits; not the same numbers."""
    assert not ensemble.has_common_paths
    quick = wa.check(ensemble, schedule, count=COUNT, arrival=ARRIVAL)
    np.testing.assert_array_equal(quick.status, checked.status)
    np.testing.assert_array_equal(quick.contact, checked.contact)
    np.testing.assert_allclose(quick.margin, checked.margin, rtol=0, atol=1e-6)
    np.testing.assert_allclose(quick.end, checked.end, rtol=0, atol=1e-6)
    assert np.any(quick.margin != checked.margin), "it is no test of another level"


def test_scenes_with_the_same_paths_are_what_they_are_alone(scene, schedule):
    loose = make_ensemble(scene, {"friction": "10%", "mass": "5%"}, seed=SEED)
    assert loose.has_common_paths
    checked = wa.check(loose, schedule, count=2, arrival=ARRIVAL, tolerance=1e-10)
    assert checked.margin[0] != checked.margin[1]
    for number in range(2):
        assert_as_alone(checked, loose.draw(number), schedule, number)


def test_a_scene_that_cannot_be_followed_disturbs_no_other(drawn, schedule, checked):
    apart = eqx.tree_at(lambda s: s.start, drawn[1], drawn[1].start.at[1].set(jnp.nan))
    mixed = wa.check([drawn[0], apart, *drawn[2:]], schedule, arrival=ARRIVAL, tolerance=1e-10)
    assert mixed.status[1] == wa.Status.NO_CONVERGENCE
    assert not np.any(np.isnan(mixed.margin))
    for row in (0, 2):
        assert mixed.margin[row] == pytest.approx(checked.margin[row], rel=1e-9)
        assert mixed.status[row] == checked.status[row]


@eqx.filter_jit
def graded(scene, torque, max_error):
    """One scene's check in the coarse pass, torques that step: a program for all schedules."""
    options = replace(COARSE_PASS.options, has_jumps=True)
    return check_scene(scene, torque, ARRIVAL, COARSE_PASS._replace(options=options, max_error=max_error))


def test_what_follows_a_failure_must_be_known_as_well(scene, schedule):
    """Its margin counts: a table that is too coarse there is refined, though the status is that of the phase before."""
    bent = jnp.where((schedule.times < 0.5)[:, None], -schedule.values, schedule.values)
    torque = pad_schedule(TorqueSchedule(schedule.times, bent))
    errors = [float(one.dynamics.error) for one in wa.trace(scene, resolution=COARSE_PASS.resolution, tolerance=1.0)]
    assert errors[0] < errors[1]

    for limit, enough in ((np.sqrt(errors[0] * errors[1]), False), (2 * errors[1], True)):
        answer, grade = graded(scene, torque, jnp.asarray(limit))
        assert int(answer.status) != Status.OK
        assert int(answer.phase) == 0
        assert (int(grade) == NextPass.DONE) is enough


def test_a_draw_depends_on_its_number_alone(scene, ensemble):
    more = make_ensemble(scene, {"mass": "5%", "vertices": 0.0002, "friction": "10%"}, seed=SEED)
    one, other = ensemble.draw(7).object, more.draw(7).object
    assert np.array_equal(one.vertices, other.vertices)
    assert np.array_equal(one.friction, other.friction)
    assert one.mass != other.mass
    assert not np.array_equal(one.vertices, ensemble.draw(8).object.vertices)
    assert np.array_equal(one.vertices[7], one.vertices[6])  # padding
    assert np.all(np.abs(one.vertices - scene.object.vertices) <= 0.0002)


def test_polygons_of_different_size_stack(scene):
    nine = eqx.tree_at(lambda s: s.object.vertices, scene, jnp.concatenate([scene.object.vertices] * 2))
    both = stack_scenes([scene, nine])
    assert both.object.vertices.shape == (2, 16, 2)
    with pytest.raises(ValueError, match="same phases"):
        stack_scenes([scene, layered("flight")])


def test_amounts_that_are_not_are_refused(scene):
    for bad in ({"colour": 1}, {"friction": "ten"}, {"friction": "-1%"}, {"inertia": "5%"}):
        with pytest.raises(ValueError, match=next(iter(bad))):
            make_ensemble(scene, bad)


def test_shares_and_amounts(scene):
    """A share is of each value, an amount in its unit; the object's inertia goes with its mass."""
    scene = eqx.tree_at(lambda s: s.object.inertia, scene, jnp.asarray(1e-4), is_leaf=lambda leaf: leaf is None)
    friction = jnp.array([0.1, 0.2, 0.4])
    scene = eqx.tree_at(lambda s: s.object.friction, scene, friction)
    drawn = make_ensemble(scene, {"mass": "20%", "friction": "50%", "viscous": 0.005, "gravity": 0.2}, seed=SEED)
    many = jax.vmap(drawn.draw)(jnp.arange(2000))

    def spread(values, middle):
        """How far draws go to either side, at the most."""
        off = np.asarray(values) - np.asarray(middle)
        return np.stack([-off.min(0), off.max(0)])

    np.testing.assert_allclose(spread(many.object.mass, scene.object.mass), 0.2 * float(scene.object.mass), rtol=0.01)
    np.testing.assert_allclose(many.object.inertia / many.object.mass, 1e-4 / float(scene.object.mass), rtol=1e-12)
    np.testing.assert_allclose(spread(many.object.friction, friction), np.stack([0.5 * friction] * 2), rtol=0.01)
    np.testing.assert_allclose(spread(many.hand.viscous, scene.hand.viscous), 0.005, rtol=0.01)
    np.testing.assert_allclose(spread(many.gravity, scene.gravity), 0.2, rtol=0.01)
    columns = np.column_stack([many.object.mass, many.object.friction, many.hand.viscous, many.gravity])
    apart = np.corrcoef(columns.T) - np.eye(columns.shape[1])
    assert np.abs(apart).max() < 0.1, "all are drawn apart"


TOO_MUCH = {
    "mass": ("100%", "could become negative or 0"),
    "friction": ("101%", "could become negative"),
    "length": (0.18, "could become negative or 0"),
    "finger_inertia": (0.003, "could become negative or 0"),
    "viscous": (0.03, "could become negative"),
    "dry": ("200%", "could become negative"),
    "joint": (0.08, "change sides"),
    "vertices": (0.02, "edges of the polygon could cross"),
}


@pytest.mark.parametrize(("name", "amount", "cause"), [(name, *rest) for name, rest in TOO_MUCH.items()])
def test_amounts_by_which_a_draw_may_be_no_scene(scene, name, amount, cause):
    with pytest.raises(ValueError, match=f"^{name}={amount}: too much, .*{cause}"):
        make_ensemble(scene, {name: amount})


@pytest.mark.parametrize("amount", [0.004, 0.02, "15%", "60%"])
def test_polygons_that_are_drawn_are_polygons(scene, amount):
    """What is allowed stays simple at all corners of its range; what is refused, here, does not."""
    count, rng = int(scene.object.count), np.random.default_rng(0)
    value = np.asarray(scene.object.vertices)[:count]
    size = float(str(amount).removesuffix("%")) / (100 if "%" in str(amount) else 1)
    width = size * (np.abs(value) if "%" in str(amount) else 1.0)
    drawn = value + width * rng.choice([-1.0, 1.0], (20_000, count, 2))
    try:
        make_ensemble(scene, {"vertices": amount})
    except ValueError:
        assert find_defect(drawn) is not None
    else:
        assert find_defect(drawn) is None


def test_the_survey_counts_and_ranks(scene, checked):
    told = summarise(scene, [checked], COUNT)
    assert told.holds + sum(told.failures.values()) == COUNT
    assert told.holds == int((checked.status == 0).sum())
    x = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    x[:, 2] = 0
    found = rank_correlations(3 * x[:, 1] + 0.1 * x[:, 0], x)
    assert found[1] > 0.95
    assert abs(found[0]) < 0.3
    assert found[2] == 0


def test_the_survey_says_what_fails_where(scene, monkeypatch):
    """Seven scenes in two chunks, by hand."""
    ok, lost, stuck = (int(s) for s in (wa.Status.OK, wa.Status.CONTACT_LOST, wa.Status.STUCK))
    rows = [  # status, margin, contact, phase
        (ok, 0.4, 0, 1),
        (lost, -0.1, 2, 1),
        (stuck, -np.inf, -1, 0),
        (lost, -0.3, 2, 1),
        (ok, 0.2, 1, 0),
        (lost, 0.1, 3, 0),
        (lost, -0.2, 2, 1),
    ]
    status, margin, contact, phase = (np.array(column) for column in zip(*rows, strict=True))
    whole = BatchResult(status, margin, np.zeros(7), contact, phase, np.zeros((7, 5)))
    parts = [BatchResult(*(column[part] for column in whole)) for part in (slice(0, 4), slice(4, 7))]
    told = summarise(scene, parts, 7)
    third, fourth = scene.phases[1].formation.names[2], scene.phases[0].formation.names[3]
    assert told.holds == 2
    assert told.failures == {
        ("flip right", "contact_lost", third): 3,
        ("slide left", "contact_lost", fourth): 1,
        ("slide left", "stuck", None): 1,
    }
    assert told.lines[0].startswith("2 of 7 hold: 28.57 %")
    assert told.lines[2] == f"flip right: contact_lost at {third}: 3"
    assert told.lines[-1] in ("slide left: stuck: 1", f"slide left: contact_lost at {fourth}: 1")
    assert told.quantiles["0.5"] == -0.1
    assert list(told.quantiles.values()) == sorted(told.quantiles.values())
    assert told.as_dict()["failures"][0] == {
        "phase": "flip right",
        "status": "contact_lost",
        "contact": third,
        "count": 3,
    }
    np.testing.assert_array_equal(told.numbers, np.arange(7))
    np.testing.assert_array_equal(told.margins, margin)
    monkeypatch.setattr(survey_module, "SAMPLE_SIZE", 3)
    few = summarise(scene, parts, 7)
    np.testing.assert_array_equal(few.numbers, [0, 3, 6])
    np.testing.assert_array_equal(few.margins, margin[[0, 3, 6]])
    assert few.failures == told.failures


def test_what_a_store_is_of(tmp_path, scene, schedule):
    wanted = store_metadata(10, 4, seed=1)
    open_store(tmp_path / "a.zarr", wanted)
    with pytest.raises(StoreError, match="another version"):
        open_store(tmp_path / "a.zarr", wanted | {"version": "0.0"})
    (tmp_path / "file").write_text("mine")
    with pytest.raises(StoreError):
        open_store(tmp_path / "file", wanted)
    assert (tmp_path / "file").read_text() == "mine"
    heavier = eqx.tree_at(lambda s: s.object.mass, scene, scene.object.mass * (1 + 1e-15))
    data = to_dict(scene)
    renamed = wa.parse(data | {"phase": [data["phase"][0] | {"name": "another"}, data["phase"][1]]})
    prints = {fingerprint(*trees) for trees in ([scene], [heavier], [renamed], [scene, schedule])}
    assert len(prints) == 4
    assert fingerprint(scene) == fingerprint(layered("heptagon"))


def test_a_store_left_half_made_is_made_again_and_a_half_written_chunk_is_not_done(tmp_path):
    import zarr

    wanted, path = store_metadata(4, 2, seed=1), tmp_path / "half.zarr"
    zarr.create_group(str(path)).create_array("margin", shape=(4,), dtype="float64")  # killed before it said what it is
    store = open_store(path, wanted)
    assert store.chunks == 2
    ones = BatchResult(*(np.ones((2, *shape)) for shape in ((), (), (), (), (), (5,))))._asdict()
    with pytest.raises(ValueError, match="could not convert"):
        store.write(0, ones | {"end": np.full((2, 5), "not a number")})
    assert store.done().tolist() == [False, False]


def test_a_store_of_something_else_is_refused(tmp_path):
    wanted = store_metadata(10, 4, seed=1)
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
    wanted = store_metadata(COUNT, 2, seed=SEED)
    whole, broken = (open_store(tmp_path / name, wanted) for name in ("whole", "broken"))
    found = dict(check_in_chunks(ensemble, schedule, COUNT, chunk=2, arrival=ARRIVAL))
    for number, part in found.items():
        whole.write(number, part._asdict())
    broken.write(1, found[1]._asdict())
    broken.array("margin")[0:2] = [7.0, 7.0]  # stopped before `done`
    again = open_store(tmp_path / "broken", wanted)
    missing = [k for k in range(again.chunks) if not again.done()[k]]
    assert missing == [0, 2]
    for number, part in check_in_chunks(
        ensemble, schedule, COUNT, chunk=2, arrival=ARRIVAL, chunk_numbers=missing[::-1]
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
        (["--count", "4", "--vary", "mass=1%", "--out", "mine.json"], "mine.json"),
        (["--count", "4", "--vary", "mass=1%", "--processes", "2"], "--coordinator"),
    ],
)
def test_bad_input_of_the_command(tmp_path, monkeypatch, capsys, arguments, said):
    monkeypatch.setenv("JAX_ENABLE_COMPILATION_CACHE", "true")
    monkeypatch.setenv("XLA_FLAGS", "")
    torque = tmp_path / "zero.csv"
    torque.write_text("t,tau1,tau2\n0,0,0\n2,0,0\n")
    line = [
        "wholearm",
        "check",
        str(layered_file("heptagon")),
        "--torque",
        str(torque),
        "--out",
        str(tmp_path / "r.zarr"),
        *arguments,
    ]
    monkeypatch.setattr(sys, "argv", line)
    with pytest.raises(SystemExit) as caught:
        command.main()
    err = capsys.readouterr().err
    assert caught.value.code == 2
    assert err.count("\n") == 1
    assert said in err


def test_scenes_that_vary_arrive_as_the_command_line_says():
    """In Python as by `wholearm check`: near the end, as no varied plan ends where torques were not made for it."""
    assert inspect.signature(wa.check).parameters["arrival"].default == batch_command.ARRIVAL_FRACTION


SEVEN = np.array([[2.0, 0], [1, 1.6], [-0.4, 1.9], [-1.8, 0.9], [-1.8, -0.9], [-0.4, -1.9], [1.2, -1.6]])


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "not a NumPy .npz file"),
        (b"PK\x03\x04 cut short", "not a NumPy .npz file"),
        ({"vertices": np.full((1, 3, 2), "a")}, "vertices: needs real numbers"),
        ({"vertices": np.ones((1, 3, 2), complex)}, "vertices: needs real numbers"),
        ({"vertices": np.stack([SEVEN, np.where(SEVEN > 1, np.nan, SEVEN)])}, r"vertices\[1\]: not finite"),
        ({"vertices": np.stack([SEVEN, SEVEN, SEVEN[::-1]])}, r"vertices\[2\]: clockwise"),
        ({"vertices": np.stack([SEVEN, SEVEN[[0, 1, 2, 3, 5, 4, 6]]])}, r"vertices\[1\]: edges 3 and 5 cross"),
        ({"vertices": np.stack([SEVEN, SEVEN[[0, 1, 1, 2, 3, 4, 5]]])}, r"vertices\[1\]: .* vertices 1 and 2 coincide"),
        (
            {"vertices": np.stack([SEVEN, SEVEN[::-1]])[[0, 1, 0]], "count": np.array([6, 5, 7])},
            r"vertices\[1\]: clockwise",
        ),
    ],
)
def test_files_of_polygons_that_are_none(tmp_path, scene, content, said):
    path = tmp_path / "objects.npz"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        np.savez(path, **content)
    with pytest.raises(SceneError, match=said):
        read_polygons(path, scene)


@pytest.mark.parametrize("given", [None, [0.1, 0.2, 0.3], [[0.1, 0.2, 0.3]] * 3])
def test_friction_of_polygons_is_by_polygon_and_link(tmp_path, scene, given):
    """The scene's own is by link, also where there are as many polygons as links."""
    by_link = eqx.tree_at(lambda s: s.object.friction, scene, jnp.array([0.1, 0.2, 0.3]))
    np.savez(tmp_path / "objects.npz", vertices=np.stack([SEVEN] * 3), **({} if given is None else {"friction": given}))
    friction = read_polygons(tmp_path / "objects.npz", by_link).scenes.object.friction
    row = np.array([0.1, 0.2, 0.3])
    np.testing.assert_array_equal(friction, np.repeat(row[:, None], 3, 1) if np.ndim(given) == 1 else [row] * 3)


def test_count_polygons(tmp_path):
    np.savez(tmp_path / "objects.npz", vertices=np.stack([SEVEN] * 3))
    assert count_polygons(tmp_path / "objects.npz") == 3
    (tmp_path / "other.npz").write_text("none")
    assert count_polygons(tmp_path / "other.npz") == count_polygons(tmp_path / "absent.npz") == 0


def test_one_scene_is_not_many(scene, schedule):
    with pytest.raises(ValueError, match="one scene"):
        wa.check(scene, schedule)


def test_mass_and_inertia_vary_in_any_order(scene):
    heavy = eqx.tree_at(lambda s: s.object.inertia, scene, jnp.asarray(2e-4), is_leaf=lambda leaf: leaf is None)
    amounts = {"mass": "20%", "inertia": "10%"}
    one, other = (
        make_ensemble(heavy, dict(order), seed=SEED).draw(4).object
        for order in (amounts.items(), [*amounts.items()][::-1])
    )
    assert float(one.inertia) == float(other.inertia)
    alone = make_ensemble(heavy, {"inertia": "10%"}, seed=SEED).draw(4).object
    assert float(one.inertia) == pytest.approx(float(alone.inertia * one.mass / scene.object.mass), rel=1e-12)


def waiting(push, first, then):
    """The quasi-static schedule after a fifth of a second in which torques go from one to another."""
    half = len(push.values) // 2
    values = [first, then, push.values[0], push.values[half - 1], push.values[half], push.values[-1]]
    return wa.torque_schedule([0.0, 0.2, 0.2, 1.0, 1.0, 2.0], values)


@pytest.mark.parametrize(
    "ways", [("squeeze", "squeeze"), ("open", "open"), ("squeeze", "open"), ("open", "squeeze"), ("hardly", "hardly")]
)
def test_an_object_waits_only_where_some_forces_hold_it(scene, schedule, ways):
    """Fingers that open gently do not move the object as far as accelerations tell, but nothing holds it either.

    With `hardly` any torque, contacts would pull if the object set out backward: less friction than that holds it.
    """
    torques = {"squeeze": 0.2 * schedule.values[0], "open": np.array([-0.05, 0.06]), "hardly": np.array([0.005, -0.01])}
    torque, held = waiting(schedule, *(torques[way] for way in ways)), "open" not in ways
    alone = wa.simulate(scene, torque, arrival=ARRIVAL)
    assert alone.phases[0].holds[0].start == 0.0, "it waits"
    assert (alone.phases[0].holds[0].loss_time is None) is held
    _, grade = graded(scene, pad_schedule(torque), jnp.asarray(COARSE_PASS.max_error))
    assert int(grade) == (NextPass.DONE if held else NextPass.SINGLE)
    assert_as_alone(wa.check([scene], torque, arrival=ARRIVAL, tolerance=1e-10), scene, torque, 0)


def test_scenes_that_share_their_geometry_share_their_paths(scene):
    """All phases are traced once, whatever friction and mass: `vmap` would not give out one of them for all else."""

    def paths(friction, mass):
        where = (lambda s: s.object.friction), (lambda s: s.object.mass)
        changed = scene
        for at, value in zip(where, (friction, mass), strict=True):
            changed = eqx.tree_at(at, changed, value)
        return trace_paths_in_one_program(changed, COARSE_PASS.resolution)

    frictions, masses = jnp.full((2, 3), 0.1) * jnp.array([[1.0], [1.5]]), jnp.array([0.2, 0.3])
    shared = jax.eval_shape(jax.vmap(paths, out_axes=None), frictions, masses)
    assert shared.breakpoints.shape == (len(scene.phases), COARSE_PASS.resolution.segments + 1)


@pytest.mark.slow
def test_scenes_side_by_side_as_on_a_gpu_are_what_they_are_one_after_the_other(ensemble, schedule):
    numbers, level = (
        jnp.arange(3),
        COARSE_PASS._replace(
            options=replace(COARSE_PASS.options, has_jumps=has_torque_jumps(ensemble.scene, schedule))
        ),
    )
    paths = trace_block((ensemble, level.resolution, True), numbers)
    found, grade = check_block((ensemble, pad_schedule(schedule), ARRIVAL, level, True), numbers, paths)
    assert grade.tolist() == [NextPass.DONE] * len(numbers)
    one_by_one = wa.check(ensemble, schedule, count=len(numbers), arrival=ARRIVAL)
    for each, other in zip(found, one_by_one, strict=True):
        np.testing.assert_allclose(each, other, rtol=1e-9, atol=1e-9)
