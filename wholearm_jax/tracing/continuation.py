r"""Predictor-corrector continuation: follow the curve `z(s)` of a formation in short steps to its end.

Each step predicts the next node by the cubic through the last two nodes and their tangents, corrects it by Newton's
method in the plane `u . z = s`, `u` being the chart's direction, and detects events: the terminal ones
(`EventFunctions`), reversals of slips and joint speeds (kinks), and sign changes of `det [G; x]` (bifurcations). A step
over the end is repeated to just short of it, and then over it with the step `BRACKET_STEP`.

Derivation: section 3 of `docs/derivation.md`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.core import Status, eps_power, set_row
from wholearm_jax.model import ScaledMechanics
from wholearm_jax.tracing.curve import Chart, Node, TracedCurve, reversal_functions, sign_with_deadband
from wholearm_jax.tracing.events import EventFunctions, EventValues, detect_events, first_event
from wholearm_jax.tracing.path_root import newton_corrector

MAX_CONTINUATION_STEP = 0.06  # [object radii or radians]
BRACKET_STEP = 2e-3  # step over an end with which the end counts as bracketed
MIN_CONTINUATION_STEP = 1e-6  # shorter steps that fail are not halved again
MAX_CHARTS = 8


class _ContinuationState(NamedTuple):
    """Loop state.

    `nodes` and `charts` are write-only buffers with one scratch row for rejected steps; `last`, `earlier` and `chart`
    mirror their newest rows, because reading a buffer would make XLA copy it every step.
    """

    # the curve so far
    n: Int[Array, ""]  # number of nodes
    nodes: Node
    charts: Chart
    # the next step
    step: Float[Array, ""]
    near_end: Bool[Array, ""]  # the last trial overshot the end: the next one stops just short of it
    # the last accepted nodes
    last: Node
    earlier: Node
    chart_number: Int[Array, ""]
    chart: Chart
    reversals: Float[Array, "6"]  # `reversal_functions` at the last node
    signs: Float[Array, "6"]  # their last signs other than 0
    events: EventValues
    # the last trial
    trial: Node
    trial_events: EventValues
    # termination
    status: Int[Array, ""]
    done: Bool[Array, ""]


class _Trial(NamedTuple):
    """An attempted step."""

    node: Node
    alignment: Float[Array, ""]  # u . x
    reversals: Float[Array, "6"]
    signs: Float[Array, "6"]
    events: EventValues
    crossed: Bool[Array, "rows"]  # terminal events within the step
    fraction: Float[Array, "rows"]  # of the step, where they are
    converged: Bool[Array, ""]


class _Outcome(NamedTuple):
    """The classification of a trial."""

    accepted: Bool[Array, ""]  # within the path
    overshot: Bool[Array, ""]  # a terminal event lies within the step
    bracketed: Bool[Array, ""]  # and the step is short enough to end with
    new_chart: Bool[Array, ""]  # the curve turns away from the chart's direction
    chart_number: Int[Array, ""]
    lost: Bool[Array, ""]  # no step is short enough to converge
    full: Bool[Array, ""]  # no room for more nodes or charts


def trace_curve(
    mechanics: ScaledMechanics, events: EventFunctions, z: Float[Array, "5"], x: Float[Array, "5"], max_nodes: int
) -> TracedCurve:
    """Follow a formation's curve from `z` along its unit tangent `x` to its end.

    Args:
        mechanics: the formation in object units.
        events: what ends the path (`event_functions`).
        z: a configuration on the curve (5,).
        x: the unit tangent there (5,).
        max_nodes: if so many nodes do not reach the end, the status is `max_steps`.
    """
    tolerance = eps_power(z, 5 / 8)

    def step(state: _ContinuationState) -> _ContinuationState:
        trial = _try_step(mechanics, events, tolerance, state)
        outcome = _classify(trial, state, max_nodes)
        return _record(trial, outcome, state, max_nodes)

    state = jax.lax.while_loop(lambda state: ~state.done, step, _initial_state(z, x, events, max_nodes))
    return _bracket_end(events, state, tolerance)


def _initial_state(z, x, events: EventFunctions, max_nodes: int) -> _ContinuationState:
    """Return a state without any node. Its first step has length zero and evaluates the events at the start."""

    def rows(number, row):
        return jax.tree.map(lambda a: jnp.broadcast_to(a, (number, *a.shape)), row)

    zero, whole, six, no_rates = jnp.zeros((), z.dtype), jnp.asarray(0, int), jnp.zeros(6, z.dtype), 0 * events.shift
    nothing = EventValues(no_rates - jnp.inf, no_rates, no_rates)
    start = Node(z, x, zero, jnp.zeros(7, bool), jnp.zeros(7, z.dtype), zero, whole)
    chart = Chart(x, z, zero)
    return _ContinuationState(
        n=whole,
        nodes=set_row(rows(max_nodes + 1, start._replace(s=zero + jnp.inf)), whole, start),
        charts=rows(MAX_CHARTS + 1, chart),
        step=zero,
        near_end=jnp.asarray(False),
        last=start,
        earlier=start,
        chart_number=whole,
        chart=chart,
        reversals=six,
        signs=six,
        events=nothing,
        trial=start,
        trial_events=nothing,
        status=whole,
        done=jnp.asarray(False),
    )


def _try_step(mechanics: ScaledMechanics, events: EventFunctions, tolerance, state: _ContinuationState) -> _Trial:
    """Predict and correct the next node, and detect events and reversals on the way to it."""
    # Predict and correct. The tangent is the last column of the corrector's inverse: u = x / size + rows of G.
    last, u = state.last, state.chart.direction
    height = u @ last.z + state.step
    z, correction, inverse, determinant = newton_corrector(
        mechanics, u, _hermite_predictor(state), height, 4, tolerance
    )
    size = jnp.sqrt((inverse[:, 4] ** 2).sum())
    x, orientation = inverse[:, 4] / size, determinant * size
    # Detect terminal events.
    event_values = events.at(z, x / (u @ x))
    converged = (correction < tolerance) & (x @ last.x > 0.98) & jnp.all(jnp.isfinite(x))
    crossed, fraction = detect_events(events, state.events, event_values, state.step, tolerance)
    # Detect reversals, and where they are by linear interpolation.
    reversals = reversal_functions(mechanics, z, x)
    signs = sign_with_deadband(reversals, tolerance)
    changed = signs * state.signs < 0
    at = jnp.where(
        changed, jnp.clip(state.reversals / jnp.where(changed, state.reversals - reversals, 1.0), 0.0, 1.0), 0.0
    )
    changed, at = jnp.append(changed, state.chart_number != last.chart), jnp.append(at, 0.0)
    node = Node(z, x, last.s + state.step, changed, at, orientation, state.chart_number)
    return _Trial(node, u @ x, reversals, signs, event_values, crossed, fraction, converged)


def _classify(trial: _Trial, state: _ContinuationState, max_nodes: int) -> _Outcome:
    """Decide whether a trial is accepted, brackets the end, or is to be repeated with a shorter step."""
    crosses = jnp.any(trial.crossed)
    overshot, accepted = trial.converged & crosses, trial.converged & ~crosses
    new_chart = accepted & (trial.alignment < 0.6)
    chart_number = state.chart_number + new_chart
    return _Outcome(
        accepted=accepted,
        overshot=overshot,
        bracketed=overshot & (state.step <= BRACKET_STEP),
        new_chart=new_chart,
        chart_number=chart_number,
        lost=~trial.converged & (state.step < MIN_CONTINUATION_STEP),
        full=(state.n + 1 >= max_nodes) | (chart_number >= MAX_CHARTS),
    )


def _next_step(trial: _Trial, outcome: _Outcome, state: _ContinuationState) -> Float[Array, ""]:
    """Choose the next step: longer after success, halved after failure, to just short of an end or over it."""
    short_of_end = state.step * jnp.where(trial.crossed, trial.fraction, 1.0).min() - BRACKET_STEP / 2
    short_of_end = jnp.maximum(jnp.where(state.near_end, state.step / 4, short_of_end), BRACKET_STEP)
    shorter = jnp.where(outcome.overshot, short_of_end, state.step / 2)
    longer = jnp.where(state.n > 0, jnp.minimum(state.step * 1.5, MAX_CONTINUATION_STEP), MAX_CONTINUATION_STEP)
    return jnp.where(outcome.accepted, jnp.where(state.near_end, BRACKET_STEP, longer), shorter)


def _record(trial: _Trial, outcome: _Outcome, state: _ContinuationState, max_nodes: int) -> _ContinuationState:
    """Update the state: keep the node of an accepted trial, or of one that brackets the end."""

    def choose(condition, new, old):
        return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)

    accepted, kept = outcome.accepted, outcome.accepted | outcome.bracketed
    chart = Chart(trial.node.x, trial.node.z, trial.node.s)
    # Rates are d/ds: a new chart measures s along x instead of u.
    rates = trial.events.rates * jnp.where(outcome.new_chart, trial.alignment, 1.0)
    statuses = [int(Status.SINGULAR), int(Status.MAX_STEPS)]
    return _ContinuationState(
        n=state.n + kept,
        nodes=set_row(state.nodes, jnp.where(kept, state.n, max_nodes), trial.node),
        charts=set_row(state.charts, jnp.where(outcome.new_chart, outcome.chart_number, MAX_CHARTS), chart),
        step=_next_step(trial, outcome, state),
        near_end=outcome.overshot,
        last=choose(accepted, trial.node, state.last),
        earlier=choose(accepted, state.last, state.earlier),
        chart_number=outcome.chart_number,
        chart=choose(outcome.new_chart, chart, state.chart),
        reversals=jnp.where(accepted, trial.reversals, state.reversals),
        signs=jnp.where(accepted & (trial.signs != 0), trial.signs, state.signs),
        events=choose(accepted, trial.events._replace(rates=rates), state.events),
        trial=trial.node,
        trial_events=trial.events,
        status=jnp.select([outcome.lost, outcome.full & ~outcome.bracketed], statuses, 0),
        done=outcome.bracketed | outcome.lost | outcome.full,
    )


def _hermite_predictor(state: _ContinuationState) -> Float[Array, "5"]:
    """Extrapolate the cubic through the last two nodes and their tangents; from the first node, its tangent alone."""
    u, last, before = state.chart.direction, state.last, state.earlier
    slope, slope_before = last.x / (u @ last.x), before.x / (u @ before.x)
    width = jnp.where(state.n > 1, u @ (last.z - before.z), 1.0)
    mean = jnp.where(state.n > 1, (last.z - before.z) / width, slope)
    t = state.step / width
    bend = (2 * slope + slope_before - 3 * mean) + (slope + slope_before - 2 * mean) * t
    return last.z + state.step * (slope + bend * t)


def _bracket_end(events: EventFunctions, state: _ContinuationState, tolerance) -> TracedCurve:
    """Find the first terminal event between the last node within the path and the last trial, and about where it is."""
    last, trial = state.last, state.trial
    step = jnp.where(state.status == 0, trial.s - last.s, 1.0)
    crossed, fraction = detect_events(events, state.events, state.trial_events, step, tolerance)
    first = first_event(crossed, fraction)
    has_end = (state.status == 0) & jnp.any(crossed)
    start = state.nodes.z[0]
    return TracedCurve(
        n=state.n,
        nodes=jax.tree.map(lambda rows: rows[:-1], state.nodes),
        charts=jax.tree.map(lambda rows: rows[:-1], state.charts),
        end=jnp.where(has_end, first, -1),
        end_z=jnp.where(has_end, last.z + (trial.z - last.z) * fraction[first], start),
        status=state.status,
    )
