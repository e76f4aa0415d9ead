r"""Simulate: one phase as a scalar second-order ODE along its wire, integrated by diffrax.

Time runs as a share `u` of the phase's duration `T`, and `w = v T` is the speed in `s` per duration, so that steps and
tolerances mean the same for every size and duration:

    ds/du = w,    dw/du = T^2 (A0 + A3 tau1 + A4 tau2) + T A2 w + A1 w^2

with the coefficients of `reduction.Table`. A phase is a sequence of smooth stages. Each stage is one `diffeqsolve`
whose steps end on the torque's knots; it stops at the first step that leaves the piece or turns the speed negative.
That step is then taken again with the length that lands exactly on the piece's end, or on rest, so that the method
keeps its order across slip reversals and the landing carries its own derivatives.

At rest, with friction, the object starts forward when the acceleration with forward signs is positive, backward when
the one with backward signs is negative, and stays when neither is; both at once is ambiguous (Painleve).

Derivation: section 6 of `docs/derivation.md`.
"""

from collections.abc import Callable
from typing import NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.reduction import Table, horner, powers
from wholearm_jax.schedule import Window, interval, torque_in
from wholearm_jax.status import Status

LANDINGS = 40  # at most so many Newton steps, or halvings, to the place where a stage ends
ADJOINTS = {
    "none": dfx.DirectAdjoint(),
    "both": dfx.DirectAdjoint(),  # forward and reverse mode
    "forward": dfx.ForwardMode(),
    "reverse": dfx.RecursiveCheckpointAdjoint(),
}


class Integration(eqx.Module):
    """How to integrate: diffrax solver, error `tolerance` a step (relative, of the wire's scale), limits, adjoint.

    `steps` says that the torque schedule has steps inside the phase. `adjoint` says what the solve will be
    differentiated by: `"none"`, `"forward"`, `"reverse"` or `"both"`. Where reverse mode is wanted, the steps are found
    once by the adaptive controller and taken again as they are: differentiating saved steps through rejected ones in
    reverse mode gives wrong derivatives (seen with diffrax 0.7.2), and the repetition has none. All but a `tolerance`
    that is an array is static: each choice is a program of its own.
    """

    solver: dfx.AbstractSolver = eqx.field(static=True, default=dfx.Dopri8())
    tolerance: float | Float[Array, ""] = 1e-10
    max_steps: int = eqx.field(static=True, default=256)
    stages: int = eqx.field(static=True, default=8)
    steps: bool = eqx.field(static=True, default=False)
    adjoint: str = eqx.field(static=True, default="none")


class Motion(eqx.Module):
    """The accepted steps of a phase, `count` of them: from node `i` to node `i + 1` in time, `s` and `w`.

    Step `i` lies in piece `piece[i]` and torque interval `row[i]`; `held[i]` marks waiting at rest. `share` is time in
    durations. Rows beyond `count` repeat the end. `status` is that of the end alone: `ok` (end of time while moving),
    `left_formation` (the wire's end), `stuck`, `reversed`, `ambiguous` or `max_steps`.
    """

    share: Float[Array, "nodes"]
    s: Float[Array, "nodes"]
    w: Float[Array, "nodes"]
    entry_w: Float[Array, "steps"]
    piece: Int[Array, "steps"]
    row: Int[Array, "steps"]
    held: Bool[Array, "steps"]
    count: Int[Array, ""]
    status: Int[Array, ""]


class _FirstStep(dfx.AbstractAdaptiveStepSizeController):
    """A controller whose first step is a 32nd of the phase, or half of the way to the piece's end at its speed.

    diffrax would check a first step passed to `diffeqsolve` by a host callback, and programs that call back to the
    host are not kept in JAX's compilation cache.
    """

    controller: dfx.PIDController
    way: Float[Array, ""]
    rtol: float
    atol: float
    norm: Callable

    def wrap(self, direction):
        inner = self.controller.wrap(direction)
        return _FirstStep(controller=inner, way=self.way, rtol=self.rtol, atol=self.atol, norm=self.norm)

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        speed = stop_gradient(y0[1])
        half = jnp.where(speed > 0, self.way / jnp.where(speed > 0, 2 * speed, 1.0), 1.0)
        first = jnp.clip(half, jnp.finfo(half.dtype).eps, 1 / 32)
        return self.controller.init(terms, t0, t1, y0, first, args, func, error_order)

    def adapt_step_size(self, *at):
        return self.controller.adapt_step_size(*at)


class _Repeat(dfx.AbstractStepSizeController):
    """Takes given steps and rejects none: step `i` ends at `ends[i]`, the next begins at `begins[i]`.

    With `jumps` the field may jump between steps: what the last stage of one found serves no longer for the next.
    """

    ends: Float[Array, "steps"]
    begins: Float[Array, "steps"]
    jumps: bool = eqx.field(static=True)

    def wrap(self, direction):
        return self

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        return self.ends[0], jnp.asarray(1)

    def adapt_step_size(self, t0, t1, y0, y1, args, y_error, error_order, state):
        following = self.ends[jnp.minimum(state, self.ends.shape[0] - 1)]
        jumped = jnp.asarray(True) if self.jumps else False  # diffrax takes a constant `True` for its initial `False`
        return True, self.begins[state - 1], following, jumped, state + 1, dfx.RESULTS.successful


class _State(NamedTuple):
    share: Float[Array, ""]
    s: Float[Array, ""]
    w: Float[Array, ""]
    piece: Int[Array, ""]
    count: Int[Array, ""]
    status: Int[Array, ""]
    done: Bool[Array, ""]
    nodes: Float[Array, "nodes 3"]
    entry_w: Float[Array, "steps"]
    pieces: Int[Array, "steps"]
    held: Bool[Array, "steps"]


def move(
    table: Table,
    seen: Window,
    duration: Float[Array, ""],
    *,
    how: Integration,
    s: Float[Array, ""] | None = None,
    speed: Float[Array, ""] | float = 0.0,
    free: bool | Bool[Array, ""] = False,
) -> Motion:
    """Move along a wire for one phase, from its start (or `s`) at `speed` [1/s].

    `free` lets the motion pass rest and the wire's end with forward signs: a smooth continuation that optimisation may
    differentiate, not physics; only an honest run (`free=False`) decides what happens.
    """
    capacity = how.max_steps
    dtype = table.breaks.dtype
    begin = table.breaks[0] if s is None else jnp.asarray(s, dtype)
    w = jnp.asarray(speed, dtype) * duration
    first = jnp.stack([jnp.zeros((), dtype), begin, w])
    state = _State(
        share=first[0],
        s=begin,
        w=w,
        piece=jnp.asarray(0),
        count=jnp.asarray(0),
        status=jnp.asarray(int(Status.MAX_STEPS)),
        done=jnp.asarray(False),
        nodes=jnp.broadcast_to(first, (capacity + 1, 3)),
        entry_w=jnp.zeros(capacity, dtype),
        pieces=jnp.zeros(capacity, int),
        held=jnp.zeros(capacity, bool),
    )
    free = jnp.asarray(free)

    def stage(state):
        return _stage(table, seen, duration, how, free, state)

    if how.adjoint in ("none", "forward"):
        state = _repeated(stage, state, how.stages)
    else:  # reverse mode must know how often

        def once(state, _):
            return jax.lax.cond(state.done, lambda s: s, stage, state), None

        state, _ = jax.lax.scan(once, state, None, length=how.stages)
    beyond = jnp.arange(capacity + 1) > state.count
    nodes = jnp.where(beyond[:, None], state.nodes[state.count], state.nodes)
    middle = (nodes[:-1, 0] + nodes[1:, 0]) / 2
    return Motion(
        share=nodes[:, 0],
        s=nodes[:, 1],
        w=nodes[:, 2],
        entry_w=state.entry_w,
        piece=state.pieces,
        row=jax.vmap(lambda m: interval(seen, m))(stop_gradient(middle)),
        held=state.held,
        count=state.count,
        status=state.status,
    )


def _repeated(stage, state: _State, most: int) -> _State:
    """Stage after stage until all is done, at most so many."""

    def going(loop):
        count, state = loop
        return ~state.done & (count < most)

    return jax.lax.while_loop(going, lambda loop: (loop[0] + 1, stage(loop[1])), (jnp.asarray(0), state))[1]


@jax.jit
def acceleration(table: Table, seen: Window, duration, piece, row, share, s, w):
    """`dw/du` for forward travel in a piece and a torque interval."""
    panel, xi = powers(table, piece, s)
    a = horner(table.acceleration[panel], xi)
    tau = torque_in(seen, row, share)
    return duration**2 * (a[0] + a[3] * tau[0] + a[4] * tau[1]) + duration * a[2] * w + a[1] * w**2


@jax.jit
def single_step(table, seen, duration, how: Integration, piece, row, share, y, length):
    """One step of the solver from `y = (s, w)` at a share of the phase, within a piece and a torque interval."""
    solver = eqx.tree_at(lambda x: x.scan_kind, how.solver, "bounded", is_leaf=lambda x: x is None)

    def field(u, y, args):
        table, seen, duration = args
        return jnp.stack([y[1], acceleration(table, seen, duration, piece, row, u, y[0], y[1])])

    term, args = dfx.ODETerm(field), (table, seen, duration)
    state = solver.init(term, share, share + length, y, args)
    return solver.step(term, share, share + length, y, args, state, made_jump=True)[0]


def _stage(table, seen, duration, how, free, state: _State) -> _State:
    """Wait at rest if need be, then move until the piece ends, the object stops, or time is over."""
    rest = (state.w <= 0) & ~free
    share, verdict = _departure(table, seen, state)
    share = jnp.where(rest, share, state.share)
    verdict = jnp.where(rest, verdict, int(Status.OK))
    waited = rest & (share > state.share)
    room = how.max_steps - state.count - waited
    state = _append(state, waited, share, state.s, state.w, state.w, held=True)._replace(share=share)
    blocked = verdict != int(Status.OK)

    last = state.piece >= table.count - 1
    goal = table.breaks[state.piece + 1] + jnp.where(free & last, jnp.inf, 0.0)
    floor = jnp.where(free, -jnp.inf, 0.0)
    final = jnp.where(blocked, state.share, 1.0)

    solution = _integrate(table, seen, duration, how, state, final, goal, floor)
    y0 = jnp.stack([state.s, state.w])
    saved_times, saved = jnp.asarray(solution.ts), jnp.asarray(solution.ys)
    taken = solution.stats["num_accepted_steps"]
    overshot = dfx.is_event(solution.result)
    # The record is as long as one stage may be; several stages together may need more.
    complete = (dfx.is_successful(solution.result) | overshot) & (taken <= room)
    rows = jnp.arange(how.max_steps)
    kept = jnp.clip(jnp.where(overshot, taken - 1, taken), 0, jnp.maximum(room, 0))
    live = rows < kept
    # Unused rows are infinite: put numbers there before anything is computed from them.
    times = jnp.where(live, saved_times, state.share)
    steps = jnp.where(live[:, None], saved, y0)
    start = state.count
    place = jnp.where(live, start + 1 + rows, how.max_steps + 1)
    nodes = state.nodes.at[place].set(jnp.concatenate([times[:, None], steps], axis=1), mode="drop")
    entered = jnp.concatenate([y0[1:], steps[:-1, 1]])
    state = state._replace(
        nodes=nodes,
        entry_w=state.entry_w.at[place - 1].set(entered, mode="drop"),
        pieces=state.pieces.at[place - 1].set(state.piece, mode="drop"),
        count=start + kept,
    )
    share, s, w = (nodes[start + kept, k] for k in range(3))
    w = jnp.where(kept > 0, w, y0[1])  # a node at a chart's end holds the speed in the chart before
    last_time = jnp.where(overshot, saved_times[jnp.maximum(taken - 1, 0)], 1.0)
    landed = _land(table, seen, duration, how, state.piece, (share, s, w), last_time, goal, floor, overshot)
    land_share, land_s, land_w, passed, astray = landed
    state = _append(state, overshot, land_share, land_s, land_w, w, held=False)
    onward = passed & ~last
    factor = table.factor[jnp.minimum(state.piece + 1, table.factor.shape[0] - 1)]
    # `done` waits for the next stage where the object has come to rest: it may start again.
    status = jnp.select(
        [~complete, blocked, astray, passed & last, overshot],
        [
            int(Status.MAX_STEPS),
            verdict,
            *(int(s) for s in (Status.NO_CONVERGENCE, Status.LEFT_FORMATION, Status.MAX_STEPS)),
        ],
        int(Status.OK),
    )
    return state._replace(
        share=jnp.where(overshot, land_share, share),
        s=jnp.where(overshot, land_s, s),
        w=jnp.where(overshot, land_w, w) * jnp.where(onward, factor, 1.0),
        piece=state.piece + onward,
        status=status,
        done=blocked | ~complete | astray | (passed & last) | ~overshot,
    )


def _integrate(table, seen, duration, how, state, final, goal, floor):
    """Steps from the state to `final` or to the first that passes `goal` or falls below the speed `floor`."""

    def solve(inputs, controller, adjoint):
        table, seen, duration, share, y0, final, goal = inputs

        def field(u, y, _):
            row = interval(seen, u)
            return jnp.stack([y[1], acceleration(table, seen, duration, state.piece, row, u, y[0], y[1])])

        return dfx.diffeqsolve(
            dfx.ODETerm(field),
            how.solver,
            share,
            final,
            None,
            y0,
            saveat=dfx.SaveAt(steps=True),
            stepsize_controller=controller,
            event=dfx.Event(lambda t, y, args, **_: (y[0] > goal) | (y[1] < floor)),
            adjoint=ADJOINTS[adjoint],
            max_steps=how.max_steps,
            throw=False,
        )

    inputs = (table, seen, duration, state.share, jnp.stack([state.s, state.w]), final, goal)
    knots = seen.share

    way = stop_gradient(goal - state.s)

    def adaptive(knots):
        errors = dfx.PIDController(rtol=how.tolerance, atol=how.tolerance)
        errors = _FirstStep(controller=errors, way=way, rtol=how.tolerance, atol=how.tolerance, norm=errors.norm)
        return dfx.ClipStepSizeController(errors, step_ts=knots, jump_ts=knots if how.steps else None)

    if how.adjoint in ("none", "forward"):
        return solve(inputs, adaptive(knots), how.adjoint)
    ends = solve(stop_gradient(inputs), adaptive(stop_gradient(knots)), "none").ts
    assert ends is not None
    ends = _continued(ends, stop_gradient(state.share), stop_gradient(final))
    # A step that ends on a knot moves with it. Where the torque may step it ends before the knot (diffrax has told the
    # time behind it), and the next begins behind it.
    knot = knots[jnp.argmin(jnp.abs(ends[:, None] - stop_gradient(knots)), axis=1)]
    fixed = stop_gradient(knot)
    on_knot = jnp.abs(ends - fixed) < 1e-13
    before, behind = (jnp.nextafter(fixed, way) if how.steps else ends for way in (-jnp.inf, jnp.inf))
    begins = jnp.where(on_knot, behind + (knot - fixed), ends)
    ends = jnp.where(on_knot, before + (knot - fixed), ends)
    return solve(inputs, _Repeat(ends, begins, how.steps), how.adjoint)


def _continued(ends, begin, final):
    """Times of steps, with one as long as the last one after it and then `final` instead of infinite ones.

    A batch goes on until its last member has finished: the others take steps that do not count, but that must be
    harmless. One straight to the end of time would overflow, and what overflows has no derivative, not even zero.
    """
    taken = jnp.isfinite(ends).sum()
    last, before = ends[taken - 1], jnp.where(taken > 1, ends[taken - 2], begin)
    one_more = (jnp.arange(ends.shape[0]) == taken) & (taken > 0)
    return jnp.where(jnp.isfinite(ends), ends, jnp.where(one_more, jnp.minimum(2 * last - before, final), final))


def _append(state, wanted, share, s, w, entry_w, *, held):
    """Add one step to the record where `wanted`."""
    capacity = state.entry_w.shape[0]
    place = jnp.where(wanted & (state.count < capacity), state.count + 1, capacity + 1)
    return state._replace(
        nodes=state.nodes.at[place].set(jnp.stack([share, s, w]), mode="drop"),
        entry_w=state.entry_w.at[place - 1].set(entry_w, mode="drop"),
        pieces=state.pieces.at[place - 1].set(state.piece, mode="drop"),
        held=state.held.at[place - 1].set(held, mode="drop"),
        count=state.count + (place <= capacity),
    )


def _departure(table, seen, state):
    """When an object at rest at `s` starts to move, and what it does: `ok`, `reversed`, `ambiguous` or `stuck`.

    The accelerations at rest are linear in the torque, hence piecewise linear in time: their first signs are exact.
    """
    panel, xi = powers(table, state.piece, state.s)
    ahead = horner(table.acceleration[panel], xi)[jnp.array([0, 3, 4])]
    behind = -horner(table.backward[panel], xi)
    rows = jnp.arange(seen.slope.shape[0])
    low = jnp.maximum(seen.share[:-1], state.share)
    high = jnp.minimum(seen.share[1:], 1.0)
    live = (rows >= seen.first) & (rows <= seen.last) & (high >= low)
    tau_low = jax.vmap(torque_in, (None, 0, 0))(seen, rows, low)

    def first(pull):
        value = pull[0] + tau_low @ pull[1:]
        rate = seen.slope @ pull[1:]
        root = low - value / jnp.where(rate > 0, rate, 1.0)
        at = jnp.where(value > 0, low, jnp.where((rate > 0) & (root < high), root, jnp.inf))
        at = jnp.where(live, at, jnp.inf)
        k = jnp.argmin(stop_gradient(at))
        return at[k]

    forward, backward = first(ahead), first(behind)
    both = (forward == backward) & jnp.isfinite(forward)
    verdict = jnp.select(
        [both, forward < backward, backward < forward],
        [int(Status.AMBIGUOUS), int(Status.OK), int(Status.REVERSED)],
        int(Status.STUCK),
    )
    at = jnp.minimum(forward, backward)
    return jnp.where(jnp.isfinite(at), jnp.where(jnp.isfinite(at), at, 0.0), 1.0), verdict


def _land(table, seen, duration, how, piece, node, end, goal, floor, wanted):
    """Retake the last step from `node` with the length that lands on `s = goal` or on `w = 0`, whichever comes first.

    Returns where it lands, whether on the goal, and whether it went astray: no length within the step lands there.
    """
    share, s, w = node
    longest = jnp.where(wanted, end - share, 0.0)
    row = interval(seen, stop_gradient(share + longest / 2))

    def field(share, y, args):
        table, seen, duration = args
        return jnp.stack([y[1], acceleration(table, seen, duration, piece, row, share, y[0], y[1])])

    def step(share, length, y, args):
        table, seen, duration = args
        return single_step(table, seen, duration, how, piece, row, share, y, length)

    args = (table, seen, duration)
    fixed = stop_gradient((share, jnp.stack([s, w]), args, longest))
    goal_now = stop_gradient(goal)

    def beyond(y):
        """Whether the goal is passed by more than the speed has fallen below rest, and by how much."""
        passing, resting = y[0] - goal_now, floor - y[1]
        return passing >= resting, jnp.maximum(passing, resting)

    def narrow(bracket):
        """Newton on the step's length, bisecting where it would leave the bracket."""
        low, high, length, _, count = bracket
        y = step(fixed[0], length, fixed[1], fixed[2])
        passed, miss = beyond(y)
        rate = field(fixed[0] + length, y, fixed[2])
        rate = jnp.where(passed, rate[0], -rate[1])
        low, high = jnp.where(miss < 0, length, low), jnp.where(miss < 0, high, length)
        guess = length - miss / jnp.where(rate == 0, 1.0, rate)
        better = jnp.where((guess >= low) & (guess <= high), guess, (low + high) / 2)
        return low, high, better, jnp.abs(better - length), count + 1

    def going(bracket):
        *_, moved, count = bracket
        return (moved > enough) & (count < LANDINGS)

    # Half of the digits and some: the last step below, which carries derivatives, brings the others.
    enough = jnp.finfo(s.dtype).eps ** (5 / 8) * fixed[3]
    begin = (jnp.zeros_like(fixed[3]), fixed[3], fixed[3] / 2, fixed[3], jnp.asarray(0))
    length = jax.lax.while_loop(going, narrow, begin)[2]
    y = step(share, length, jnp.stack([s, w]), args)
    rate = stop_gradient(field(share + length, y, args))
    # An object that comes to rest just at the goal does both: it lands on the one that is nearer in time.
    targets = jnp.stack([jnp.where(jnp.isfinite(goal), goal, 0.0), jnp.zeros_like(goal)])
    lates = (targets - y) / jnp.where(wanted & (rate != 0), rate, 1.0)
    possible = jnp.stack([jnp.isfinite(goal) & (rate[0] > 0), jnp.isfinite(floor) & (rate[1] < 0)])
    which = jnp.argmin(jnp.where(possible, jnp.abs(stop_gradient(lates)), jnp.inf))
    passed = wanted & (which == 0)
    late = jnp.where(wanted, lates[which], 0.0)
    astray = wanted & ~(jnp.abs(late) <= longest)
    late = jnp.where(astray, 0.0, late)
    y = y + rate * late
    return (
        share + length + late,
        jnp.where(passed, targets[0], y[0]),
        jnp.where(passed, y[1], 0.0),
        passed,
        astray,
    )
