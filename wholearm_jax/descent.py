r"""Descend: torque knots of one phase, improved by gradient descent through the simulation.

The variables `p` are the torques at the knots, in units of the torque limit, and the logarithm of the duration. The
loss is minus the smooth margin (`forces.smooth_margin`) plus logarithmic barriers of the same temperature on torque,
rate and duration limits. Arrival at rest, `e(p) = (s(T) - s_end, w(T)) / length = 0`, is an equality constraint.

Descent is preconditioned: with `J` the derivatives of the sampled forces, `H = J^T phi'' J` (the Gauss-Newton metric of
the loss, plus the barriers' own) and `E = de/dp`, the direction solves

    [ H  E^T ] [ d ]     [ grad ]
    [ E   0  ] [ . ] = - [   e  ]

so that neither units, nor an unstable motion, nor the number of knots slows it. The direction is an optax gradient
transformation; any other optax optimiser may take its place (`projected`). A step counts only after its return to the
arrival, and is shortened until it lowers the loss there.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

from wholearm_jax.forces import arcs, on_arc, sampled_forces, smooth_margin
from wholearm_jax.motion import Integration, move
from wholearm_jax.reduction import Table
from wholearm_jax.schedule import Torque, window

SAMPLES = 4  # forces a step that the loss sees
ARRIVED = 1e-11  # arrival error, in wire lengths, below which a step counts as having arrived
RETURNS, CUTS, SHORTER = 8, 10, 0.4  # Newton steps back to the arrival, shortenings of a step, and by how much


class Limits(eqx.Module):
    """What the result must respect: torque rates [N m/s], durations [s], and which knots stay as they are."""

    rate: Float[Array, "2"]
    shortest: Float[Array, ""]
    longest: Float[Array, ""]
    pinned: Bool[Array, "knots"]


class Linear(NamedTuple):
    """The loss and the arrival at `p`, with their derivatives."""

    loss: Float[Array, ""]
    gradient: Float[Array, "p"]
    metric: Float[Array, "p p"]
    arrival: Float[Array, "2"]
    arrival_rows: Float[Array, "2 p"]


def pack(values: Float[Array, "knots 2"], duration: Float[Array, ""], table: Table) -> Float[Array, "p"]:
    """Torques at the knots and a duration as variables."""
    return jnp.concatenate([(values / table.torque_limit).ravel(), jnp.log(duration)[None]])


def unpack(p: Float[Array, "p"], table: Table) -> tuple[Torque, Float[Array, ""]]:
    """Variables as a schedule from time 0, knots evenly spaced, and a duration."""
    values = p[:-1].reshape(-1, 2) * table.torque_limit
    duration = jnp.exp(p[-1])
    return Torque(jnp.linspace(0.0, 1.0, values.shape[0]) * duration, values), duration


def observe(p, table: Table, how: Integration):
    """Sampled forces, their weights (shares of time), and the arrival error of the free motion under `p`."""
    schedule, duration = unpack(p, table)
    # Knots are fixed shares of the phase: only the torques and the duration carry derivatives.
    seen = window(schedule, jnp.zeros(()), duration)
    seen = eqx.tree_at(lambda w: w.share, seen, stop_gradient(seen.share))
    motion = move(table, seen, duration, how=how, free=True)
    steps = arcs(table, seen, duration, motion)
    forces = sampled_forces(table, seen, duration, steps, SAMPLES)
    width = stop_gradient(steps.share[:, 1] - steps.share[:, 0])
    weights = jnp.where((steps.live & ~steps.held)[:, None, None], width[:, None, None] / SAMPLES, 0.0)
    weights = jnp.broadcast_to(weights, forces.shape)
    share, _, pace = jax.vmap(jax.vmap(on_arc, (None, 0)), (0, None))(steps, jnp.linspace(0.0, 1.0, SAMPLES))
    pace = pace / table.length
    inside = (weights[..., 0] > 0) & (share > 1e-9) & (share < 1 - 1e-9)
    pace = jnp.where(inside, pace, 1.0)
    arrival = jnp.stack([motion.s[-1] - table.breaks[-1], motion.w[-1]]) / table.length
    return jnp.where(weights > 0, forces, 0.0), weights, pace, arrival


def barrier(p, table: Table, limits: Limits):
    """`-sum log` of the room within torque, rate and duration limits, each group weighing one."""
    values, duration = p[:-1].reshape(-1, 2), jnp.exp(p[-1])
    knots = values.shape[0]
    bounded = jnp.isfinite(limits.rate)
    step = jnp.where(bounded, limits.rate, 1.0) / table.torque_limit * duration / (knots - 1)
    climb = jnp.where(bounded, jnp.diff(values, axis=0) / step, 0.0)
    room = jnp.concatenate([1 - values**2, 1 - climb**2])
    span = jnp.log(limits.longest / limits.shortest)
    free = span > 0
    ends = jnp.stack([p[-1] - jnp.log(limits.shortest), jnp.log(limits.longest) - p[-1]]) / jnp.where(free, span, 1.0)
    ends = jnp.where(free, ends, 1.0)
    return -jnp.log(room).sum() / knots - jnp.log(ends).sum()


@eqx.filter_jit
def linearise(p, table: Table, limits: Limits, temperature, how: Integration) -> Linear:
    """Loss, gradient, Gauss-Newton metric and arrival at `p`, by forward mode through the simulation."""

    def both(p):
        forces, weights, pace, arrival = observe(p, table, how)
        return (forces, pace, arrival), (forces, weights, pace, arrival)

    (rows, pace_rows, arrival_rows), (forces, weights, pace, arrival) = jax.jacfwd(both, has_aux=True)(p)
    value, m = smooth_margin(forces, weights, temperature)
    room = jnp.where(weights > 0, forces - m, 1.0)
    share = (temperature * weights / room).ravel()
    curve = (temperature * weights / room**2).ravel()
    rows = rows.reshape(-1, p.shape[0])
    middle = curve @ rows
    metric = (rows * curve[:, None]).T @ rows - jnp.outer(middle, middle) / curve.sum()
    metric, pull_back, backward = _keep_moving(metric, pace, weights, pace_rows, temperature)
    wall, pull, bend = (
        barrier(p, table, limits),
        jax.grad(barrier)(p, table, limits),
        jax.hessian(barrier)(p, table, limits),
    )
    still = jnp.concatenate([jnp.repeat(limits.pinned, 2), (limits.longest <= limits.shortest)[None]])
    gradient = jnp.where(still, 0.0, -share @ rows + temperature * pull - pull_back)
    metric = jnp.where(still[:, None] | still[None], 0.0, metric + temperature * bend)
    metric = metric + jnp.diag(jnp.where(still, 1.0, 1e-9 * jnp.trace(metric) / p.shape[0]))
    return Linear(
        -value + temperature * wall + backward, gradient, metric, arrival, jnp.where(still, 0.0, arrival_rows)
    )


def _keep_moving(metric, pace, weights, rows, temperature):
    """Add the barrier `-T sum w log(speed)` to a metric; its gradient's negative and its value."""
    each = temperature * weights[..., 0]
    # A start may turn back: there the loss is infinite (see `merit`), and the gradient still has to point forward.
    backward = -(each * jnp.log(pace)).sum()
    pace = jnp.maximum(pace, 1e-3)
    rows = rows.reshape(-1, rows.shape[-1])
    pull = (each / pace).ravel()
    return metric + (rows * (each / pace**2).ravel()[:, None]).T @ rows, pull @ rows, backward


def merit(p, table: Table, limits: Limits, temperature, how: Integration):
    """The loss and the arrival error of `p`; the loss is infinite outside the limits or where the motion turns back."""
    forces, weights, pace, arrival = observe(p, table, how)
    value, _ = smooth_margin(forces, weights, temperature)
    backward = -(weights[..., 0] * jnp.log(pace)).sum()
    total = -value + temperature * (barrier(p, table, limits) + backward)
    allowed = jnp.all(jnp.abs(p[:-1]) < 1) & jnp.isfinite(total)
    return jnp.where(allowed, total, jnp.inf), arrival


def preconditioned() -> optax.GradientTransformationExtraArgs:
    """The preconditioned, arrival-keeping descent direction as an optax transformation; wants `linear=`."""

    def update(updates, state, params=None, *, linear: Linear, **_):
        n = updates.shape[0]
        top = jnp.concatenate([linear.metric, linear.arrival_rows.T], axis=1)
        bottom = jnp.concatenate([linear.arrival_rows, jnp.zeros((2, 2), top.dtype)], axis=1)
        right = jnp.concatenate([updates, linear.arrival])
        return -jnp.linalg.solve(jnp.concatenate([top, bottom]), right)[:n], state

    return optax.GradientTransformationExtraArgs(lambda params: optax.EmptyState(), update)  # pyright: ignore[reportArgumentType]


def projected(optimiser: optax.GradientTransformation) -> optax.GradientTransformationExtraArgs:
    """Any optax optimiser, its updates projected onto the arrival's tangent, with a least step back to it."""
    optimiser = optax.with_extra_args_support(optimiser)

    def update(updates, state, params=None, *, linear: Linear, **extra):
        rows = linear.arrival_rows
        updates, state = optimiser.update(updates, state, params, **extra)
        back = rows.T @ jnp.linalg.solve(rows @ rows.T, rows @ jnp.asarray(updates) + linear.arrival)
        return updates - back, state

    return optax.GradientTransformationExtraArgs(optimiser.init, update)  # pyright: ignore[reportArgumentType]


class Advance(NamedTuple):
    """A step taken: the new variables, the optimiser's state, the decrease of the loss that the gradient promised, and
    the share of the direction that was taken (0: none lowered the loss)."""

    p: Float[Array, "p"]
    state: optax.OptState
    promised: Float[Array, ""]
    taken: Float[Array, ""]


@eqx.filter_jit
def advance(
    p, state, linear: Linear, table: Table, limits: Limits, temperature, how: Integration, optimiser, first
) -> Advance:
    """One step of an optax optimiser, shortened until it lowers the loss after its return to the arrival.

    `first` is the share of the direction to try first. The return is Newton's method on the arrival error with the rows
    of `linear`, by least changes in its metric.
    """
    way, state = optimiser.update(linear.gradient, state, p, linear=linear)
    rows = linear.arrival_rows
    spread = jnp.linalg.solve(linear.metric, rows.T)
    back = spread @ jnp.linalg.inv(rows @ spread)
    promised = -linear.gradient @ way
    largest = jnp.abs(way[:-1]).max()
    whole = jnp.minimum(first, 1.0 / jnp.maximum(largest, 1e-30))

    # Where the start is off its arrival or outside the limits, its loss is no measure for the first step.
    held = jnp.isfinite(linear.loss)
    comparable = jnp.abs(linear.arrival).max() < 1e-6

    def step(search):
        q, share, returns, cuts, _ = search
        loss, error = merit(q, table, limits, temperature, how)
        size = jnp.abs(error).max()
        arrived = size < ARRIVED
        lower = jnp.isfinite(loss) & ((loss <= linear.loss + 1e-9 * jnp.abs(linear.loss)) | ~comparable) | ~held
        lost = ~jnp.isfinite(size) | (size > 1.0) | (returns >= RETURNS) | (arrived & ~lower)
        shorter = share * SHORTER
        nearer = q - back @ error
        return (
            jnp.where(arrived & lower, q, jnp.where(lost, p + shorter * way, nearer)),
            jnp.where(lost, shorter, share),
            jnp.where(lost, 0, returns + 1),
            cuts + lost,
            arrived & lower,
        )

    begin = (p + whole * way, whole, jnp.asarray(0), jnp.asarray(0), jnp.asarray(False))
    q, share, _, _, done = jax.lax.while_loop(lambda s: ~s[4] & (s[3] < CUTS), step, begin)
    return Advance(jnp.where(done, q, p), state, promised, jnp.where(done, share, 0.0))
