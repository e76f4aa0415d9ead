"""The bound and the best squeeze by their definitions: linear programmes, solved by another's solver."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog
from support import layered

import wholearm_jax as wa
from wholearm_jax.margin import BOUND_PLACES, BOUND_SPEEDS, MAX_SPEED_RATIO, margin_upper_bound
from wholearm_jax.margin import quasistatic as squeeze
from wholearm_jax.model import Arrival

coefficients, bound, hold = (
    jax.jit(squeeze.affine_coefficients),
    jax.jit(margin_upper_bound),
    jax.jit(squeeze.best_quasistatic_torque),
)


def largest_least_force(offset, slope, limits, forward=None):
    """The largest `m` with `offset + slope tau >= m` within limits, and `row tau + constant >= 0` if so wanted."""
    above, most = np.column_stack([-slope, np.ones(len(slope))]), offset
    if forward is not None:
        row, constant = forward
        above, most = np.vstack([above, [*-row, 0.0]]), np.append(most, constant)
    box = [*((-limit, limit) for limit in limits), (None, None)]
    answer = linprog([0.0, 0.0, -1.0], A_ub=above, b_ub=most, bounds=box)
    return -answer.fun if answer.status == 0 else -np.inf


def best_at(dynamics, duration, place, rests):
    """The largest least force at a share of the path, and the most that each interval of speeds could give."""
    s = dynamics.breakpoints[0] + place * dynamics.length
    motion, force = (np.asarray(a) for a in coefficients(dynamics, s))
    limits = np.asarray(dynamics.torque_limit)
    sign = {0.0: 1, 1.0: -1}.get(place) if rests else None
    if sign is not None:
        still = largest_least_force(force[:, 0], force[:, 3:], limits, (sign * motion[3:], sign * motion[0]))
        return still, still
    speeds = MAX_SPEED_RATIO * float(dynamics.length) / duration * np.linspace(0.0, 1.0, BOUND_SPEEDS + 1) ** 2

    def at(square, linear):
        return largest_least_force(force[:, 0] + square + linear, force[:, 3:], limits)

    true = max(at(force[:, 1] * v**2, force[:, 2] * v) for v in speeds)
    pairs = [
        (np.outer(force[:, 1], [u**2, v**2]), np.outer(force[:, 2], [u, v])) for u, v in itertools.pairwise(speeds)
    ]
    return true, max(at(square.max(1), linear.max(1)) for square, linear in pairs)


@pytest.mark.parametrize("limits", [(1.0, 1.0), (0.4, 1.5)])
@pytest.mark.parametrize("rests", [True, False], ids=["from rest to rest", "at speed throughout"])
@pytest.mark.parametrize("duration", [1.0, 0.1])
@pytest.mark.parametrize("phase", [0, 1])
def test_the_bound_is_the_least_of_the_best_forces(phase, duration, rests, limits):
    """Exactly that of intervals of speeds, and above what any of their speeds allows."""
    scene = eqx.tree_at(lambda s: s.hand.torque_limit, layered("heptagon"), jnp.asarray(limits))
    dynamics = wa.trace(scene)[phase].dynamics
    top = bound(dynamics, jnp.asarray(duration), jnp.asarray(rests), jnp.asarray(rests))
    value, tight = float(top.value), float(top.path_fraction)
    true, most = best_at(dynamics, duration, tight, rests)
    assert value == pytest.approx(most, rel=1e-9)
    assert value >= true - 1e-9
    assert float(top.s) == pytest.approx(float(dynamics.breakpoints[0] + tight * dynamics.length), rel=1e-12)
    for place in (0.0, *(np.random.default_rng(0).choice(np.arange(1, BOUND_PLACES), 6) / BOUND_PLACES), 1.0):
        assert best_at(dynamics, duration, float(place), rests)[1] >= value - 1e-9


@pytest.mark.parametrize(("name", "grip"), [("heptagon", 1.0), ("tipping", 0.2)])
def test_bounds_leave_out_only_what_cannot_roll(name, grip):
    """At a fifth of its friction the tipping polygon is as good as slipping on either side."""
    scene = layered(name)
    scene = eqx.tree_at(lambda s: s.object.friction, scene, grip * scene.object.friction)
    traced = wa.trace(scene)
    for at, phase, top in zip(traced, scene.phases, wa.bounds(scene, traced=traced), strict=True):
        every = bound(at.dynamics, phase.duration, True, phase.arrive is Arrival.AT_REST)
        assert float(top.value) == pytest.approx(float(every.value), rel=1e-12)


@pytest.fixture(scope="module")
def slide():
    """The heptagon's slide, whose path and table know no limits of torque."""
    return wa.trace(layered("heptagon"))[0].dynamics


@pytest.mark.parametrize("acceleration", [-3.0, 0.0, 20.0, 300.0])
@pytest.mark.parametrize("idle", [False, True], ids=["both fingers drive", "the second only presses"])
@pytest.mark.parametrize("limits", [(1.0, 1.0), (0.4, 1.5)])
def test_the_best_squeeze_is_within_limits(slide, limits, idle, acceleration):
    """Where one finger alone drives the object the motion tells its torque, which may be beyond its limit."""
    dynamics = eqx.tree_at(lambda t: t.torque_limit, slide, jnp.asarray(limits))
    if idle:
        dynamics = eqx.tree_at(lambda t: t.acceleration, dynamics, dynamics.acceleration.at[..., 4].set(0.0))
    s, speed = dynamics.breakpoints[0] + 0.4 * dynamics.length, 0.5
    motion, force = (np.asarray(a) for a in coefficients(dynamics, s))
    terms = np.array([1.0, speed**2, speed])
    slacks = np.column_stack([-force[:, 3:], np.ones(len(force))])
    wanted = acceleration * float(dynamics.length)
    answer = linprog(
        [0.0, 0.0, -1.0],
        A_ub=slacks,
        b_ub=force[:, :3] @ terms,
        A_eq=[[*motion[3:], 0.0]],
        b_eq=[wanted - motion[:3] @ terms],
        bounds=[*((-limit, limit) for limit in limits), (None, None)],
    )
    found = hold(dynamics, s, jnp.asarray(speed), jnp.asarray(wanted))
    if answer.status == 0:
        assert float(found.margin) == pytest.approx(-answer.fun, rel=1e-9)
        assert np.all(np.abs(found.torque) <= np.array(limits) * (1 + 1e-12))
    else:
        assert answer.status == 2
        assert float(found.margin) == -np.inf
