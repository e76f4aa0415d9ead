r"""March: follow the curve `z(s)` of a formation in short steps until something ends it, and remember the nodes.

Each step predicts the next node by the cubic through the last two and their tangents, and corrects it by Newton's
method on the C-functions in the plane `u . z = s`, `u` being the chart's direction. What is seen on the way: what ends
the wire (`rest_margin`), slips and joint speeds (each reversal is a kink), and the sign of `det [G; x]`, which changes
where
two wires meet.

Derivation: section 3 of `docs/derivation.md`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.core import Status, eps_power, fused_matmul, inverse_and_determinant, null_vector, set_row
from wholearm_jax.model import PathTarget, ScaledMechanics, constraint_jacobian, constraints, slip_velocity
from wholearm_jax.tracing.events import EventFunctions, EventValues, detect_events, event_functions

MAX_CONTINUATION_STEP, BRACKET_STEP = 0.06, 2e-3  # march steps, and the step at which an end counts as bracketed
MAX_CHARTS = 8  # directions that a wire may be charted by, one after the other


def oriented_tangent(mechanics: ScaledMechanics, z, hint):
    """The unit tangent `x` on the side of `hint`, and `det [G; x]`: the product of singular values, which changes sign
    where wires meet."""
    across = null_vector(constraint_jacobian(mechanics.contacts, z))
    size = jnp.sqrt((across**2).sum()) * jnp.where(across @ hint < 0, -1.0, 1.0)
    return across / size, size


def reversal_functions(mechanics: ScaledMechanics, z, x):
    """What reverses at kinks: the slips of the contacts and the joints' speeds."""
    return jnp.concatenate([slip_velocity(mechanics.contacts, z, x), x[3:]])


def sign_with_deadband(values, tolerance):
    """Signs, 0 for what is no larger than `tolerance`."""
    return jnp.where(jnp.abs(values) > tolerance, jnp.sign(values), 0.0)


class Node(NamedTuple):
    """A place on the way: `z`, its tangent `x`, where along the wire, and the number of the chart that led to it.

    `orientation` is `det [G; x]`; `sign_changed` says what reverses or turns on the way to it from the node before
    (`reversal_functions`, then the chart), at what `change_fraction` of that way.
    """

    z: Float[Array, "*nodes 5"]
    x: Float[Array, "*nodes 5"]
    s: Float[Array, "*nodes"]
    sign_changed: Bool[Array, "*nodes 7"]
    change_fraction: Float[Array, "*nodes 7"]
    orientation: Float[Array, "*nodes"]
    chart: Int[Array, "*nodes"]


class Chart(NamedTuple):
    """What `s` is along: a direction, and the place where it begins."""

    direction: Float[Array, "*charts 5"]
    anchor: Float[Array, "*charts 5"]
    anchor_s: Float[Array, "*charts"]


class TracedCurve(NamedTuple):
    """Nodes along the wire: `n` of them, in charts of which each has its number; the last is where the end was
    bracketed. Rows beyond `n` have an infinite `s`.

    `end` is the row of what is `EventValues` that ends the wire (-1: none), about at `end_z`.
    """

    n: Int[Array, ""]
    nodes: Node
    charts: Chart
    end: Int[Array, ""]
    end_z: Float[Array, "5"]
    status: Int[Array, ""]


class _ContinuationState(NamedTuple):
    """A march on its way, its `nodes` and `charts` so far with one row more, for what is not kept.

    `last` is the last node within the wire, `earlier` the one before it, `chart` the last one; kept beside the rows,
    which are only ever written: what is read as well would be copied in each step. `near` says that the last try came
    past the end of the wire: the next one stops just short of it, and the one after that goes over it. `speeds` are
    those of the last node, `sense` the signs that they had last. `before` is what is watched at the last node,
    `limit_violations`
    at the last one tried.
    """

    n: Int[Array, ""]
    step: Float[Array, ""]
    near: Bool[Array, ""]
    last: Node
    earlier: Node
    number: Int[Array, ""]
    chart: Chart
    nodes: Node
    charts: Chart
    speeds: Float[Array, "6"]
    sense: Float[Array, "6"]
    before: EventValues
    beyond: EventValues
    tried: Node
    status: Int[Array, ""]
    done: Bool[Array, ""]


def trace_curve(
    mechanics: ScaledMechanics, target: PathTarget, z: Float[Array, "5"], x: Float[Array, "5"], capacity: int
) -> TracedCurve:
    """Follow a wire from `z` along its unit tangent `x` to its end: `max_steps` if `capacity` nodes do not reach it."""
    events, tolerance = event_functions(mechanics, target, z), eps_power(z, 5 / 8)

    def step(way: _ContinuationState) -> _ContinuationState:
        return _step(mechanics, events, tolerance, capacity, way)

    way = jax.lax.while_loop(lambda way: ~way.done, step, _initial_state(z, x, events, capacity))
    return _bracket_end(events, way, tolerance)


def _initial_state(z, x, events: EventFunctions, capacity: int) -> _ContinuationState:
    """A march that has no node yet. Its first step has no length: it looks about at the start."""

    def rows(number, row):
        return jax.tree.map(lambda a: jnp.broadcast_to(a, (number, *a.shape)), row)

    zero, whole, none, still = jnp.zeros((), z.dtype), jnp.asarray(0, int), jnp.zeros(6, z.dtype), 0 * events.shift
    nothing = EventValues(still - jnp.inf, still, still)
    start = Node(z, x, zero, jnp.zeros(7, bool), jnp.zeros(7, z.dtype), zero, whole)
    chart = Chart(x, z, zero)
    return _ContinuationState(
        n=whole,
        step=zero,
        near=jnp.asarray(False),
        last=start,
        earlier=start,
        number=whole,
        chart=chart,
        nodes=set_row(rows(capacity + 1, start._replace(s=zero + jnp.inf)), whole, start),
        charts=rows(MAX_CHARTS + 1, chart),
        speeds=none,
        sense=none,
        before=nothing,
        beyond=nothing,
        tried=start,
        status=whole,
        done=jnp.asarray(False),
    )


def _step(
    mechanics: ScaledMechanics, events: EventFunctions, tolerance, capacity: int, way: _ContinuationState
) -> _ContinuationState:
    """Try one step: keep its node, take a shorter one, or find that the wire ends within the shortest."""
    last, u = way.last, way.chart.direction
    height = u @ last.z + way.step
    z, moved, inverted, determinant = newton_corrector(mechanics, u, _hermite_predictor(way), height, 4, tolerance)
    size = jnp.sqrt((inverted[:, 4] ** 2).sum())
    x, orientation = inverted[:, 4] / size, determinant * size  # u = x / size + what the rows of G span
    event_values = events.at(z, x / (u @ x))
    good = (moved < tolerance) & (x @ last.x > 0.98) & jnp.all(jnp.isfinite(x))
    crossed, where = detect_events(events, way.before, event_values, way.step, tolerance)
    ends = good & jnp.any(crossed)
    bracketed = ends & (way.step <= BRACKET_STEP)
    accept = good & ~jnp.any(crossed)
    turn = accept & (u @ x < 0.6)
    number = way.number + turn
    speeds = reversal_functions(mechanics, z, x)
    sign = sign_with_deadband(speeds, tolerance)
    flips = sign * way.sense < 0
    share = jnp.where(flips, jnp.clip(way.speeds / jnp.where(flips, way.speeds - speeds, 1.0), 0.0, 1.0), 0.0)
    flips, share = jnp.append(flips, way.number != last.chart), jnp.append(share, 0.0)
    tried = Node(z, x, last.s + way.step, flips, share, orientation, way.number)
    chart = Chart(x, z, tried.s)
    before_end = way.step * jnp.where(crossed, where, 1.0).min() - BRACKET_STEP / 2
    before_end = jnp.maximum(jnp.where(way.near, way.step / 4, before_end), BRACKET_STEP)
    shorter = jnp.where(ends, before_end, way.step / 2)
    longer = jnp.where(way.n > 0, jnp.minimum(way.step * 1.5, MAX_CONTINUATION_STEP), MAX_CONTINUATION_STEP)
    lost = ~good & (way.step < 1e-6)
    full = (way.n + 1 >= capacity) | (number >= MAX_CHARTS)
    in_chart = event_values._replace(rates=event_values.rates * jnp.where(turn, u @ x, 1.0))

    def kept(wanted, new, old):
        return jax.tree.map(lambda a, b: jnp.where(wanted, a, b), new, old)

    return _ContinuationState(
        n=way.n + (accept | bracketed),
        step=jnp.where(accept, jnp.where(way.near, BRACKET_STEP, longer), shorter),
        near=ends,
        last=kept(accept, tried, last),
        earlier=kept(accept, last, way.earlier),
        number=number,
        chart=kept(turn, chart, way.chart),
        nodes=set_row(way.nodes, jnp.where(accept | bracketed, way.n, capacity), tried),
        charts=set_row(way.charts, jnp.where(turn, number, MAX_CHARTS), chart),
        speeds=jnp.where(accept, speeds, way.speeds),
        sense=jnp.where(accept & (sign != 0), sign, way.sense),
        before=kept(accept, in_chart, way.before),
        beyond=event_values,
        tried=tried,
        status=jnp.select([lost, full & ~bracketed], [int(Status.SINGULAR), int(Status.MAX_STEPS)], 0),
        done=bracketed | lost | full,
    )


def _hermite_predictor(way: _ContinuationState):
    """The next node, by the cubic through the last two nodes and their tangents; the first by its tangent alone."""
    u, last, before = way.chart.direction, way.last, way.earlier
    slope, slope_before = last.x / (u @ last.x), before.x / (u @ before.x)
    width = jnp.where(way.n > 1, u @ (last.z - before.z), 1.0)
    mean = jnp.where(way.n > 1, (last.z - before.z) / width, slope)
    t = way.step / width
    bend = (2 * slope + slope_before - 3 * mean) + (slope + slope_before - 2 * mean) * t
    return last.z + way.step * (slope + bend * t)


def _bracket_end(events: EventFunctions, way: _ContinuationState, tolerance) -> TracedCurve:
    """What ends the wire first between the last node within it and the last that was tried, and about where."""
    last, tried = way.last, way.tried
    step = jnp.where(way.status == 0, tried.s - last.s, 1.0)
    crossed, where = detect_events(events, way.before, way.beyond, step, tolerance)
    first = jnp.argmin(jnp.where(crossed, where, jnp.inf))
    found = (way.status == 0) & jnp.any(crossed)
    start = way.nodes.z[0]
    return TracedCurve(
        n=way.n,
        nodes=jax.tree.map(lambda rows: rows[:-1], way.nodes),
        charts=jax.tree.map(lambda rows: rows[:-1], way.charts),
        end=jnp.where(found, first, -1),
        end_z=jnp.where(found, last.z + (tried.z - last.z) * where[first], start),
        status=way.status,
    )


def newton_corrector(mechanics: ScaledMechanics, u, z, height, steps: int, enough: ArrayLike = 0.0):
    """Newton in the chart, until a step is no larger than `enough`: the place of the wire on the plane `u.z = height`.

    Beside it the last step's size, and `[G; u]^-1` and its determinant before that step.
    """

    def once(state):
        z, count, *_ = state
        inverted, determinant = inverse_and_determinant(
            jnp.concatenate([constraint_jacobian(mechanics.contacts, z), u[None]])
        )
        left = jnp.concatenate([constraints(mechanics.contacts, z), (u @ z - height)[None]])
        move = fused_matmul(inverted, left)
        return z - move, count + 1, jnp.abs(move).max(), inverted, determinant

    def going(state):
        _, count, moved, *_ = state
        return (count < steps) & (moved > enough)

    far, eye = jnp.asarray(jnp.inf, z.dtype), jnp.eye(5, dtype=z.dtype)
    start = (z, jnp.asarray(0, int), far, eye, jnp.ones((), z.dtype))
    z, _, moved, inverted, determinant = jax.lax.while_loop(going, once, start)
    return z, jnp.where(jnp.isfinite(moved), moved, jnp.inf), inverted, determinant
