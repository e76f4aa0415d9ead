"""What a margin is of, and when: many rows, rounded times, dips between samples, paths and plans that have none."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from support import layered

import wholearm_jax as wa
from wholearm_jax.files.scene_toml import to_dict
from wholearm_jax.model.scene import replace_duration
from wholearm_jax.phases.compressive_margin import plan_margin
from wholearm_jax.phases.phase_simulation import simulate_with_enough_steps
from wholearm_jax.phases.plan_schedule import has_torque_jumps, with_plan_step_capacity
from wholearm_jax.phases.plan_simulation import simulate_phases
from wholearm_jax.simulation import IntegratorOptions, with_step_capacity


@pytest.fixture(scope="module")
def heptagon():
    scene = layered("heptagon")
    return scene, wa.quasistatic(scene)


def finer(torque, rows):
    """The same schedule of two phases with so many rows a phase."""
    times, values = np.asarray(torque.times), np.asarray(torque.values)
    half = len(times) // 2
    fine = [np.linspace(times[k], times[k + half - 1], rows) for k in (0, half)]
    interpolated = [
        np.stack([np.interp(t, times[k : k + half], values[k : k + half, joint]) for joint in range(2)], axis=1)
        for k, t in zip((0, half), fine, strict=True)
    ]
    return wa.torque_schedule(np.concatenate(fine), np.vstack(interpolated))


def test_a_margin_is_of_the_whole_motion_however_many_rows_a_schedule_has(heptagon):
    """Steps end on rows: 501 a phase need more steps than a phase of 51."""
    scene, torque = heptagon
    many = finer(torque, 501)
    wanted = float(wa.margin(scene, torque))
    assert float(wa.margin(scene, many)) == pytest.approx(wanted, rel=1e-9)


def test_a_part_of_a_motion_has_no_margin(heptagon):
    scene, torque = heptagon
    short = simulate_phases(scene, torque, wa.trace(scene), IntegratorOptions(max_steps=16))
    assert wa.Status(int(short[0].assessment.status)) is wa.Status.MAX_STEPS
    assert float(plan_margin(scene, short)) == -np.inf


def test_a_motion_gets_the_steps_that_it_needs(heptagon):
    scene, torque = heptagon
    asked = []

    def simulated(options):
        asked.append((options.max_steps, options.max_stages))
        return simulate_phases(scene, torque, wa.trace(scene), options)

    enough = simulate_with_enough_steps(simulated, IntegratorOptions(max_steps=16, max_stages=2))
    assert asked == [(16, 2), (64, 8), (256, 32)]
    assert float(plan_margin(scene, enough)) == pytest.approx(float(wa.margin(scene, torque)), rel=1e-9)


@pytest.mark.parametrize("rows", [51, 271, 2001])
def test_there_is_room_for_a_step_at_every_row(heptagon, rows):
    """In what `optimise` simulates as in what `margin` does; up to 128 rows a phase share one program."""
    scene, torque = heptagon
    assert with_step_capacity(IntegratorOptions(), rows).max_steps >= 2 * rows
    assert with_plan_step_capacity(IntegratorOptions(), scene, finer(torque, rows)).max_steps >= 2 * rows
    assert (
        with_plan_step_capacity(IntegratorOptions(), scene, finer(torque, rows)).max_steps
        == IntegratorOptions().max_steps
    ) == (rows <= 128)


@pytest.mark.parametrize("digits", [9, 12])
def test_a_step_of_torque_between_phases_may_stand_beside_their_seam_by_rounding(heptagon, digits):
    """1.1 + 2.2 is not 3.3: who writes times with a few digits means the same plan."""
    scene, _ = heptagon
    phases = tuple(replace_duration(p, t) for p, t in zip(scene.phases, (0.1 + 0.2, 0.6 + 0.7), strict=True))
    plan = eqx.tree_at(lambda s: s.phases, scene, phases)
    found = wa.optimise(plan)
    rounded = wa.torque_schedule(np.round(np.asarray(found.torque.times), digits), found.torque.values)
    assert not np.array_equal(rounded.times, found.torque.times)
    again = wa.simulate(plan, rounded)
    assert again.status is wa.Status.OK, again.message
    assert again.margin == pytest.approx(found.result.margin, rel=1e-6)


def test_a_seam_between_phases_is_no_step_within_one(heptagon):
    """The end of a phase less its duration is its beginning but for rounding."""
    scene, _ = heptagon
    first, second = 0.2516761376302456, 10.0
    assert (first + second) - second < first, "what is shown here needs such a pair"
    phases = tuple(replace_duration(p, t) for p, t in zip(scene.phases, (first, second), strict=True))
    scene = eqx.tree_at(lambda s: s.phases, scene, phases)

    def stepping_at(time):
        return wa.torque_schedule([0.0, time, time, first + second], np.zeros((4, 2)))

    assert not has_torque_jumps(scene, stepping_at(first))
    assert has_torque_jumps(scene, stepping_at(0.99 * first))
    assert has_torque_jumps(scene, stepping_at(1.01 * first))


def test_durations_that_are_one_are_kept_and_those_in_no_order_refused(heptagon):
    scene, _ = heptagon
    slide = eqx.tree_at(lambda s: s.phases, scene, scene.phases[:1])
    found = wa.optimise(slide, durations=(0.5, 0.5))
    assert float(found.scene.phases[0].duration) == 0.5
    assert float(found.torque.times[-1]) == pytest.approx(0.5)
    with pytest.raises(ValueError, match="shortest, longest"):
        wa.optimise(slide, durations=(2.0, 0.5))


def test_a_path_that_ends_where_it_begins_is_none(heptagon):
    """The usual slip of a pen: the next phase told to go back through what the object has just come up against."""
    scene, torque = heptagon
    data = to_dict(scene)
    slide, flip = data["phase"]
    back = wa.parse(data | {"phase": [slide, flip | {"toward": "phi+"}]})
    traced = wa.trace(back)
    assert wa.Status(int(traced[1].dynamics.status)) is wa.Status.LEFT_FORMATION
    assert float(wa.margin(back, torque)) == -np.inf
    assert float(wa.bounds(back, traced=traced)[1].value) == -np.inf
    found = wa.optimise(back, traced=traced)
    assert found.stopped[1] == "the path cannot be followed: left_formation"
    assert len({step.phase for step in found.history}) == 1


def test_a_plan_that_only_holds_its_object_has_no_margin_of_a_motion(heptagon):
    data = to_dict(heptagon[0])
    hold = {"name": "hold", "contacts": data["phase"][0]["contacts"], "hold": True, "duration": 1.0}
    plan = wa.parse(data | {"phase": [hold]})
    with pytest.raises(ValueError, match="only holds its object"):
        wa.margin(plan, wa.torque_schedule([0.0, 1.0], jnp.zeros((2, 2))))
