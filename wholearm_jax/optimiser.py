"""Optimise: the torque schedule of a plan with the largest compressive margin.

Phases that begin and end at rest have each their own problem; those that follow one another at speed have one together;
those that hold the object have the best torque of its statics (`holding`).
It starts from the quasi-static torques of a smooth motion, descends (`pacing`) while the temperature of the smooth
margin falls, and keeps the best schedule whose honest simulation succeeds.
"""

import functools
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

from wholearm_jax.descent import advance, begin, interior_point, projected
from wholearm_jax.guesses import guesses
from wholearm_jax.linearisation import Limits
from wholearm_jax.pacing import HOW, Problem, Step, descend
from wholearm_jax.phase import Traced, balance_at_start, run
from wholearm_jax.plan import outcomes, stacked, trace
from wholearm_jax.precision import array, require_x64
from wholearm_jax.programs import Program
from wholearm_jax.reduction import blank
from wholearm_jax.result import Result, describe, stays
from wholearm_jax.scene import Phase, Scene, replace_duration
from wholearm_jax.schedule import Torque, padded, rounded
from wholearm_jax.shooting import Variables
from wholearm_jax.squeeze import Bound, bound
from wholearm_jax.status import Status
from wholearm_jax.stepping import Integration
from wholearm_jax.wire import Resolution

TORQUE_SHARE = 0.9  # share of the torque limits that a start may use
PASSING = 0.2  # least speed with which a phase is entered that does not begin at rest, over its mean speed
GOOD = 0.99  # share of the bound with which no further start is tried


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
    end, not exactly to it. A phase that holds the object gets its best torque.

    Derivation, section 8. Returns `knots` rows a phase.

    >>> wa.quasistatic(wa.load("heptagon"), knots=11).values.shape
    (22, 2)
    """
    traced = traced or trace(scene)

    def torques(at, phase):
        if phase.arrive == "hold":
            return _steady(scene, phase, at, knots)
        start = guesses([at], [float(phase.duration)], knots, 1.0)[0]
        return _evenly(float(phase.duration), at.table.torque_limit * start.torque[0])

    return _in_turn([torques(*pair) for pair in zip(traced, scene.phases, strict=True)])


def bounds(scene: Scene, *, traced: tuple[Traced, ...] = ()) -> tuple[Bound, ...]:
    """For each phase the certificate that no torque within limits holds it with a larger margin (`squeeze.bound`), or
    that of the statics for a phase that holds the object.

    Derivation, section 8: a tuple of `Bound`, one a phase, with `value` [N], and `s` and `share` of the wire where
    it is tight.

    >>> [f"{float(bound.value):.3f} N" for bound in wa.bounds(wa.load("heptagon"))]
    ['0.966 N', '0.838 N']
    """
    traced = traced or trace(scene)
    begins = [True, *(p.arrive != "moving" for p in scene.phases[:-1])]
    rows = zip(traced, scene.phases, begins, strict=True)

    def top(at, phase, begin):
        if phase.arrive != "hold":
            return _bound(at.table, phase.duration, array(begin), array(phase.arrive == "rest"))
        known = int(at.table.status) == Status.OK
        if not known:
            return Bound(jnp.asarray(-np.inf), at.table.breaks[0], jnp.zeros(()))
        balance, departure = balance_at_start(scene, phase, at)
        return Bound(jnp.asarray(balance.best(departure).margin), at.table.breaks[0], jnp.zeros(()))

    return tuple(top(*row) for row in rows)


def optimise(
    scene: Scene,
    *,
    knots: int = 51,
    steps: int = 160,
    rate_limit: float | None = None,
    durations: tuple[float, float] | None = None,
    passing: float = PASSING,
    optimiser: optax.GradientTransformation | None = None,
    tolerance: float = 1e-3,
    callback: Callable[[Step], None] | None = None,
    traced: tuple[Traced, ...] = (),
) -> Optimised:
    """Find the torque schedule with the largest compressive margin by gradient descent through the simulation.

    Each phase must arrive at its planned end in time, at rest or, where the next takes over, `moving`; `knots` torques
    a joint and phase, evenly spaced in time, are linear in between. The scene's torque limits hold, and `rate_limit`
    [N m/s] if given. `durations = (shortest, longest)` lets each phase choose its own. Formations that take over at
    speed are entered with at least `passing` times their phase's mean speed (wire over duration): an object that hardly
    moves where its formation changes may as well stop short of it. `optimiser` replaces the interior point by any optax
    optimiser (`descent.projected`). A phase stops when its margin comes within `tolerance` of the bound or no longer
    improves by that share, or after `steps`. `callback` sees every step; `traced` reuses the result of `trace`. A phase
    that holds the object keeps its duration and gets the best torque of its statics, approached as fast as `rate_limit`
    allows. Where no torque can hold a formation, nothing is searched and the status says so.

    Derivation, section 9. Raises RuntimeError without float64.

    >>> found = wa.optimise(wa.load("heptagon"))
    >>> found.result.status.label, [f"{share:.2f}" for share in found.reached]
    ('ok', ['1.00', '1.00'])
    """
    require_x64()
    joint, rows = _groups(scene), rounded(knots * len(scene.phases))
    ready = compile_ahead(scene, knots=knots, optimiser=optimiser)
    traced = traced or trace(scene)
    tops = bounds(scene, traced=traced)
    for one in ready:
        one.result()
    found, history, stopped = [], [], []
    for group in joint:
        parts = tuple(scene.phases[k] for k in group)
        before = found[-1].values[-1] if rate_limit is not None and found else None
        if parts[0].arrive == "hold":
            found.append(_steady(scene, parts[0], traced[group[0]], knots, rate_limit, before))
            stopped.append("the best torque of a linear programme")
            continue
        own = [traced[k] for k in group], [tops[k] for k in group]
        task = _Task(group[0], parts, *own, knots, rows, steps, tolerance)
        limits = _limits(task, rate_limit, durations, passing, before)
        method = _method(optimiser, len(group))
        schedules, why, taken = _optimise_group(scene, task, limits, before, method, callback)
        found += schedules
        stopped += [why] * len(group)
        history += taken
    lengths = [float(np.asarray(f.times)[-1]) for f in found]
    phases = tuple(replace_duration(p, t) for p, t in zip(scene.phases, lengths, strict=True))
    scene = eqx.tree_at(lambda s: s.phases, scene, phases)
    torque = _in_turn(found)
    result = describe(scene, torque, traced, outcomes(scene, torque, traced, Integration()))
    return Optimised(scene, torque, result, tops, tuple(stopped), tuple(history))


def compile_ahead(
    scene: Scene, *, knots: int = 51, optimiser: optax.GradientTransformation | None = None
) -> list[Future[None]]:
    """Begin to compile the programs of `optimise` in threads of their own, as can be done while wires are traced."""
    rows = rounded(knots * len(scene.phases))
    sizes = {len(group) for group in _groups(scene) if scene.phases[group[0]].arrive != "hold"}
    return [_ahead(n, knots, rows, _method(optimiser, n)) for n in sorted(sizes)]


def _groups(scene: Scene) -> list[list[int]]:
    """Phases that follow one another at speed have one problem together."""
    groups, fresh = [], True
    for index, phase in enumerate(scene.phases):
        groups = [*groups, [index]] if fresh else [*groups[:-1], [*groups[-1], index]]
        fresh = phase.arrive != "moving"
    return groups


@dataclass(frozen=True)
class _Task:
    index: int
    phases: tuple[Phase, ...]
    traced: list[Traced]
    tops: list[Bound]
    knots: int
    rows: int  # of the whole plan's schedule: one of the same size shares its program
    steps: int
    tolerance: float

    @property
    def durations(self) -> np.ndarray:
        return np.array([float(p.duration) for p in self.phases])

    @property
    def bounds(self) -> np.ndarray:
        return np.array([float(top.value) for top in self.tops])

    def problem(self, limits: Limits) -> Problem:
        """What is descended on."""
        tables = _stacked([at.table for at in self.traced])
        return Problem(self.index, tables, self.bounds, limits, self.steps, self.tolerance)


def _steady(scene: Scene, phase: Phase, at: Traced, knots: int, rate_limit=None, before=None) -> Torque:
    """The best torque to hold an object, from time 0; from the torque `before` straight there at a limited rate.

    The margin is concave in the torque, so that it is nowhere on that way less than at both its ends.
    """
    if int(at.table.status) != Status.OK:
        return _evenly(float(phase.duration), np.zeros((knots, 2)))
    balance, departure = balance_at_start(scene, phase, at)
    best = balance.steadiest(departure).torque
    if before is None or rate_limit is None:
        return _evenly(float(phase.duration), np.tile(best, (knots, 1)))
    way = best - np.asarray(before)
    reach = rate_limit * np.linspace(0.0, float(phase.duration), knots)
    share = np.minimum(reach / max(np.abs(way).max(), 1e-300), 1.0)
    return _evenly(float(phase.duration), np.asarray(before) + share[:, None] * way)


def _optimise_group(
    scene, task: _Task, limits: Limits, before, method, callback
) -> tuple[list[Torque], str, list[Step]]:
    """Descend from one start after the other, until one comes near the bound or two agree.

    Returns the best schedules (each from time 0), why their descent stopped, and the steps taken.
    """
    blank_values = np.zeros((task.knots, 2))
    for at in task.traced:
        if int(at.table.status) != Status.OK:
            why = f"the wire cannot be followed: {Status(int(at.table.status)).label}"
            return [_evenly(t, blank_values) for t in task.durations], why, []
    begins = guesses(task.traced, task.durations, task.knots, TORQUE_SHARE)
    best = begins[0]
    weakest = int(np.argmin(task.bounds))
    if task.bounds[weakest] <= 0:
        where = 100 * float(task.tops[weakest].share)
        why = f"no torque within limits holds this formation at {where:.0f} % of its wire"
        return _schedules(task, best), why, []
    problem, best_key, reason, history = task.problem(limits), (False, -np.inf), "", []
    for number, start in enumerate(begins):
        if before is not None:
            limit = task.traced[0].table.torque_limit
            start = eqx.tree_at(lambda p: p.torque, start, start.torque.at[0, 0].set(before / limit))
        p, why, taken = descend(problem, start, number, method, callback)
        history += taken
        key = _honest(scene, task, p)
        agree = key[0] and best_key[0] and abs(key[1] - best_key[1]) <= task.tolerance
        if key > best_key:
            best, best_key, reason = p, key, why
        if agree or (best_key[0] and best_key[1] >= GOOD):
            break
    reached = best_key[0] and best_key[1] >= 1 - task.tolerance
    return _schedules(task, best), f"within {task.tolerance:g} of the bound" if reached else reason, history


@functools.cache
def _ahead(phases: int, knots: int, rows: int, method) -> Future[None]:
    beside = ThreadPoolExecutor(1)
    future = beside.submit(_compile, phases, knots, rows, method)
    beside.shutdown(wait=False)  # the thread ends when it has done this
    return future


def _compile(phases: int, knots: int, rows: int, method) -> None:
    """Run the descent's programs once, on blank tables."""
    table = blank(Resolution())
    tables = _stacked([table] * phases)
    plain = (np.full(2, np.inf), _ONE, _ONE, 0 * _ONE, np.zeros((phases, knots), bool), np.ones(phases))
    limits = Limits(*(array(a) for a in plain))
    empty = (np.zeros((phases, knots, 2)), np.zeros((phases, knots, 2)), np.zeros(phases))
    p = Variables(*(array(a) for a in empty))
    advance(begin(p, method), tables, limits, HOW, method)
    zero, one = array(0.0), array(1.0)
    run(table, padded(_evenly(1.0, empty[0][0]), rows), zero, one, Integration(), "rest")


@functools.cache
def _method(optimiser, phases: int):
    """One transformation for every use, so that programs are not compiled again."""
    return interior_point(phases) if optimiser is None else projected(optimiser)


_ONE = np.ones(())


def _evenly(duration, values) -> Torque:
    return Torque(array(np.linspace(0.0, float(duration), len(values))), array(values))


_stacked = jax.jit(stacked)


def _schedules(task: _Task, p: Variables) -> list[Torque]:
    """Each phase's schedule, from time 0."""
    limits = np.stack([np.asarray(at.table.torque_limit) for at in task.traced])
    values, lengths = np.asarray(p.torque) * limits[:, None], np.exp(np.asarray(p.log_duration))
    return [_evenly(length, rows) for length, rows in zip(lengths, values, strict=True)]


def _honest(scene: Scene, task: _Task, p: Variables) -> tuple[bool, float]:
    """Whether a simulation of the schedules says `ok`, holds included, and the least margin over its bound."""
    start, shares, fine, arriving = 0.0, [], [], None
    torque = _in_turn(_schedules(task, p))
    schedule = padded(torque, task.rows)
    ends = np.cumsum(np.exp(np.asarray(p.log_duration)))
    for phase, at, end, top in zip(task.phases, task.traced, ends, task.bounds, strict=True):
        one = run(at.table, schedule, start, end - start, Integration(), phase.arrive, arriving)
        start += float(one.duration) * float(np.asarray(one.motion.share)[int(one.motion.count)])
        arriving = one.leaving if phase.arrive == "moving" else None
        held = stays(scene, torque, phase, at, one)
        fine.append(int(one.verdict.status) == Status.OK and all(h.lost is None for h in held))
        shares.append(float(one.score.margin) / top)
    least = min(shares)
    return all(fine), least if np.isfinite(least) else -np.inf


def _in_turn(schedules: list[Torque]) -> Torque:
    """Schedules one after the other; a step where one follows another."""
    begins = np.cumsum([0.0, *(float(np.asarray(s.times)[-1]) for s in schedules[:-1])])
    times = [begin + np.asarray(s.times) for begin, s in zip(begins, schedules, strict=True)]
    return Torque(*(array(np.concatenate(rows)) for rows in (times, [np.asarray(s.values) for s in schedules])))


_bound = Program(bound)


def _limits(task: _Task, rate_limit, durations, passing, before) -> Limits:
    lengths = task.durations
    shortest, longest = durations or (lengths.min(), lengths.min())
    rate = np.full(2, np.inf if rate_limit is None else float(rate_limit))
    pinned = np.zeros((len(lengths), task.knots), bool)
    pinned[0, 0] = before is not None
    unit = np.maximum(task.bounds, 1e-300)
    return Limits(*(array(a) for a in (rate, shortest * _ONE, longest * _ONE, passing * _ONE, pinned, unit)))
