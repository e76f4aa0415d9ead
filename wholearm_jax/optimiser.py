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

from wholearm_jax.descent import SHORTER, Limits, advance, linearise, pack, preconditioned, projected, unpack
from wholearm_jax.motion import Integration
from wholearm_jax.plan import Result, Traced, describe, outcomes, require_x64, run, trace
from wholearm_jax.reduction import blank
from wholearm_jax.scene import Scene
from wholearm_jax.schedule import Torque, padded
from wholearm_jax.squeeze import Bound, bound, holds
from wholearm_jax.status import Status
from wholearm_jax.wire import Resolution

HOTTEST, COLDEST, COOLING = 0.1, 2e-4, 0.5  # temperatures as shares of the bound, and the factor from one to the next
FIRST = 0.9  # share of the torque limits that the start may use
PROFILES = tuple((p, q) for p in (1.0, 2.0, 4.0, 8.0, 16.0) for q in (1.0, 2.0, 4.0, 8.0, 16.0))
FINE = 8  # places a knot interval at which a starting motion is judged
EVEN = 0.3  # share of the even motion in every profile, so that the object never quite stops on the way
SMOOTHINGS = 2000  # most passes that bring a start within its rate limits
PATIENCE = 12  # steps without gain at the lowest temperature before a phase stops


@dataclass(frozen=True)
class Step:
    """One step of the descent: the loss, the margin [N] of the honest simulation and its status, the time it took."""

    phase: int
    step: int
    temperature: float
    loss: float
    margin: float
    status: Status
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


def quasistatic(scene: Scene, *, knots: int = 31, traced: tuple[Traced, ...] = ()) -> Torque:
    """The quasi-static torques: at each knot the best squeeze for an even rest-to-rest motion, in closed form.

    The motion's speed is `v ~ u^p (1 - u)^q` in `u = t / duration`: the even `p = q = 1` unless another of `PROFILES`
    allows a larger margin. As the inverse dynamics at the knots only, the schedule carries the object near the wire's
    end, not exactly to it.
    """
    traced = traced or trace(scene)
    return _joined(scene, [_start(at, p.duration, knots, 1.0) for at, p in zip(traced, scene.phases, strict=True)])


def bounds(scene: Scene, *, traced: tuple[Traced, ...] = ()) -> tuple[Bound, ...]:
    """For each phase the certificate that no torque within limits holds it with a larger margin (`squeeze.bound`)."""
    traced = traced or trace(scene)
    pairs = zip(traced, scene.phases, strict=True)
    return tuple(_bound(at.table, p.duration, jnp.asarray(p.arrive == "rest")) for at, p in pairs)


def optimise(
    scene: Scene,
    *,
    knots: int = 31,
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
    method = _DESCENT if optimiser is None else projected(optimiser)
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
    """Descend on one phase; return the best schedule (from time 0), why it stopped, and the steps taken."""
    table, how = task.traced.table, _HOW
    if int(table.status) != Status.OK:
        return (
            _evenly(task, np.zeros((task.knots, 2))),
            f"the wire cannot be followed: {Status(int(table.status)).label}",
            [],
        )
    values = _start(task.traced, task.duration, task.knots, FIRST)
    if task.bound <= 0:
        why = f"no torque within limits holds this formation at {100 * task.bound_share:.0f} % of its wire"
        return _evenly(task, values), why, []
    if task.pinned is not None:
        values[0] = np.asarray(task.pinned)
    p = _pack(_within_rate(values, limits, task), jnp.asarray(np.asarray(task.duration)), table)
    state, temperature = method.init(p), HOTTEST * task.bound
    best, best_margin, history, since, share = p, -np.inf, [], 0, 1.0
    why = f"the limit of {task.steps} steps"
    for count in range(task.steps):
        begun = time.perf_counter()
        heat, first = jnp.asarray(temperature * _ONE), jnp.asarray(min(1.0, share / SHORTER) * _ONE)
        linear = linearise(p, table, limits, heat, how)
        p, state, promised, taken = advance(p, state, linear, table, limits, heat, how, method, first)
        share = float(taken) or 1.0
        margin, status = _honest(p, table)
        step = Step(task.index, count, temperature, float(linear.loss), margin, status, time.perf_counter() - begun)
        history.append(step)
        if callback is not None:
            callback(step)
        better = status is Status.OK and margin > best_margin
        since = 0 if better and margin > best_margin + 0.1 * task.tolerance * task.bound else since + 1
        if better:
            best, best_margin = p, margin
        if best_margin >= (1 - task.tolerance) * task.bound:
            why = f"within {task.tolerance:g} of the bound"
            break
        coldest = temperature <= COLDEST * task.bound
        if coldest and (since >= PATIENCE or taken == 0):
            why = "the margin no longer improves"
            break
        if promised < temperature or taken == 0:
            temperature = max(temperature * COOLING, COLDEST * task.bound)
    return _unpack(best, table)[0], why, history


def _compile(knots: int, method) -> None:
    """Compile the descent's programs, on a blank table, while the wires are being traced."""
    if (knots, method) in _COMPILED:
        return
    _COMPILED.add((knots, method))
    table = blank(Resolution())
    limits = Limits(*(jnp.asarray(a) for a in (np.full(2, np.inf), 1.0 * _ONE, 1.0 * _ONE, np.zeros(knots, bool))))
    p, one = _pack(np.zeros((knots, 2)), jnp.asarray(_ONE), table), jnp.asarray(_ONE)
    linear = linearise(p, table, limits, one, _HOW)
    advance(p, method.init(p), linear, table, limits, one, _HOW, method, one)
    _honest(p, table)


_COMPILED: set = set()
_ONE = np.ones(())
_HOW = Integration(max_steps=128, adjoint="forward")


def _evenly(task: _Task, values) -> Torque:
    return Torque(jnp.asarray(np.linspace(0.0, float(task.duration), task.knots)), jnp.asarray(values))


_pack = jax.jit(pack)


@jax.jit
def _unpack(p, table):
    schedule, duration = unpack(p, table)
    return schedule, duration, padded(schedule)


def _honest(p, table) -> tuple[float, Status]:
    _, duration, schedule = _unpack(p, table)
    outcome = run(table, schedule, jnp.zeros(()), duration, Integration(), True)
    return float(outcome.score.margin), Status(int(outcome.verdict.status))


def _start(traced: Traced, duration, knots: int, share: float):
    """Torques at the knots that give, with the best squeeze, the rest-to-rest motion of `PROFILES` that squeezes best.

    The even motion is taken unless another gains more than 2 % of its margin.
    """
    limit = share * np.asarray(traced.table.torque_limit)
    table = eqx.tree_at(lambda t: t.torque_limit, traced.table, jnp.asarray(limit))
    length, begin, time = float(table.length), float(table.breaks[0]), float(duration)
    u = np.linspace(0.0, 1.0, FINE * (knots - 1) + 1)
    motions = [_profile(u, *powers) for powers in PROFILES]
    s, v, a = (length * np.stack(rows) for rows in zip(*motions, strict=True))
    held = _holds(table, begin + s, v / time, a / time**2)
    margins = np.asarray(held.margin).min(1)
    best = 0 if margins[0] >= margins.max() - 0.02 * abs(margins.max()) else int(np.argmax(margins))
    return np.clip(np.asarray(held.torque)[best, ::FINE], -limit, limit)


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
_DESCENT = preconditioned()
_bound = jax.jit(bound)


def _limits(task: _Task, rate_limit, durations) -> Limits:
    shortest, longest = durations or (float(task.duration), float(task.duration))
    rate = np.full(2, np.inf if rate_limit is None else float(rate_limit))
    pinned = np.zeros(task.knots, bool)
    pinned[0] = task.pinned is not None
    return Limits(*(jnp.asarray(a) for a in (rate, shortest * _ONE, longest * _ONE, pinned)))


def _within_rate(values, limits: Limits, task: _Task):
    """The knots smoothed until they keep 80 % of the rate limit; the first stays where it is."""
    largest = 0.8 * np.asarray(limits.rate) * float(task.duration) / (task.knots - 1)
    for _ in range(SMOOTHINGS):
        if np.all(np.abs(np.diff(values, axis=0)) <= largest):
            break
        values = np.concatenate([values[:1], (values[:-2] + 2 * values[1:-1] + values[2:]) / 4, values[-1:]])
        values[-1] = values[-2]
    return values


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
