"""Linearise: all intervals (`shooting`) with first derivatives, what they must respect, and products with those.

Derivation: section 9 of `docs/derivation.md`.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.dynamics import PathDynamics, evaluate, locate_panel, resolve_impact
from wholearm_jax.margin import is_duplicate_facet
from wholearm_jax.optimisation.multiple_shooting import (
    ROWS,
    SPEED_COEFFICIENTS,
    Samples,
    Variables,
    interval_inputs,
    samples_of,
    simulate_intervals,
)
from wholearm_jax.simulation import IntegratorOptions


class Limits(eqx.Module):
    """What the result must respect: torque rates [N m/s], durations [s], the speed with which phases that do not begin
    at rest are entered at the least (`passing`, in wire lengths a duration), which knots' torques stay as they are;
    and each phase's `unit` of forces [N]. Who begins at rest with a torque that stays may set out without a jerk, its
    acceleration growing from zero."""

    rate: Float[Array, "2"]
    shortest: Float[Array, "phases"]
    longest: Float[Array, "phases"]
    passing: Float[Array, ""]
    pinned: Bool[Array, "phases knots"]
    unit: Float[Array, "phases"]


OF_PHASES = Limits(rate=False, shortest=True, longest=True, passing=False, pinned=True, unit=True)  # pyright: ignore


class Slacks(NamedTuple):
    """What must stay positive in each part of the intervals (forces over the margin, the others over zero), and the
    states in which the intervals end."""

    room: Float[Array, "phases parts rooms"]
    end: Float[Array, "phases intervals 2"]


class LinearisedProblem(NamedTuple):
    """All intervals at `p` with derivatives: `at` and `rates` (last axis: an interval's seven numbers); the rooms'
    `weight` (0: does not exist), the interval that each part is of (`IntervalResults.interval_of_part`); what must
    vanish, `defect`, and its
    derivatives `across`; `bears` marks the rooms that the margin lowers, `still` the variables that stay."""

    at: Slacks
    rates: Slacks
    weight: Float[Array, "phases parts rooms"]
    interval_of_part: Int[Array, "phases parts"]
    defect: Float[Array, "e"]
    across: Float[Array, "e p"]
    bears: Float[Array, "rooms"]
    still: Bool[Array, "p"]


def inequality_slacks(
    q: Float[Array, "phases intervals 7"], phase_dynamics: PathDynamics, limits: Limits, options: IntegratorOptions
):
    """All intervals of phases that follow one another at speed, one phase after the other: rooms, and what has no
    derivatives, `weight` and `interval_of_part` of `LinearisedProblem`."""
    phases, intervals = q.shape[:2]
    slowest = jnp.zeros((phases, intervals)).at[:, 0].set(limits.passing).at[0, 0].set(-jnp.inf)
    own, shared = eqx.partition(limits, OF_PHASES)

    def one(phase):
        q, slowest, dynamics, own = phase
        shot = simulate_intervals(dynamics, options, intervals, q)
        first = jnp.arange(shot.interval_of_part.size) < intervals
        least = jnp.where(first, slowest[shot.interval_of_part], 0.0)
        each = jax.vmap(partial(_interval_slacks, intervals), (0, 0, 0, 0, None, None))
        room, weight = each(q[shot.interval_of_part], shot.parts, first, least, dynamics, eqx.combine(own, shared))
        return Slacks(room, shot.end), (stop_gradient(weight), shot.interval_of_part)

    return jax.lax.map(one, (q, slowest, phase_dynamics, own))


def slack_sizes(knots: int) -> int:
    """How many rooms `_interval_slacks` has."""
    return samples_of(knots - 1) * ROWS + 8 + 4 + SPEED_COEFFICIENTS + 2


def _interval_slacks(
    intervals: int, q: Float[Array, "7"], part: Samples, first, slowest, dynamics: PathDynamics, limits: Limits
):
    """One part of an interval, and their weights; what does not depend on the part belongs to the `first`. `slowest` is
    the least speed with which it may begin, and -inf where it starts at rest; `limits` are those of its phase."""
    torque, log = q[2:6], q[6]
    bounded = jnp.isfinite(limits.rate)
    step = jnp.where(bounded, limits.rate, 1.0) / dynamics.torque_limit * jnp.exp(log) / intervals
    climb = jnp.where(bounded, (torque[2:] - torque[:2]) / step, 0.0)
    span = jnp.log(limits.longest / limits.shortest)
    free = span > 0
    ends = jnp.stack([log - jnp.log(limits.shortest), jnp.log(limits.longest) - log]) / jnp.where(free, span, 1.0)
    later = slowest > -jnp.inf
    pace = part.pace.at[0].add(-jnp.where(later, slowest, 0.0))
    room = [(part.forces / limits.unit).ravel(), 1 - torque, 1 + torque, 1 - climb, 1 + climb, pace, ends]
    one = first / intervals
    sampled = (part.weight[:, None] * ~is_duplicate_facet(dynamics)).ravel()
    climbs = jnp.tile(jnp.where(bounded, one / 4, 0.0), 2)
    # From rest the first coefficient is the speed, zero, and the second the acceleration.
    paces = part.pace_weight.at[0].multiply(later).at[1].multiply(later | ~limits.pinned[0])
    weight = [sampled, jnp.full(8, one / 4), climbs, paces, jnp.full(2, jnp.where(free, one / 4, 0.0))]
    return jnp.concatenate(room), jnp.concatenate(weight)


def linearise(
    p: Variables, phase_dynamics: PathDynamics, limits: Limits, options: IntegratorOptions
) -> LinearisedProblem:
    """Simulate all intervals, with first derivatives by forward mode: all depend on numbers of their own, so that
    seven directions serve them all."""
    phases, knots = p.torque.shape[:2]
    q = interval_inputs(p)

    def along(way):
        changes = jnp.broadcast_to(way, q.shape)
        return jax.jvp(lambda q: inequality_slacks(q, phase_dynamics, limits, options), (q,), (changes,), has_aux=True)

    at, rates, (weight, owner) = jax.vmap(along, out_axes=(None, -1, None))(jnp.eye(7))
    columns, ends = _columns(phases, knots)
    row = np.arange(ends.size)
    n = 4 * phases * knots + phases
    across = jnp.zeros((ends.size, n))
    across = across.at[row[:, None], np.repeat(columns.reshape(-1, 7), 2, axis=0)].add(rates.end.reshape(-1, 7))
    across = across.at[row, ends.ravel()].add(-1.0)
    defect = (at.end - p.state[:, 1:]).ravel()
    flat, unravel = ravel_pytree(p)

    def seams(x):
        return _linkage_defects(unravel(x), phase_dynamics)

    bears = np.arange(slack_sizes(knots)) < samples_of(knots - 1) * ROWS
    return LinearisedProblem(
        at,
        rates,
        weight,
        owner,
        jnp.concatenate([defect, seams(flat)]),
        jnp.concatenate([across, jax.jacfwd(seams)(flat)]),
        jnp.asarray(bears * 1.0),
        _fixed_variables(limits, phases, knots),
    )


def _linkage_defects(p: Variables, phase_dynamics: PathDynamics) -> Float[Array, "seams"]:
    """What must vanish where one phase takes over from another at speed: the error of the speed after the impact, and
    the torques' steps.

    A step placed on the moment of the change would act in the wrong formation whenever the object is early or late,
    be it by rounding: the margin would jump with the torques.
    """
    if p.torque.shape[0] == 1:
        return jnp.zeros(0)
    before, after = (jax.tree.map(lambda a, k=k: a[k], phase_dynamics) for k in (slice(0, -1), slice(1, None)))
    speed = before.length / jnp.exp(p.log_duration[:-1]) * p.state[:-1, -1, 1]
    lost = p.state[1:, 0, 1] - impact_speed_ratio(before, after) * speed * jnp.exp(p.log_duration[1:]) / after.length
    return jnp.concatenate([lost, (p.torque[1:, 0] - p.torque[:-1, -1]).ravel()])


def impact_speed_ratio(before: PathDynamics, after: PathDynamics) -> Float[Array, "seams"]:
    """`ds/dt` after the change of formation over that before it, tables stacked along the first axis."""

    def one(before, after):
        panel, xi = locate_panel(before, before.count - 1, before.breakpoints[-1])
        return resolve_impact(after, evaluate(before.velocity, panel, xi)).speed

    return jax.vmap(one)(before, after)


def _columns(phases: int, knots: int) -> tuple[Int[np.ndarray, "phases intervals 7"], Int[np.ndarray, "..."]]:
    """Where in the flattened `Variables` each interval's seven numbers and its end state stand."""
    size = 2 * phases * knots
    torque, state = np.arange(size).reshape(phases, knots, 2), np.arange(size, 2 * size).reshape(phases, knots, 2)
    duration = np.broadcast_to(2 * size + np.arange(phases)[:, None, None], (phases, knots - 1, 1))
    return np.concatenate([state[:, :-1], torque[:, :-1], torque[:, 1:], duration], axis=2), state[:, 1:]


def _fixed_variables(limits: Limits, phases: int, knots: int) -> Bool[Array, "p"]:
    """Pinned torques, the places where wires start and end, rest at the first start and last end, fixed durations."""
    ends = np.zeros((phases, knots, 2), bool)
    ends[:, [0, -1], 0] = ends[0, 0] = ends[-1, -1] = True
    fixed = limits.longest <= limits.shortest
    return jnp.concatenate([jnp.repeat(limits.pinned.ravel(), 2), jnp.asarray(ends.ravel()), fixed])


def sizes(linear: LinearisedProblem) -> tuple[int, int]:
    """Phases and knots."""
    phases, intervals = linear.at.end.shape[:2]
    return phases, intervals + 1


def of_states(linear: LinearisedProblem) -> slice:
    """Where the states stand in the flattened `Variables`."""
    phases, knots = sizes(linear)
    return slice(2 * phases * knots, 4 * phases * knots)


def columns(linear: LinearisedProblem) -> Int[np.ndarray, "phases intervals 7"]:
    """Where in the flattened `Variables` each interval's seven numbers stand."""
    return _columns(*sizes(linear))[0]


def scatter_add(linear: LinearisedProblem, values: Float[Array, "phases intervals 7"]) -> Float[Array, "p"]:
    """Numbers of each interval's own seven variables, summed for each variable; zero for those that stay."""
    return jnp.where(linear.still, 0.0, jnp.zeros(linear.still.shape[0]).at[columns(linear)].add(values))


def _by_interval(
    linear: LinearisedProblem, values: Float[Array, "phases parts *rest"]
) -> Float[Array, "phases intervals *rest"]:
    """Numbers of each part, summed for its interval."""
    phases, intervals = linear.at.end.shape[:2]
    at = np.arange(phases)[:, None], linear.interval_of_part[:, intervals:]
    return values[:, :intervals].at[at].add(values[:, intervals:])


def jacobian_transpose_product(
    linear: LinearisedProblem, values: Float[Array, "phases parts rooms"]
) -> Float[Array, "p"]:
    """`J^T values`, with `J` the derivatives of all rooms."""
    return scatter_add(linear, _by_interval(linear, jnp.einsum("pkr,pkrq->pkq", values, linear.rates.room)))


def gauss_newton_blocks(
    linear: LinearisedProblem, values: Float[Array, "phases parts rooms"]
) -> Float[Array, "phases intervals 7 7"]:
    """`J^T diag(values) J` for each interval's own seven variables."""
    rates = linear.rates.room
    return _by_interval(linear, jnp.einsum("pkr,pkrq,pkrs->pkqs", values, rates, rates))


def jacobian_product(linear: LinearisedProblem, way: Float[Array, "p"]) -> Float[Array, "phases parts rooms"]:
    """`J way`."""
    own = jnp.take_along_axis(way[columns(linear)], linear.interval_of_part[..., None], axis=1)
    return jnp.einsum("pkrq,pkq->pkr", linear.rates.room, own)
