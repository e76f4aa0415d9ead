"""Intervals simulated on their own: joined, they are the phase; their derivatives are those of differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import layered

import wholearm_jax as wa
from wholearm_jax.margin import quasistatic as squeeze
from wholearm_jax.model.schedule import restrict_to_phase
from wholearm_jax.optimisation.multiple_shooting import simulate_intervals
from wholearm_jax.optimisation.variables import Variables, interval_inputs
from wholearm_jax.phases.plan_tracing import trace
from wholearm_jax.simulation import IntegratorOptions, dense_output, evaluate_dense, simulate_motion

OPTIONS = IntegratorOptions()


def _simulate_one(dynamics, intervals, q):
    """One interval: its parts, and its end."""
    results = simulate_intervals(dynamics, OPTIONS, intervals, q[None])
    return results.parts, results.end[0]


@pytest.fixture(scope="module")
def flip():
    """The heptagon's flip, whose path has a slip reversal near its end."""
    dynamics = trace(layered("heptagon"))[1].dynamics
    assert int(dynamics.count) == 2
    return dynamics


def _crossing(dynamics):
    """An interval that begins shortly before the reversal and crosses it."""
    reversal = float((dynamics.breakpoints[1] - dynamics.breakpoints[0]) / dynamics.length)
    return jnp.array([reversal - 1e-4, 0.1, 0.10443, -0.94068, 0.30118, -0.94629, 0.0]), reversal


def test_an_interval_crosses_a_reversal_as_the_simulation_does(flip):
    q, reversal = _crossing(flip)
    intervals = 300
    parts, end = _simulate_one(flip, intervals, q)
    assert float(end[0]) > reversal, "the interval must cross the reversal"
    assert (np.asarray(parts.force_weight) > 0).sum() == 18, "two parts of one step with nine samples"
    values = q[2:6].reshape(2, 2) * flip.torque_limit
    duration = jnp.exp(q[6]) / intervals
    phase_schedule = restrict_to_phase(wa.torque_schedule([0.0, float(duration)], values), jnp.zeros(()), duration)
    s = flip.breakpoints[0] + flip.length * q[0]
    motion = simulate_motion(
        flip, phase_schedule, duration, options=IntegratorOptions(tolerance=1e-13), s=s, speed=flip.length * q[1]
    )
    s_end = (motion.s[motion.count] - flip.breakpoints[0]) / flip.length
    v_end = motion.w[motion.count] / duration / flip.length
    np.testing.assert_allclose(end, [s_end, v_end], rtol=1e-9)


def test_speed_coefficients_bound_the_speed_between_knots(flip):
    """An interval that goes forward at both ends and backward between them shows it."""
    intervals, speed, brake = 50, 1e-3, 4.0
    s, v = flip.breakpoints[0] + 0.3 * flip.length, speed * flip.length
    torque = [squeeze.best_quasistatic_torque(flip, s, v, a).torque / flip.torque_limit for a in (-brake, brake)]
    q = jnp.concatenate([jnp.array([0.3, speed]), *torque, jnp.zeros(1)])
    parts, end = _simulate_one(flip, intervals, q)
    phase_schedule = restrict_to_phase(
        wa.torque_schedule([0.0, 1 / intervals], q[2:6].reshape(2, 2) * flip.torque_limit), 0.0, 1 / intervals
    )
    motion = simulate_motion(
        flip,
        phase_schedule,
        jnp.asarray(1 / intervals),
        options=IntegratorOptions(tolerance=1e-12),
        s=s,
        speed=v,
        ignore_stops=True,
    )
    steps = dense_output(flip, phase_schedule, 1 / intervals, motion)
    places = jnp.linspace(0.0, 1.0, 101)
    each = jax.vmap(lambda k: jax.vmap(lambda xi: evaluate_dense(jax.tree.map(lambda a: a[k], steps), xi)[2])(places))
    speeds = np.asarray(each(np.arange(int(motion.count)))) * intervals / float(flip.length)
    assert speeds[0, 0] == pytest.approx(speed)
    assert float(end[1]) > 0 > speeds.min()
    bound = float(parts.speed[parts.speed_weight > 0].min())
    assert speeds.min() - 0.2 * np.ptp(speeds) < bound < speeds.min()
    np.testing.assert_allclose(parts.speed_weight.sum(), 1 / intervals)


def test_derivatives_of_an_interval_that_is_cut(flip):
    q, _ = _crossing(flip)

    @jax.jit
    def everything(q):
        parts, end = _simulate_one(flip, 300, q)
        return jnp.concatenate([parts.force.ravel(), parts.speed.ravel(), end])

    exact = jax.jit(jax.jacfwd(everything))(q)

    def slope(k, h):
        step = jnp.zeros(7).at[k].set(h)
        return (everything(q + step) - everything(q - step)) / (2 * h)

    for k in range(7):
        h = 1e-5
        richardson = (4 * slope(k, h / 2) - slope(k, h)) / 3
        np.testing.assert_allclose(exact[:, k], richardson, rtol=1e-5, atol=1e-6 * (jnp.abs(exact[:, k]).max() + 1e-3))


@pytest.mark.parametrize(("knots", "late", "near"), [(31, 1e-9, 1e-8), (51, 1e-4, 1e-6)])
def test_joined_intervals_are_the_phase(knots, late, near):
    """With two solver steps an interval, and with one: when that comes to rest is known to the square root of where."""
    scene = layered("hexagon")
    scene = eqx.tree_at(lambda s: s.phases, scene, scene.phases[:1])
    found = wa.optimise(scene, knots=knots)
    dynamics, motion = found.result.phases[0].traced.dynamics, found.result.phases[0].outcome.motion
    shares = np.asarray(motion.phase_time)
    at = [int(np.argmin(np.abs(shares - k / (knots - 1)))) for k in range(knots)]
    off = np.abs(shares[at] - np.arange(knots) / (knots - 1))
    assert off[:-1].max() < 1e-9, "steps end on the knots"
    assert off[-1] < late
    state = np.stack([(motion.s[np.array(at)] - dynamics.breakpoints[0]), motion.w[np.array(at)]], axis=1) / float(
        dynamics.length
    )
    p = Variables((found.torque.values / dynamics.torque_limit)[None], jnp.asarray(state)[None], jnp.zeros(1))
    ends = simulate_intervals(dynamics, OPTIONS, knots - 1, interval_inputs(p)[0]).end
    np.testing.assert_allclose(ends[:-1], state[1:-1], atol=1e-8)
    np.testing.assert_allclose(ends[-1], state[-1], atol=near)  # the simulation lands on the path's end or on rest
