"""Optimise: the torque schedule of a plan with the largest compressive margin.

Phases that begin and end at rest have each their own problem; those that follow one another at speed have one together;
those that hold the object have the best torque of its statics (`holding`). Problems are solved side by side.
It starts from the quasi-static torques of a smooth motion, descends (`pacing`) while the temperature of the smooth
margin falls, and keeps the best schedule whose honest simulation succeeds.
"""

import itertools
import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optax

from wholearm_jax.core import (
    BackgroundTask,
    CachedJit,
    Status,
    as_device_array,
    compile_in_background,
    require_positive,
    require_x64,
    wait_for,
)
from wholearm_jax.dynamics import placeholder_dynamics
from wholearm_jax.margin import MarginBound, margin_upper_bound
from wholearm_jax.model import (
    Arrival,
    Phase,
    Scene,
    TorqueSchedule,
    concatenate_schedules,
    replace_duration,
    round_up,
    uniform_schedule,
)
from wholearm_jax.optimisation.constraints import Limits
from wholearm_jax.optimisation.coupled_phases import (
    SHORTEST,
    TORQUE_SHARE,
    CoupledPhases,
    OptimiseOptions,
    descent_method,
    solve_coupled_phases,
    stacked_tables,
)
from wholearm_jax.optimisation.initial_guess import initial_guesses
from wholearm_jax.optimisation.iteration import init_solver, take_step
from wholearm_jax.optimisation.multiple_shooting import extra_parts
from wholearm_jax.optimisation.plan_transitions import holding_schedule, rest_transitions
from wholearm_jax.optimisation.rest_transition import RestTransition
from wholearm_jax.optimisation.solver import INTERVAL_OPTIONS, IterationRecord
from wholearm_jax.optimisation.variables import Variables
from wholearm_jax.phases import (
    Result,
    TracedPhase,
    build_result,
    precompile_simulation,
    simulate_phases,
    statics_at_start,
    trace,
)
from wholearm_jax.simulation import IntegratorOptions, with_step_capacity
from wholearm_jax.tracing import Resolution

MAX_DWELLS = (0.25, 0.1)  # shares of a phase for which its object may wait before it sets out, where rates are limited
MIN_TRANSITION_SPEED = 0.2  # least speed with which a phase is entered that does not begin at rest, over its mean speed


@dataclass(frozen=True)
class OptimisationResult:
    """An optimised plan: the simulated `result`, for each phase its `bound` [N] and why the descent stopped.

    `scene` carries the durations that were found. `history` holds every step.
    """

    scene: Scene
    torque: TorqueSchedule
    result: Result
    bounds: tuple[MarginBound, ...]
    stopped: tuple[str, ...]
    history: tuple[IterationRecord, ...]

    @property
    def bound_fraction(self) -> tuple[float, ...]:
        """The share of its bound that each phase reached; NaN where the bound is not positive."""
        pairs = zip(self.result.phases, self.bounds, strict=True)
        return tuple(p.margin / float(b.value) if float(b.value) > 0 else float("nan") for p, b in pairs)


def quasistatic(scene: Scene, *, knots: int = 51, traced: tuple[TracedPhase, ...] = ()) -> TorqueSchedule:
    """The quasi-static torques: at each knot the best squeeze for an even rest-to-rest motion, in closed form.

    The motion's speed is `v ~ u^p (1 - u)^q` in `u = t / duration`: the even `p = q = 1` unless another of
    `SPEED_PROFILES`
    allows a larger margin. As the inverse dynamics at the knots only, the schedule carries the object near the wire's
    end, not exactly to it. A phase that holds the object gets its best torque.

    Derivation, section 8. Returns `knots` rows a phase. Raises ValueError for fewer than two.

    >>> wa.quasistatic(wa.load("heptagon"), knots=11).values.shape
    (22, 2)
    """
    require_knots(knots)
    traced = traced or trace(scene)

    def torques(at, phase):
        if phase.arrive is Arrival.HOLD:
            return holding_schedule(scene, phase, at, knots)
        start = initial_guesses([at.dynamics], [float(phase.duration)], knots, 1.0)[0]
        return uniform_schedule(float(phase.duration), at.dynamics.torque_limit * start.torque[0])

    return concatenate_schedules([torques(*pair) for pair in zip(traced, scene.phases, strict=True)])


def bounds(scene: Scene, *, traced: tuple[TracedPhase, ...] = ()) -> tuple[MarginBound, ...]:
    """For each phase the certificate that no torque within limits holds it with a larger margin
    (`squeeze.margin_upper_bound`), or
    that of the statics for a phase that holds the object; `-inf` for a wire that could not be traced.

    Derivation, section 8: a tuple of `MarginBound`, one a phase, with `value` [N], and `s` and `share` of the wire
    where
    it is tight.

    >>> [f"{float(bound.value):.3f} N" for bound in wa.bounds(wa.load("heptagon"))]
    ['0.966 N', '0.838 N']
    """
    traced = traced or trace(scene)
    begins = [True, *(p.arrive is not Arrival.MOVING for p in scene.phases[:-1])]
    rows = zip(traced, scene.phases, begins, strict=True)

    def top(at, phase, begin):
        if int(at.dynamics.status) != Status.OK:
            return MarginBound(jnp.asarray(-np.inf), at.dynamics.breakpoints[0], jnp.zeros(()))
        if phase.arrive is not Arrival.HOLD:
            told = as_device_array(begin), as_device_array(phase.arrive is Arrival.AT_REST), _rolling(phase)
            return _bound(at.dynamics, phase.duration, *told)
        balance, departure = statics_at_start(scene, phase, at)
        return MarginBound(jnp.asarray(balance.best(departure).margin), at.dynamics.breakpoints[0], jnp.zeros(()))

    return tuple(top(*row) for row in rows)


def optimise(
    scene: Scene,
    *,
    knots: int = 51,
    steps: int = 160,
    rate_limit: float | None = None,
    durations: tuple[float, float] | None = None,
    passing: float = MIN_TRANSITION_SPEED,
    optimiser: optax.GradientTransformation | None = None,
    tolerance: float = 1e-3,
    callback: Callable[[IterationRecord], None] | None = None,
    traced: tuple[TracedPhase, ...] = (),
) -> OptimisationResult:
    """Find the torque schedule with the largest compressive margin by gradient descent through the simulation.

    Each phase must arrive at its planned end in time, `moving` where the next takes over and else at rest, also where
    the plan would allow any speed (`caught`, and a last phase that is `moving`); `knots` torques a joint and phase,
    evenly spaced over the time for which it moves, are linear in between. The scene's torque limits hold, and
    `rate_limit` [N m/s] if given: then torques do not step where phases change either, and an object may wait, held by
    friction, for up to a quarter of a phase until the torque sets it out (`rest_transition`). `durations = (shortest,
    longest)` lets each phase choose its own. Formations that take over at speed are entered with at least `passing`
    times their phase's mean speed (wire over duration): an object that hardly moves where its formation changes may as
    well stop short of it. `optimiser` replaces the interior point by any optax optimiser (`projected_gradient`).
    A phase stops when its margin comes within `tolerance` of the bound or no longer improves by that share, or after
    `steps`.
    `callback` sees every step, one at a time, but of several phases in no particular order: those that do not follow at
    speed are descended on side by side, each in a thread of its own. `traced` reuses the result of `trace`. A phase
    that holds the object keeps its duration and gets the best torque of its statics, approached and left as fast as
    `rate_limit` allows. Where no torque can hold a formation, nothing is searched and the status says so.

    Derivation, section 9. Raises RuntimeError without float64, ValueError for fewer than two `knots`, and for numbers
    that are not positive.

    >>> found = wa.optimise(wa.load("heptagon"))
    >>> found.result.status.label, [f"{share:.2f}" for share in found.bound_fraction]
    ('ok', ['1.00', '1.00'])
    """
    require_x64()
    require_knots(knots)
    require_positive(steps=steps, tolerance=tolerance, rate_limit=np.inf if rate_limit is None else rate_limit)
    if durations is not None and not 0 < durations[0] <= durations[1]:
        raise ValueError("durations are (shortest, longest), positive and in this order")
    if durations is not None and durations[0] == durations[1]:
        scene, durations = _lasting(scene, durations[0]), None
    compiled = precompile_optimise(scene, knots=knots, optimiser=optimiser)
    traced = traced or trace(scene)
    if any(int(at.dynamics.status) == Status.OK for at in traced):
        wait_for(*compiled)
    # A bound covers speeds as multiples of a length a duration: of the shortest that a phase may choose.
    least = scene if durations is None else _lasting(scene, max(durations[0], SHORTEST * durations[1]))
    tops = bounds(least, traced=traced)
    rows = _rows(scene, knots)
    told = callback and _in_turn_called(callback)
    wanted = OptimiseOptions(knots, rows, steps, rate_limit, durations, passing, optimiser, tolerance, told)
    found = []
    for lead in MAX_DWELLS if rate_limit is not None else MAX_DWELLS[:1]:
        found.append(_attempt(scene, traced, tops, wanted, lead))
        if found[-1].result.status is Status.OK:
            return found[-1]
    return max(found, key=lambda one: one.result.margin)


def require_knots(knots: int) -> None:
    """Raise ValueError for too few to be a schedule."""
    if knots < 2:
        raise ValueError(f"knots must be at least 2, not {knots}")


def _attempt(scene: Scene, traced, tops, wanted: OptimiseOptions, lead: float) -> OptimisationResult:
    """All groups of phases side by side, objects waiting at most a share `lead` of a phase before they set out."""
    groups = _groups(scene)
    changes: list[RestTransition | None] = [None] * (len(groups) - 1)
    if wanted.rate_limit is not None:
        changes = rest_transitions(scene, groups, traced, tops, wanted.rate_limit, lead, wanted.durations)
    with ThreadPoolExecutor(os.cpu_count()) as threads:
        one = partial(_part, scene, traced, tops, wanted)
        parts = list(threads.map(one, groups, itertools.pairwise([None, *changes, None])))
    found = [schedule for schedules, _, _ in parts for schedule in schedules]
    stopped = [why for schedules, why, _ in parts for _ in schedules]
    history = [step for *_, taken in parts for step in taken]
    lengths = [float(np.asarray(f.times)[-1]) for f in found]
    phases = tuple(replace_duration(p, t) for p, t in zip(scene.phases, lengths, strict=True))
    scene = eqx.tree_at(lambda s: s.phases, scene, phases)
    torque = concatenate_schedules(found)
    result = build_result(
        scene,
        torque,
        traced,
        simulate_phases(scene, torque, traced, with_step_capacity(IntegratorOptions(), wanted.knots)),
    )
    return OptimisationResult(scene, torque, result, tops, tuple(stopped), tuple(history))


def _part(
    scene: Scene,
    traced,
    tops,
    wanted: OptimiseOptions,
    group: list[int],
    ends: tuple[RestTransition | None, RestTransition | None],
) -> tuple[list[TorqueSchedule], str, list[IterationRecord]]:
    """One group of phases, given how it takes over and hands over: schedules, why their descent stopped, its steps."""
    phases, (begin, end) = tuple(scene.phases[k] for k in group), ends
    if phases[0].arrive is Arrival.HOLD:
        held = holding_schedule(scene, phases[0], traced[group[0]], wanted.knots, wanted.rate_limit, begin, end)
        return [held], "the best torque of a linear programme", []
    paths, most = [traced[k] for k in group], [tops[k] for k in group]
    return solve_coupled_phases(scene, CoupledPhases(group[0], phases, paths, most, begin, end, wanted))


def _in_turn_called(callback: Callable[[IterationRecord], None]) -> Callable[[IterationRecord], None]:
    """The same, called by one thread at a time."""
    turn = threading.Lock()

    def call(step: IterationRecord) -> None:
        with turn:
            callback(step)

    return call


def _lasting(scene: Scene, duration: float) -> Scene:
    """The same plan, but for the duration of all phases that move the object."""
    phases = (p if p.arrive is Arrival.HOLD else replace_duration(p, duration) for p in scene.phases)
    return eqx.tree_at(lambda s: s.phases, scene, tuple(phases))


def precompile_optimise(
    scene: Scene, *, knots: int = 51, optimiser: optax.GradientTransformation | None = None
) -> tuple[BackgroundTask, ...]:
    """Compile what `optimise` runs in a thread of its own, while wires are traced; it is to be waited for."""
    sizes = sorted({len(group) for group in _groups(scene) if scene.phases[group[0]].arrive is not Arrival.HOLD})
    rolling = sorted({_rolling(p) for p in scene.phases if p.arrive is not Arrival.HOLD})
    squeezes = compile_in_background(_squeeze_blank, tuple(sizes), tuple(rolling), knots)
    descents = [compile_in_background(_advance_blank, n, knots, optimiser) for n in sizes]
    return (
        squeezes,
        *descents,
        compile_in_background(
            precompile_simulation, _rows(scene, knots), with_step_capacity(IntegratorOptions(), knots)
        ),
    )


def _rows(scene: Scene, knots: int) -> int:
    """Room for the whole plan's schedule, and for what stands before its phases where rates are limited."""
    return round_up((knots + 1) * len(scene.phases))


def _groups(scene: Scene) -> list[list[int]]:
    """Phases that follow one another at speed have one problem together."""
    groups, fresh = [], True
    for index, phase in enumerate(scene.phases):
        groups = [*groups, [index]] if fresh else [*groups[:-1], [*groups[-1], index]]
        fresh = phase.arrive is not Arrival.MOVING
    return groups


def _rolling(phase: Phase) -> int:
    """How many contacts of a phase roll."""
    return int(np.asarray(phase.formation.tangential).sum())


def _squeeze_blank(sizes: tuple[int, ...], rolling: tuple[int, ...], knots: int) -> None:
    """Make the bounds and starts of groups of such sizes on tables that have no wire."""
    dynamics, one = placeholder_dynamics(Resolution()), as_device_array(1.0)
    for count in rolling:
        _bound(dynamics, one, as_device_array(True), as_device_array(True), count)
    for phases in sizes:
        initial_guesses([dynamics] * phases, np.ones(phases), knots, TORQUE_SHARE)


def _advance_blank(phases: int, knots: int, optimiser: optax.GradientTransformation | None) -> None:
    """Take one step of a descent on tables that have no wire."""
    phase_dynamics = stacked_tables([placeholder_dynamics(Resolution())] * phases)
    method = descent_method(optimiser, phases, extra_parts(phase_dynamics))
    each = np.ones(phases)
    plain = (np.full(2, np.inf), each, each, np.zeros(()), np.zeros((phases, knots), bool), each)
    limits = Limits(*(as_device_array(a) for a in plain))
    empty = (np.zeros((phases, knots, 2)), np.zeros((phases, knots, 2)), np.zeros(phases))
    p = Variables(*(as_device_array(a) for a in empty))
    take_step(init_solver(p, method), phase_dynamics, limits, INTERVAL_OPTIONS, method)


_bound = CachedJit(margin_upper_bound)
