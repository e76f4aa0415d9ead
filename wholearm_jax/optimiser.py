"""Optimise: the torque schedule of a plan with the largest compressive margin, phase by phase.

Phases begin and end at rest, so each has its own problem. It starts from the quasi-static torques of an even
rest-to-rest motion, descends (`descent`) while the temperature of the smooth margin falls, and keeps the best schedule
whose honest simulation succeeds.
"""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

from wholearm_jax.descent import COLDEST, JOINED, Limits, advance, begin, interior_point, projected
from wholearm_jax.motion import Integration
from wholearm_jax.plan import Result, Traced, describe, outcomes, require_x64, run, trace
from wholearm_jax.reduction import blank
from wholearm_jax.scene import Scene
from wholearm_jax.schedule import Torque, padded
from wholearm_jax.shooting import Variables
from wholearm_jax.squeeze import Bound, bound, holds
from wholearm_jax.status import Status
from wholearm_jax.wire import Resolution

TORQUE_SHARE = 0.9  # share of the torque limits that a start may use
PROFILES = tuple((p, q) for p in (1.0, 2.0, 4.0, 8.0, 16.0) for q in (1.0, 2.0, 4.0, 8.0, 16.0))
FINE = 8  # places a knot interval at which a starting motion is judged
EVEN = 0.3  # share of the even motion in every profile, so that the object never quite stops on the way
OTHERS = ((16.0, 1.0), (1.0, 1.0), (1.0, 16.0))  # further starts: a long dwell first, none, a long dwell last
GOOD = 0.99  # share of the bound with which no further start is tried


@dataclass(frozen=True)
class Step:
    """One step of the descent from one of a phase's starts: the temperature as a share of the bound, the least sampled
    force [N], how far apart the intervals still are (`shooting`), the time it took [s]."""

    phase: int
    start: int
    step: int
    temperature: float
    margin: float
    apart: float
    seconds: float


@dataclass(frozen=True)
class Optimised:
    """An optimised plan: the simulated `result`, for each phase its `bound` [N] and why the descent stopped.

    `scene` carries the durations that were found. `history` holds every step.
    """

    scene: Scene
    torque: Torque
    result: Result
    bounds: tuple[Bound, ...]
    stopped: tuple[str, ...]
    history: tuple[Step, ...]

    @property
    def reached(self) -> tuple[float, ...]:
        """The share of its bound that each phase reached; NaN where the bound is not positive."""
        pairs = zip(self.result.phases, self.bounds, strict=True)
        return tuple(p.margin / float(b.value) if float(b.value) > 0 else float("nan") for p, b in pairs)


def quasistatic(scene: Scene, *, knots: int = 51, traced: tuple[Traced, ...] = ()) -> Torque:
    """The quasi-static torques: at each knot the best squeeze for an even rest-to-rest motion, in closed form.

    The motion's speed is `v ~ u^p (1 - u)^q` in `u = t / duration`: the even `p = q = 1` unless another of `PROFILES`
    allows a larger margin. As the inverse dynamics at the knots only, the schedule carries the object near the wire's
    end, not exactly to it.
    """
    traced = traced or trace(scene)
    pairs = zip(traced, scene.phases, strict=True)
    starts = [(at.table.torque_limit, _starts(at, p.duration, knots, 1.0)[0]) for at, p in pairs]
    return _joined(scene, [limit * start.torque for limit, start in starts])


def bounds(scene: Scene, *, traced: tuple[Traced, ...] = ()) -> tuple[Bound, ...]:
    """For each phase the certificate that no torque within limits holds it with a larger margin (`squeeze.bound`)."""
    traced = traced or trace(scene)
    pairs = zip(traced, scene.phases, strict=True)
    return tuple(_bound(at.table, p.duration, jnp.asarray(p.arrive == "rest")) for at, p in pairs)


def optimise(
    scene: Scene,
    *,
    knots: int = 51,
    steps: int = 120,
    rate_limit: float | None = None,
    durations: tuple[float, float] | None = None,
    optimiser: optax.GradientTransformation | None = None,
    tolerance: float = 1e-3,
    callback: Callable[[Step], None] | None = None,
) -> Optimised:
    """Find the torque schedule with the largest compressive margin by gradient descent through the simulation.

    Every phase must arrive at rest; `knots` torques a joint, evenly spaced in time, are linear in between. The scene's
    torque limits hold, and `rate_limit` [N m/s] if given. `durations = (shortest, longest)` lets each phase choose its
    own. `optimiser` replaces the preconditioned descent by any optax optimiser, projected onto arrival. A phase stops
    when its margin comes within `tolerance` of the bound or no longer improves by that share, or after `steps`.
    `callback` sees every step. Where no torque can hold a formation, nothing is searched and the status says so.
    """
    require_x64()
    method = _INTERIOR_POINT if optimiser is None else projected(optimiser)
    with ThreadPoolExecutor(1) as beside:
        ready = beside.submit(_compile, knots, method)
        traced = trace(scene)
        tops = bounds(scene, traced=traced)
        ready.result()
    found, history, stopped = [], [], []
    for index, (at, top) in enumerate(zip(traced, tops, strict=True)):
        phase = scene.phases[index]
        pinned = found[-1].values[-1] if rate_limit is not None and found else None
        task = _Task(index, at, float(top.value), float(top.share), phase.duration, knots, steps, tolerance, pinned)
        limits = _limits(task, rate_limit, durations)
        schedule, why, taken = _optimise_phase(task, limits, method, callback)
        found.append(schedule)
        stopped.append(why)
        history += taken
    lengths = [f.times[-1] for f in found]
    phases = tuple(replace_duration(p, t) for p, t in zip(scene.phases, lengths, strict=True))
    scene = eqx.tree_at(lambda s: s.phases, scene, phases)
    torque = _joined(scene, [f.values for f in found])
    result = describe(scene, torque, traced, outcomes(scene, torque, traced, Integration()))
    return Optimised(scene, torque, result, tops, tuple(stopped), tuple(history))


@dataclass(frozen=True)
class _Task:
    index: int
    traced: Traced
    bound: float
    bound_share: float
    duration: jax.Array
    knots: int
    steps: int
    tolerance: float
    pinned: jax.Array | None


def _optimise_phase(task: _Task, limits: Limits, method, callback) -> tuple[Torque, str, list[Step]]:
    """Descend on one phase from one start after the other, until one comes near the bound or two agree; return the
    best schedule (from time 0), why its descent stopped, and the steps taken."""
    table = task.traced.table
    if int(table.status) != Status.OK:
        why = f"the wire cannot be followed: {Status(int(table.status)).label}"
        return _evenly(task, np.zeros((task.knots, 2))), why, []
    starts = _starts(task.traced, task.duration, task.knots, TORQUE_SHARE)
    if task.bound <= 0:
        why = f"no torque within limits holds this formation at {100 * task.bound_share:.0f} % of its wire"
        return _evenly(task, starts[0].torque * table.torque_limit), why, []
    best, best_key, reason, history = starts[0], (False, -np.inf), "", []
    agree = False
    for number, start in enumerate(starts):
        if task.pinned is not None:
            start = eqx.tree_at(lambda p: p.torque, start, start.torque.at[0].set(task.pinned / table.torque_limit))
        p, why, taken = _descend(task, start, number, limits, method, callback)
        history += taken
        margin, status = _honest(p, table)
        key = (status is Status.OK, margin if np.isfinite(margin) else -np.inf)
        agree = key[0] and best_key[0] and abs(key[1] - best_key[1]) <= task.tolerance * task.bound
        if key > best_key:
            best, best_key, reason = p, key, why
        if agree or (best_key[0] and best_key[1] >= GOOD * task.bound):
            break
    share = best_key[1] / task.bound
    reason = f"within {task.tolerance:g} of the bound" if best_key[0] and share >= 1 - task.tolerance else reason
    return _unpack(best, table)[0], reason, history


def _descend(task: _Task, start: Variables, number: int, limits: Limits, method, callback):
    """One descent: the variables at its end, why it ended, and its steps."""
    table, history = task.traced.table, []
    d = begin(start, method)
    why = f"the limit of {task.steps} steps"
    for count in range(task.steps):
        begun = time.perf_counter()
        after = advance(d, table, limits, _HOW, method)
        least, apart, hot, shares, share = jax.device_get(
            (after.least, after.apart, after.state.temperature, after.state.steps, after.share)
        )
        margin = float(least) * task.bound
        step = Step(task.index, number, count, float(hot), margin, float(apart), time.perf_counter() - begun)
        history.append(step)
        if callback is not None:
            callback(step)
        if apart < JOINED and hot <= COLDEST and (shares.min() >= 1 or margin >= (1 - task.tolerance) * task.bound):
            return d.p, "the margin no longer improves", history
        if share < LOST:
            return d.p, "no step leads on", history
        d = after
    return d.p, why, history


def _compile(knots: int, method) -> None:
    """Compile the descent's programs, on a blank table, while the wires are being traced."""
    if (knots, method) in _COMPILED:
        return
    _COMPILED.add((knots, method))
    table = blank(Resolution())
    limits = Limits(*(jnp.asarray(a) for a in (np.full(2, np.inf), _ONE, _ONE, np.zeros(knots, bool), _ONE)))
    p = Variables(*(jnp.asarray(a) for a in (np.zeros((knots, 2)), np.zeros((knots, 2)), np.zeros(()))))
    advance(begin(p, method), table, limits, _HOW, method)
    _honest(p, table)


_COMPILED: set = set()
_ONE = np.ones(())
_HOW = Integration()
LOST = 1e-6  # share of a step at which a descent gives up


def _evenly(task: _Task, values) -> Torque:
    return Torque(jnp.asarray(np.linspace(0.0, float(task.duration), task.knots)), jnp.asarray(values))


@jax.jit
def _unpack(p: Variables, table):
    schedule = p.schedule(table)
    return schedule, p.duration, padded(schedule)


def _honest(p: Variables, table) -> tuple[float, Status]:
    _, duration, schedule = _unpack(p, table)
    outcome = run(table, schedule, jnp.zeros(()), duration, Integration(), True)
    return float(outcome.score.margin), Status(int(outcome.verdict.status))


def _starts(traced: Traced, duration, knots: int, share: float) -> list[Variables]:
    """Rest-to-rest motions with the torques that give them, within a `share` of the limits, by the best squeeze.

    First that of `PROFILES` with the largest margin (the even one unless another gains more than 2 %), then `OTHERS`.
    """
    full = np.asarray(traced.table.torque_limit)
    table = eqx.tree_at(lambda t: t.torque_limit, traced.table, jnp.asarray(share * full))
    length, first, time = float(table.length), float(table.breaks[0]), float(duration)
    u = np.linspace(0.0, 1.0, FINE * (knots - 1) + 1)
    motions = [_profile(u, *powers) for powers in PROFILES]
    s, v, a = (np.stack(rows) for rows in zip(*motions, strict=True))
    held = _holds(table, first + length * s, length * v / time, length * a / time**2)
    margins = np.asarray(held.margin).min(1)
    best = 0 if margins[0] >= margins.max() - 0.02 * abs(margins.max()) else int(np.argmax(margins))
    order = [best, *(PROFILES.index(other) for other in OTHERS if PROFILES[best] != other)]
    torque = np.clip(np.asarray(held.torque)[:, ::FINE] / full, -share, share)
    state = np.stack([s, v], axis=2)[:, ::FINE]
    state[:, -1] = (1.0, 0.0)
    log = jnp.asarray(np.log(time))
    return [Variables(jnp.asarray(torque[k]), jnp.asarray(state[k]), log) for k in order]


def _profile(u, p, q):
    """Motion over a unit length and time from rest to rest, `EVEN` even and the rest with speed `v ~ u^p (1 - u)^q`."""
    inner = np.clip(u, 1e-12, 1 - 1e-12)
    v = inner**p * (1 - inner) ** q
    a = v * (p / inner - q / (1 - inner))
    s = np.concatenate([[0.0], np.cumsum((v[1:] + v[:-1]) / 2 * np.diff(u))])
    scale = (1 - EVEN) / s[-1]
    return (
        scale * s + EVEN * (3 * u**2 - 2 * u**3),
        scale * v + EVEN * 6 * (u - u**2),
        scale * a + EVEN * (6 - 12 * u),
    )


_holds = jax.jit(jax.vmap(holds, (None, 0, 0, 0)))
_INTERIOR_POINT = interior_point()
_bound = jax.jit(bound)


def _limits(task: _Task, rate_limit, durations) -> Limits:
    shortest, longest = durations or (float(task.duration), float(task.duration))
    rate = np.full(2, np.inf if rate_limit is None else float(rate_limit))
    pinned = np.zeros(task.knots, bool)
    pinned[0] = task.pinned is not None
    unit = max(task.bound, 1e-300)
    return Limits(*(jnp.asarray(a) for a in (rate, shortest * _ONE, longest * _ONE, pinned, unit * _ONE)))


def _joined(scene: Scene, blocks) -> Torque:
    """Knots of each phase as one schedule; a step where one phase follows another."""
    start, times = 0.0, []
    for phase, block in zip(scene.phases, blocks, strict=True):
        end = start + float(phase.duration)
        times.append(np.linspace(start, end, block.shape[0]))
        start = end
    return Torque(jnp.asarray(np.concatenate(times)), jnp.asarray(np.concatenate([np.asarray(b) for b in blocks])))


def replace_duration(phase, duration):
    """A phase with another duration."""
    return eqx.tree_at(lambda p: p.duration, phase, jnp.asarray(duration, float))
