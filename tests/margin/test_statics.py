"""What friction holds: statics against closed forms, exactness over time, and phases that hold the object."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog
from support import layered

import wholearm_jax as wa
from wholearm_jax.execution.executions import ExecutionOutcome, execute
from wholearm_jax.files.results import summary
from wholearm_jax.files.scene_toml import to_dict
from wholearm_jax.margin import best_quasistatic_torque, contact_statics, rest_margin
from wholearm_jax.model.scene import Arrival, replace_duration
from wholearm_jax.model.schedule import pad_schedule
from wholearm_jax.optimisation.plan_transitions import holding_schedule
from wholearm_jax.optimisation.rest_transition import RestTransition
from wholearm_jax.phases.phase_ends import statics_at_start
from wholearm_jax.phases.phase_simulation import simulate_phase
from wholearm_jax.simulation import IntegratorOptions

HALF, MASS, MU, DRY, LIMIT = 0.03, 0.2, 0.3, 0.01, 1.0
WEIGHT, HEIGHT = MASS * 9.81, 2 * HALF


def block(friction=MU, dry=(DRY, DRY), mass=MASS, limits=(LIMIT, LIMIT)):
    """A square on the palm; upright fingers, whose joints lie below its sides, touch its upper corners."""
    right, left = (
        {"length": 0.1, "inertia": 2e-3, "dry": d, "torque_limit": top} for d, top in zip(dry, limits, strict=True)
    )
    contacts = ["palm:v0", "palm:v1", "finger1:v2", "finger2:v3"]
    return wa.parse(
        {
            "title": "block",
            "gravity": 9.81,
            "hand": {
                "fingers": "layered",
                "finger1": right | {"joint": [HALF, 0.0]},
                "finger2": left | {"joint": [-HALF, 0.0]},
            },
            "object": {
                "vertices": [[-HALF, -HALF], [HALF, -HALF], [HALF, HALF], [-HALF, HALF]],
                "mass": mass,
                "friction": friction,
            },
            "start": {"x": 0.0, "y": HALF, "phi": 0.0, "theta1": np.pi / 2, "theta2": np.pi / 2},
            "phase": [{"name": "hold", "contacts": contacts, "hold": True, "duration": 1.0}],
        }
    )


def of_block(**changed):
    scene = block(**changed)
    return contact_statics(scene, scene.phases[0].formation, scene.start)


@pytest.mark.parametrize("torque", [0.005, 0.03, 0.06, 0.3])
def test_a_block_squeezed_by_two_fingers(torque):
    """The squeeze is `(tau + D) / h` at most; friction pushes the block onto the palm by `mu` of it on each side."""
    squeeze = (torque + DRY) / HEIGHT
    found = of_block().margin_under([torque, -torque])
    assert found.margin == pytest.approx(min(squeeze, WEIGHT / 2 + MU * squeeze), rel=1e-9)
    assert found.contact.startswith("finger" if squeeze < WEIGHT / 2 + MU * squeeze else "palm")


def test_the_best_squeeze_is_at_the_limit():
    found = of_block().best()
    assert found.margin == pytest.approx(WEIGHT / 2 + MU * (LIMIT + DRY) / HEIGHT, rel=1e-9)
    assert of_block().margin_under(found.torque).margin == pytest.approx(found.margin, rel=1e-9)


@pytest.mark.parametrize("swapped", [False, True])
def test_each_finger_has_its_own_limit_and_dry_friction(swapped):
    """A squeeze is `(limit + D) / h` of its finger at most, friction `mu` of its link times the force."""
    dry, limits, mu = (0.01, 0.03), (0.2, 0.5), {"palm": 0.1, "finger1": 0.2, "finger2": 0.4}
    if swapped:
        dry, limits, mu = dry[::-1], limits[::-1], mu | {"finger1": 0.4, "finger2": 0.2}
    found = of_block(friction=mu, dry=dry, limits=limits).best()
    assert found.margin == pytest.approx(_least_force(mu, dry, limits), rel=1e-9)


def _least_force(mu, dry, limits) -> float:
    """The largest least normal force of the block at rest, as a linear programme of its eight forces."""
    # Unknowns: p0, p1, s1, s2 (normal), q0, q1, f1, f2 (friction: of the palm to the right, of the fingers up), level.
    balance = np.zeros((3, 9))
    balance[0, [4, 5, 3, 2]] = [1, 1, 1, -1]  # finger 2 pushes to the right, finger 1 to the left
    balance[1, [0, 1, 6, 7]] = 1
    balance[2, [0, 1, 6, 7]] = [-HALF, HALF, HALF, -HALF]  # about the centre
    balance[2, [4, 5, 2, 3]] = [HALF, HALF, HALF, -HALF]
    rows = []
    for normal, tangent, coefficient in zip(
        range(4), range(4, 8), [mu["palm"], mu["palm"], mu["finger1"], mu["finger2"]], strict=True
    ):
        for sign in (1.0, -1.0):
            row = np.zeros(9)
            row[tangent], row[normal] = sign, -coefficient
            rows.append((row, 0.0))
        row = np.zeros(9)
        row[8], row[normal] = 1.0, -1.0
        rows.append((row, 0.0))
    for squeeze, top, stuck in zip((2, 3), limits, dry, strict=True):
        row = np.zeros(9)
        row[squeeze] = HEIGHT
        rows.append((row, top + stuck))
    answer = linprog(
        -np.eye(9)[8],
        A_ub=np.array([row for row, _ in rows]),
        b_ub=[most for _, most in rows],
        A_eq=balance,
        b_eq=[0.0, WEIGHT, 0.0],
        bounds=[(0, None)] * 4 + [(None, None)] * 5,
    )
    assert answer.success
    return -answer.fun


def test_fingers_that_pull_would_have_to_adhere():
    """Without dry friction each finger's pressure is `tau / h`; where that is negative it is the adhesion needed."""
    found = of_block(dry=(0.0, 0.0)).margin_under([-0.03, 0.03])
    assert found.margin == pytest.approx(-0.03 / HEIGHT, rel=1e-9)
    assert found.contact.startswith("finger")


def test_what_no_adhesion_holds():
    """A push from one side alone, without any friction."""
    assert of_block(friction=0.0, dry=(0.0, 0.0)).margin_under([0.05, -0.02]).margin == -np.inf


def test_units_do_not_matter():
    """A million times the mass and the torque: a million times the margin."""
    heavy = of_block(mass=MASS * 1e6, dry=(DRY * 1e6, DRY * 1e6))
    small = of_block().margin_under([0.05, -0.04]).margin
    assert heavy.margin_under([0.05e6, -0.04e6]).margin == pytest.approx(1e6 * small, rel=1e-9)


@pytest.fixture(scope="module")
def slide_hold_flip():
    """The heptagon's plan with a rest between its phases, and its paths."""
    data = to_dict(layered("heptagon"))
    slide, flip = data["phase"]
    pause = {"name": "pause", "contacts": slide["contacts"], "hold": True, "duration": 0.5}
    scene = wa.parse(data | {"phase": [slide, pause, flip]})
    return scene, wa.trace(scene)


@pytest.fixture(scope="module")
def optimised(slide_hold_flip):
    scene, traced = slide_hold_flip
    return wa.optimise(scene, knots=31, traced=traced)


def test_the_margin_over_time_is_exact(slide_hold_flip):
    """Against many programmes along the way: the least margin lies at a knot, the loss where the balance says."""
    scene, traced = slide_hold_flip
    balance, _ = statics_at_start(scene, scene.phases[1], traced[1])
    best = balance.best().torque
    rng = np.random.default_rng(3)
    losses = 0
    for _ in range(8):
        knots = np.vstack([best + 0.1 * rng.normal(size=2), best + 0.5 * rng.normal(size=(2, 2))])
        schedule = wa.torque_schedule([0.0, 0.4, 1.0], knots)
        held = rest_margin(balance, schedule, 0.1, 0.9)
        times = np.union1d(np.linspace(0.1, 0.9, 17), [0.4])
        torques = np.stack([np.interp(times, schedule.times, knots[:, k]) for k in range(2)], axis=1)
        margins = np.array([balance.margin_under(torque).margin for torque in torques])
        assert held.margin == pytest.approx(margins.min(), abs=1e-9)
        assert held.time == pytest.approx(times[np.argmin(margins)], abs=1e-12)
        assert (held.loss_time is None) == bool(margins.min() >= -1e-7)
        if held.loss_time is not None and held.loss_time > 0.1:
            losses += 1
            around = held.loss_time + np.array([-1e-6, 1e-6])
            before, after = (np.array([np.interp(t, schedule.times, knots[:, k]) for k in range(2)]) for t in around)
            assert balance.margin_under(before).margin >= 0 > balance.margin_under(after).margin
    assert losses, "no hold is lost on its way: it is no test"


def test_slide_hold_flip(slide_hold_flip, optimised):
    scene, traced = slide_hold_flip
    slide, pause, flip = optimised.result.phases
    assert optimised.result.status is wa.Status.OK
    assert optimised.result.margin == min(slide.margin, flip.margin)
    assert optimised.result.hold_margin == pause.margin > 2.0
    assert optimised.bound_fraction[1] == pytest.approx(1.0, abs=0.011)
    np.testing.assert_allclose(traced[2].begin, traced[0].end, atol=1e-9)
    (held,) = pause.holds
    assert (held.start, held.end, held.loss_time) == (1.0, 1.5, None)
    course = wa.trajectory(optimised.result)[1]
    np.testing.assert_array_equal(course.z, np.broadcast_to(course.z[0], course.z.shape))
    assert np.isnan(course.cn).all()
    assert wa.parse(to_dict(scene)).phases[1].arrive is Arrival.HOLD
    content = summary(optimised.result)
    assert content["hold_margin"] == content["phases"][1]["holds"][0]["margin"] == pause.margin
    quasistatic = wa.simulate(scene, wa.quasistatic(scene, traced=traced), traced=traced)
    assert quasistatic.phases[1].status is wa.Status.OK


def test_executed_on_free_bodies(optimised):
    done = execute(optimised.result)
    assert done.ending is ExecutionOutcome.OK
    at_rest = (done.course.time > 1.0) & (done.course.time < 1.5)
    end = optimised.result.phases[0].traced.end
    off = done.course.z[at_rest, :2] - np.asarray(end)[:2]
    assert np.hypot(*off.T).max() < 5e-4


@pytest.mark.parametrize("length", [-6e-15, 0.0, 6e-15])
def test_an_object_is_held_where_its_path_ends(optimised, length):
    """The path of a hold at the end of the phase before it has no length but rounding, of either sign."""
    pause = optimised.result.phases[1]
    dynamics = pause.traced.dynamics
    breaks = dynamics.breakpoints.at[1:].set(dynamics.breakpoints[0] + length)
    dynamics = eqx.tree_at(lambda t: t.breakpoints, dynamics, breaks)
    found = simulate_phase(
        dynamics, pad_schedule(optimised.torque), pause.start, pause.duration, IntegratorOptions(), Arrival.HOLD
    )
    motion = found.motion
    assert wa.Status(int(motion.status)) is wa.Status.STUCK
    assert (int(motion.count), bool(motion.at_rest[0])) == (1, True)
    np.testing.assert_array_equal(motion.phase_time[:2], [0.0, 1.0])
    for values in (motion.s, motion.w):
        np.testing.assert_array_equal(values, np.full_like(values, values[0]))


def changed_pause(found, factors):
    """The schedule with the pause's torques multiplied."""
    rows = slice(31, 62)
    return eqx.tree_at(lambda t: t.values, found.torque, found.torque.values.at[rows].multiply(jnp.asarray(factors)))


def test_a_hold_that_the_contacts_cannot_bear_is_named(slide_hold_flip, optimised):
    scene, traced = slide_hold_flip
    more = np.column_stack([np.linspace(1.0, 1.5, 31), np.ones(31)])
    torque = changed_pause(optimised, more)
    result = wa.simulate(scene, torque, traced=traced)
    pause = result.phases[1]
    (held,) = pause.holds
    assert result.status is pause.status is wa.Status.CONTACT_LOST
    assert pause.contact == held.contact in pause.contacts
    assert pause.time == held.loss_time
    assert 1.0 < held.loss_time < held.end
    assert held.margin < 0 > result.hold_margin
    assert result.margin > 0.5, "the moving phases' margin stays"
    assert "contact_lost" in result.message


def test_an_object_that_departs_is_not_held(slide_hold_flip, optimised):
    """Backward along the path as it was traced says `reversed`, forward `not_reached`, each when it departs."""
    scene, traced = slide_hold_flip
    _, departure = statics_at_start(scene, scene.phases[1], traced[1])
    base = np.asarray(optimised.torque.values)[31]
    phase_schedule = {}
    for row, status in ((departure.ahead, "not_reached"), (departure.behind, "reversed")):
        size = row[1:] @ row[1:]
        at_edge = -(row @ np.append(1.0, base)) / size  # along this row's direction acceleration is then zero
        ramp = np.linspace(0.0, 2.0, 31)[:, None]
        rows = base + ramp * at_edge * row[1:]
        torque = eqx.tree_at(lambda t: t.values, optimised.torque, optimised.torque.values.at[31:62].set(rows))
        phase = wa.simulate(scene, torque, traced=traced).phases[1]
        phase_schedule[status] = phase
        outcome = phase.outcome.assessment
        assert wa.Status(int(outcome.status)).label == status
        assert float(outcome.phase_time) == pytest.approx(0.5, abs=1e-9), "the acceleration's sign changes half way"
    assert phase_schedule["not_reached"].holds[0].end == pytest.approx(1.25, abs=1e-9)


@pytest.mark.parametrize("duration", [1.0, 0.15])
def test_the_way_to_a_hold_and_on_keeps_the_rate_limit(slide_hold_flip, duration):
    """To the best torque and on where there is time for that, or else as near to it as there is."""
    scene, traced = slide_hold_flip
    rate, before, after = 2.0, np.array([0.26, -0.06]), np.array([0.4, -0.15])
    ends = [RestTransition(torque, torque, 0.0, 1.0) for torque in (before, after)]
    phase = replace_duration(scene.phases[1], duration)
    schedule = holding_schedule(scene, phase, traced[1], 31, rate, *ends)
    times, values = np.asarray(schedule.times), np.asarray(schedule.values)
    rates = np.abs(np.diff(values, axis=0)) / np.diff(times)[:, None]
    np.testing.assert_array_equal(values[[0, -1]], [before, after])
    np.testing.assert_array_equal(times[[0, -1]], [0.0, duration])
    assert rates.max() == pytest.approx(rate, rel=1e-9)
    balance, departure = statics_at_start(scene, scene.phases[1], traced[1])
    best = balance.most_central_torque(departure).torque
    reached = np.abs(values - best).max(1).min()
    assert reached < 1e-12 if duration == 1.0 else 0 < reached < np.abs(after - best).max()
    margins = [balance.margin_under(torque).margin for torque in values]
    assert min(margins) >= min(margins[0], margins[-1]) - 1e-9


def test_steps_of_ten_per_cent_refuse_a_hold(slide_hold_flip):
    with pytest.raises(ValueError, match="phase 'pause' holds the object"):
        wa.search_by_steps(slide_hold_flip[0])


def test_motion_that_stops_holds_and_starts_again():
    """Pushed, braked to rest, held by a torque that changes, pushed on: each rest with the margin of its statics."""
    slide = layered("heptagon")
    alone = eqx.tree_at(lambda s: s.phases, slide, slide.phases[:1])
    dynamics = wa.trace(alone)[0].dynamics
    push, brake, still = (
        np.asarray(best_quasistatic_torque(dynamics, dynamics.breakpoints[0], 0.0, a).torque) for a in (4.0, -6.0, 0.0)
    )
    again = np.asarray(best_quasistatic_torque(dynamics, dynamics.breakpoints[0] + 0.03, 0.0, 4.0).torque)
    times = [0.0, 0.1, 0.11, 0.3, 0.31, 0.5, 0.6, 1.0]
    schedule = wa.torque_schedule(times, np.stack([push, push, brake, brake, 0.9 * still, still, again, again]))
    (phase,) = wa.simulate(alone, schedule).phases
    rests = [held for held in phase.holds if held.end > held.start]
    assert rests
    assert 0.1 < rests[0].start < 0.2
    assert 0.5 < rests[0].end < 0.6, "the second push starts it again"
    motion = phase.outcome.motion
    stopped = motion.s[int(np.argmax(motion.at_rest))]
    assert float(motion.s[motion.count]) > float(stopped) > float(dynamics.breakpoints[0])
    z = wa.trajectory(wa.simulate(alone, schedule))[0].z[60]  # at 0.3 s, give or take
    weakest = contact_statics(alone, alone.phases[0].formation, z).margin_under(0.9 * still)
    assert rests[0].margin == pytest.approx(weakest.margin, rel=1e-6)
    for held in rests:
        assert held.loss_time is None
        assert held.margin > 0
    (stuck,) = wa.simulate(
        alone, wa.torque_schedule([*times[:6], 1.0], schedule.values[jnp.array([0, 1, 2, 3, 4, 5, 5])])
    ).phases
    assert stuck.status is wa.Status.STUCK
    assert stuck.message.startswith(f"slide left: stuck, t = 1 s, at rest since {rests[0].start:.6g} s: ")


def test_a_rest_between_rounded_times_has_its_own_torque():
    """Times of phases are sums, those of a schedule are rounded: a step at either end belongs to the neighbour."""
    balance, squeeze, none = of_block(), [0.06, -0.06], [-5.0, 5.0]
    before, after = 0.1 + 0.2, 0.1 + 0.7
    assert before > 0.3
    assert after < 0.8
    until = wa.torque_schedule([0.0, 0.3, 0.3, 1.0], [squeeze, squeeze, none, none])
    since = wa.torque_schedule([0.0, 0.8, 0.8, 1.0], [none, none, squeeze, squeeze])
    for schedule, start, end in ((until, 0.1, before), (since, after, 1.0)):
        held = rest_margin(balance, schedule, start, end)
        assert held.loss_time is None
        assert held.margin == pytest.approx(balance.margin_under(squeeze).margin, rel=1e-9)
