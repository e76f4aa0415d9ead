r"""Score: the compressive margin of a motion, exact in time, and the smooth minimum that is optimised.

What counts toward the margin [N] is the slack of each constraint's force: `c_n` itself, and `mu c_n - |c_t|`, how far
inside its friction cone the force is, in the tangential row of a contact that rolls.

Between accepted steps `s(u)` is the quintic with the right `s`, `ds/du` and `d2s/du2` at both ends, so that forces are
known at every time, not only at steps. The margin is the least slack over continuous time and all contacts: samples
find its neighbourhood, golden section its place. Its derivative is that of the force at the place found (the envelope
theorem), landings and knots included.

Derivation: section 7 of `docs/derivation.md`.
"""

import math
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.core import take_row
from wholearm_jax.dynamics import (
    PathDynamics,
    evaluate_dot,
    locate_panel,
)
from wholearm_jax.model import PhaseSchedule, torque_at
from wholearm_jax.simulation import (
    DenseOutput,
    IntegratorOptions,
    Motion,
    dense_output,
    evaluate_dense,
    path_acceleration,
    solver_step,
)

SAMPLES_PER_STEP = 7  # places in a step at which forces are sampled before the minimum is refined
MAX_ROLLING = 2  # contacts of a formation that can roll: 2R + S = 4
MAX_REFINED = 4  # dips refined: those that parabolas through samples put lowest
FEW_CANDIDATES = 16  # steps sampled together
GOLDEN_ITERATIONS = 17  # sections to a dip: Newton's step on the true motion follows


class MarginResult(NamedTuple):
    """The least slack of a phase: `margin` [N], its time as a share of the phase, its `s` and the number of its row in
    the formation, `contact`.

    `loss_time` is the share at which a contact first pulls or slips (infinite if none does), `loss_contact` its row.
    """

    margin: Float[Array, ""]
    phase_time: Float[Array, ""]
    s: Float[Array, ""]
    contact: Int[Array, ""]
    loss_time: Float[Array, ""]
    loss_contact: Int[Array, ""]


def contact_force(
    dynamics: PathDynamics, phase_schedule: PhaseSchedule, duration, segment, row, phase_time, s, w
) -> Float[Array, "rows"]:
    """Constraint forces [N] for forward travel: `c_n`, and `c_t` in tangential rows."""
    panel, xi = locate_panel(dynamics, segment, s)
    v = w / duration
    rest = jnp.stack([jnp.ones_like(v), v**2, v])
    return evaluate_dot(dynamics.force, panel, xi, jnp.concatenate([rest, torque_at(phase_schedule, row, phase_time)]))


def force_slack(dynamics: PathDynamics, forces: Float[Array, "rows"]) -> Float[Array, "rows"]:
    """What of constraint forces counts toward the margin [N]: `c_n`, and `mu c_n - |c_t|` in tangential rows."""
    cone = dynamics.rolling_friction * jnp.roll(forces, 1) - jnp.abs(
        forces
    )  # a contact's normal row stands before its tangential one
    return jnp.where(dynamics.tangential, cone, forces)


def cone_facets(
    dynamics: PathDynamics, forces: Float[Array, "rows *terms"], rolling: int = MAX_ROLLING
) -> Float[Array, "facets *terms"]:
    """Linear functions of the forces whose least is the least `force_slack`: both sides of each friction cone.

    `forces` may be coefficients, by any linear terms. Four constraints have at most two tangential rows, and so there
    are six of these, fewer where it is known that no more than `rolling` roll; those not needed (`is_duplicate_facet`)
    repeat the
    first.
    """
    column = (slice(None), *(None,) * (forces.ndim - 1))
    normal = dynamics.rolling_friction[column] * jnp.roll(forces, 1, axis=0)
    one_side = jnp.where(dynamics.tangential[column], normal - forces, forces)
    (rows,) = jnp.nonzero(dynamics.tangential, size=rolling, fill_value=-1)
    other = jnp.where((rows >= 0)[column], (normal + forces)[rows], forces[0])
    return jnp.concatenate([one_side, other])


def is_duplicate_facet(dynamics: PathDynamics) -> Bool[Array, "rows"]:
    """Which of `cone_facets` repeat another."""
    slots = dynamics.tangential.shape[0]
    return jnp.arange(slots + MAX_ROLLING) >= slots + dynamics.tangential.sum()


def slacks_at(
    dynamics: PathDynamics, phase_schedule: PhaseSchedule, duration, arc: DenseOutput, xi, kind=force_slack
) -> Float[Array, "rows"]:
    """`force_slack` (or `cone_facets`) at `xi` of one arc."""
    phase_time, s, w = evaluate_dense(arc, xi)
    return kind(dynamics, contact_force(dynamics, phase_schedule, duration, arc.segment, arc.row, phase_time, s, w))


def sampled_slacks(
    dynamics: PathDynamics,
    phase_schedule: PhaseSchedule,
    duration,
    steps: DenseOutput,
    samples: int = SAMPLES_PER_STEP,
    kind=force_slack,
) -> Float[Array, "steps samples rows"]:
    """`force_slack` (or `cone_facets`) at evenly spaced places of every step, ends included; infinite where all
    rests."""
    xi = jnp.linspace(0.0, 1.0, samples, dtype=steps.quintic.dtype)
    on = partial(slacks_at, kind=kind)
    at = jax.vmap(jax.vmap(on, (None, None, None, None, 0)), (None, None, None, 0, None))
    values = at(dynamics, phase_schedule, duration, steps, xi)
    return jnp.where((steps.live & ~steps.at_rest)[:, None, None], values, jnp.inf)


def minimum_margin(
    dynamics: PathDynamics,
    phase_schedule: PhaseSchedule,
    duration: Float[Array, ""],
    motion: Motion,
    options: IntegratorOptions,
) -> MarginResult:
    """The margin of a simulated phase.

    The quintics find the place; the force there comes from one step of the solver that ends beside it, so that the
    margin is as accurate as the integration.
    """
    steps = dense_output(dynamics, phase_schedule, duration, motion)
    values = _sample(*stop_gradient((dynamics, phase_schedule, duration, steps)), motion.count)

    def at(number):
        """What a dip in a step depends on, and its place as (step, contact)."""
        step, contact = number // values.shape[2], number % values.shape[2]
        arc = jax.tree.map(lambda a: take_row(a, step), steps)
        return (dynamics, phase_schedule, duration, arc, take_row(motion.w_begin, step)), step, contact

    def find(number):
        """How low a dip goes, and where."""
        inputs, step, contact = stop_gradient(at(number))
        seat, reach = (
            jnp.argmin(take_row(take_row(values, step).T, contact)) / (SAMPLES_PER_STEP - 1),
            1.0 / (SAMPLES_PER_STEP - 1),
        )
        low, high = jnp.maximum(seat - reach, 0.0), jnp.minimum(seat + reach, 1.0)
        xi = _golden_section(lambda xi: take_row(slacks_at(*inputs[:4], xi), contact), low, high)
        return _refine_minimum(inputs, options, contact, xi, low, high)

    numbers = _lowest_samples(_candidate_minima(values).ravel(), MAX_REFINED)
    least, places = stop_gradient(jax.vmap(find)(numbers))
    best = jnp.argmin(least)
    inputs, _, contact = at(take_row(numbers, best))
    xi = take_row(places, best)
    margin = _with_envelope_derivative(inputs, options, contact, xi, take_row(least, best))
    phase_time, s, _ = evaluate_dense(inputs[3], xi)
    lost, lost_contact = _first_loss(*stop_gradient((dynamics, phase_schedule, duration, steps)), values)
    between = (margin < 0) & ~jnp.isfinite(lost)  # a dip that no sample shows
    lost = jnp.where(between, stop_gradient(phase_time), lost)
    lost_contact = jnp.where(between, contact, lost_contact)
    return MarginResult(margin, phase_time, s, contact, lost, lost_contact)


def _sample(dynamics, phase_schedule, duration, steps: DenseOutput, count) -> Float[Array, "steps samples rows"]:
    """`sampled_slacks` of the first `count` steps, few at a time: there is room for many more."""
    rows = steps.live.shape[0]
    few = min(FEW_CANDIDATES, rows)

    def sample(k, values):
        first = jnp.minimum(k * few, rows - few)
        block = jax.tree.map(lambda a: jax.lax.dynamic_slice_in_dim(a, first, few), steps)
        fresh = sampled_slacks(dynamics, phase_schedule, duration, block)
        return jax.lax.dynamic_update_slice_in_dim(values, fresh, first, 0)

    none = jnp.full((rows, SAMPLES_PER_STEP, dynamics.tangential.shape[0]), jnp.inf, steps.quintic.dtype)
    return jax.lax.fori_loop(0, (count + few - 1) // few, sample, none)


def _lowest_samples(values: Float[Array, "n"], count: int) -> Int[Array, "count"]:
    """The numbers of the lowest values, one after the other: sorting them all takes longer."""

    def take(values, _):
        lowest = jnp.argmin(values)
        return values.at[lowest].set(jnp.inf), lowest

    return jax.lax.scan(take, stop_gradient(values), length=count)[1]


def log_barrier_minimum(values, weights, temperature: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    r"""The smooth loss's counterpart of `min values`: `phi = max_m [ m + T sum_i w_i log((values_i - m) / T) ]`.

    `T` is the temperature [N] and `w` non-negative weights; `m`, returned second, solves
    `sum_i T w_i / (values_i - m) = 1` and lies between `min - T sum(w)` and `min`. `phi` is concave in the values and
    its gradient `T w_i / (values_i - m)`
    sums to one. Entries of zero weight are left out.
    """
    live = stop_gradient(weights) > 0
    values = jnp.where(live, values, 0.0)
    fixed = stop_gradient(values)
    low = jnp.where(live, fixed, jnp.inf).min()
    heaviest = jnp.where(live & (fixed <= low), weights, 0.0).max()

    def step(at):
        m, _, count = at
        room = jnp.where(live, fixed - m, 1.0)
        over = temperature * (weights / room).sum() - 1.0
        move = over / (temperature * (weights / room**2).sum())
        return m - move, jnp.abs(move), count + 1

    def going(at):
        m, moved, count = at
        return (count < 40) & (moved > 4 * jnp.finfo(m.dtype).eps * (jnp.abs(m) + temperature))

    begin = stop_gradient(low - temperature * heaviest)
    m, *_ = jax.lax.while_loop(going, step, (begin, jnp.full_like(begin, jnp.inf), 0))
    m = stop_gradient(m)
    return m + temperature * (weights * jnp.log(jnp.where(live, values - m, 1.0) / temperature)).sum(), m


def _candidate_minima(values: Float[Array, "steps samples rows"]) -> Float[Array, "steps rows"]:
    """About how low each slack goes in each step: the least of its samples and of the parabola about it."""
    least, seat = values.min(1), jnp.clip(jnp.argmin(values, axis=1), 1, values.shape[1] - 2)
    before, here, after = (jnp.take_along_axis(values, (seat + k)[:, None], axis=1)[:, 0] for k in (-1, 0, 1))
    slope, bend = (after - before) / 2, before - 2 * here + after
    vertex = jnp.clip(-slope / jnp.where(bend > 0, bend, jnp.inf), -1.0, 1.0)
    lowest = here + vertex * (slope + vertex * bend / 2)
    return jnp.where(jnp.isfinite(least), jnp.minimum(least, lowest), jnp.inf)


def _refine_minimum(inputs, options: IntegratorOptions, contact, xi, low, high):
    """A constraint's least slack about `xi` of a step of the true motion, and where in `[low, high]` that is.

    To second order: the value and slope where a step of the solver ends at `xi`, the second derivative that of the
    quintic. The derivative, the place held, is that at the true minimum.
    """
    dynamics, phase_schedule, duration, arc, w_begin = inputs
    width = arc.phase_time[1] - arc.phase_time[0]
    phase_time, begin = arc.phase_time[0] + xi * width, jnp.stack([arc.quintic[0], w_begin])
    s, w = solver_step(
        dynamics, phase_schedule, duration, options, arc.segment, arc.row, arc.phase_time[0], begin, xi * width
    )

    def at(phase_time, s, w):
        return take_row(
            force_slack(
                dynamics, contact_force(dynamics, phase_schedule, duration, arc.segment, arc.row, phase_time, s, w)
            ),
            contact,
        )

    bend = path_acceleration(dynamics, phase_schedule, duration, arc.segment, arc.row, phase_time, s, w)
    value, slope = jax.jvp(at, (phase_time, s, w), (jnp.ones_like(phase_time), w, bend))
    wide = jnp.where(width > 0, width, 1.0)
    curve = (
        _second_derivative(lambda xi: take_row(slacks_at(dynamics, phase_schedule, duration, arc, xi), contact), xi)
        / wide**2
    )
    inner = (xi > 0) & (xi < 1) & (curve > 0)
    better = jnp.clip(xi - jnp.where(inner, slope / jnp.where(inner, curve, 1.0) / wide, 0.0), low, high)
    way = stop_gradient((better - xi) * width)
    least = value + slope * way + stop_gradient(curve) * way**2 / 2
    return jnp.where(arc.live & ~arc.at_rest, least, jnp.inf), better


@eqx.filter_custom_jvp
def _with_envelope_derivative(inputs, options, contact, xi, least):
    """The `plan_margin` slack that was found at `xi`, with the derivatives of `_refine_minimum`."""
    return least


@_with_envelope_derivative.def_jvp
def _(primals, tangents):
    (inputs, options, contact, xi, least), (change, *_) = primals, tangents
    _, rate = eqx.filter_jvp(
        lambda inputs: _refine_minimum(inputs, options, contact, xi, 0.0, 1.0)[0], (inputs,), (change,)
    )
    return least, rate


def _second_derivative(function, x):
    """The second derivative."""
    along = jnp.ones_like(x)
    return jax.jvp(lambda x: jax.jvp(function, (x,), (along,))[1], (x,), (along,))[1]


def _golden_section(function, low, high):
    """About the least point of `function` in `[low, high]`, by golden section.

    A bracket's end counts where it is lower.
    """
    golden = (math.sqrt(5) - 1) / 2

    def narrow(k, state):
        """Both ends first, then the two inner points; each round keeps the part that holds the lower one."""
        low, high, best, least = state
        width = high - low
        points = jnp.where(k == 0, jnp.stack([low, high]), jnp.stack([high - golden * width, low + golden * width]))
        values = jax.vmap(function)(points)
        lower = jnp.argmin(values)
        better = values[lower] < least
        low = jnp.where((k > 0) & (lower == 1), points[0], low)
        high = jnp.where((k > 0) & (lower == 0), points[1], high)
        return low, high, jnp.where(better, points[lower], best), jnp.minimum(values[lower], least)

    start = (low, high, low, jnp.full_like(low, jnp.inf))
    return stop_gradient(jax.lax.fori_loop(0, GOLDEN_ITERATIONS, narrow, start)[2])


def _first_loss(dynamics, phase_schedule, duration, steps, values):
    """The share at which a contact's slack first turns negative, by bisection from the first sample that is."""
    negative = (values < 0).any(2)  # their least would go to a library of XLA's, with threads of its own
    first = jnp.argmax(negative.ravel())
    step, sample = first // SAMPLES_PER_STEP, first % SAMPLES_PER_STEP
    arc = jax.tree.map(lambda a: take_row(a, step), steps)
    width = 1.0 / (SAMPLES_PER_STEP - 1)
    high = sample * width

    def halve(_, bracket):
        low, high, contact = bracket
        middle = (low + high) / 2
        slacks = slacks_at(dynamics, phase_schedule, duration, arc, middle)
        gone = slacks.min() < 0
        contact = jnp.where(gone, jnp.argmin(slacks), contact)
        return jnp.where(gone, low, middle), jnp.where(gone, middle, high), contact

    bracket = (jnp.maximum(high - width, 0.0), high, jnp.argmin(values[step, sample]))
    _, xi, contact = jax.lax.fori_loop(0, jnp.where(jnp.any(negative), 50, 0), halve, bracket)
    phase_time = evaluate_dense(arc, xi)[0]
    return jnp.where(jnp.any(negative), phase_time, jnp.inf), contact
