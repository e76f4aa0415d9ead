r"""The optimiser: the torque schedule of a plan with the largest compressive margin.

How its modules work together:

1. *Problems* (`coupled_phases`). Phases that start and end at rest are problems of their own, solved side by side;
   those that follow one another at speed are one problem. Where torque rates are limited, linear programmes first fix
   the torques between problems (`rest_transition`, `plan_transitions`). A phase that holds the object needs no more.
2. *Initial guesses* (`convex_start`, `initial_guess`): the motion of the convex optimum, with the best quasi-static
   torques, and a smooth one. An object with much more time than it needs waits first, held by friction; one with more
   time than it needs does so where a motion that takes all of it would need torques that no motor is as exact as.
3. *Multiple shooting* (`variables`, `multiple_shooting`). The variables `p` are the torques and states at the knots and
   the durations. Each interval between two knots is simulated from its own state; that it ends in the state at the next
   knot is an equation `e(p) = 0`. Instability of the motion thus cannot grow beyond one interval.
4. *Constraints* (`constraints`): forces at many times of each interval, speeds, torques, rates and durations are the
   inequalities `g(p) >= a m`, where the level `m` of the margin counts for forces only.
5. *Linearisation* (`linearisation`). An interval depends on seven variables: seven directions of forward mode give the
   Jacobians `J` of `g` and `E` of `e`, whatever the number of knots.
6. *Interior point* (`interior_point`). A barrier replaces the inequalities, with `mu` to be reduced to nearly zero:
   maximise `m + mu sum_i w_i log(g_i - a_i m)` subject to `e(p) = 0`. Slacks and multipliers are variables of their own
   (primal-dual); with them eliminated, a Newton step of `(p, m)` minimises a quadratic function with the Gauss-Newton
   Hessian `J^T S J` subject to `E dp = -e`.
7. *Riccati recursion* (`lq_problem`, `riccati`). This quadratic problem is linear-quadratic control: state and torques
   at a knot are the state, torques at the next knot the control; level, durations and end multipliers are parameters
   that all stages share. A backward and a forward pass solve it in time proportional to the number of knots.
8. *Globalisation* (`retraction`, `iteration`, `solver`). A step stays within the limits (fraction to the boundary) and
   follows a curve on which accelerations change evenly (retraction). One that cannot be simulated is shortened. Full
   steps come first; iterates that cycle are damped by half steps, a merit test and regularisation. Once the margin has
   settled, steps only close the equations. As `mu` falls, the iterates converge to the largest margin.
9. *Verification*. A simulation of the schedule alone decides whether a solution counts and what its margin is. Where it
   stays below the bound (`plan_limits`), another initial guess is tried, until two agree.

Derivation: sections 8 and 9 of `docs/derivation.md`.
"""

import itertools
import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import equinox as eqx
import numpy as np
import optax

from wholearm_jax.core import Status, as_device_array, on_host, require_positive, require_x64, wait_for
from wholearm_jax.margin import MarginBound
from wholearm_jax.model import (
    Arrival,
    Phase,
    Scene,
    TorqueSchedule,
    concatenate_schedules,
    replace_duration,
    uniform_schedule,
)
from wholearm_jax.optimisation.advice import Search, explain
from wholearm_jax.optimisation.best_motion import convex_bounds
from wholearm_jax.optimisation.convex_start import StartOptions, convex_starts, hurried_start
from wholearm_jax.optimisation.coupled_phases import (
    GOOD_BOUND_FRACTION,
    MIN_DURATION_FRACTION,
    CoupledPhases,
    GroupSolution,
    OptimiseOptions,
    schedule_rows,
    solve_coupled_phases,
)
from wholearm_jax.optimisation.hand_over_limits import hand_over_row_count
from wholearm_jax.optimisation.plan_limits import (
    limit_by_hand_overs,
    margins_by_either_contact,
    tighten_bounds,
    too_short_phases,
)
from wholearm_jax.optimisation.plan_transitions import holding_schedule, rest_transitions
from wholearm_jax.optimisation.precompilation import precompile_optimise
from wholearm_jax.optimisation.quasistatic_plan import DEFAULT_KNOTS, bounds, require_knots
from wholearm_jax.optimisation.rest_transition import RestTransition
from wholearm_jax.optimisation.shortest_plan import shortest_plan
from wholearm_jax.optimisation.solver import IterationRecord
from wholearm_jax.phases import (
    HandOver,
    Result,
    TracedPhase,
    build_result,
    find_hand_overs,
    group_phases,
    idle_torques,
    simulate_phases,
    simulate_with_enough_steps,
    trace,
)
from wholearm_jax.simulation import IntegratorOptions, with_step_capacity

MOST_KNOTS = 201  # of a phase that stays below its bound with fewer, where their number is not given
MAX_DWELLS = (0.25, 0.1)  # fractions of a phase for which the object may wait before it starts, at limited rates
MIN_TRANSITION_SPEED = 0.2  # least speed with which a phase is entered at speed, over its mean speed


@dataclass(frozen=True)
class OptimisationResult:
    """An optimised plan."""

    scene: Scene  # with the durations that were found
    torque: TorqueSchedule
    result: Result  # of its simulation
    bounds: tuple[MarginBound, ...]  # of each phase
    stopped: tuple[str, ...]  # why the iterations of each phase ended
    history: tuple[IterationRecord, ...]  # all iterations
    knots: int  # torque knots of the phase that has most

    @property
    def bound_fraction(self) -> tuple[float, ...]:
        """The fraction of its bound that each phase reached; NaN where the bound is not positive."""
        pairs = zip(self.result.phases, self.bounds, strict=True)
        return tuple(p.margin / float(b.value) if float(b.value) > 0 else float("nan") for p, b in pairs)


class PlanLimits(NamedTuple):
    """What no schedule of a plan can exceed."""

    pointwise: tuple[MarginBound, ...]  # of each phase
    bounds: tuple[MarginBound, ...]  # the smaller of that and the convex one
    hand_overs: list[HandOver | None]  # with which the phases begin
    by_either: np.ndarray  # largest margins [N] that the hand-overs at their ends leave
    too_short: dict[int, float]  # shortest duration [s] of each phase that has less time

    def reachable(self, phase: int) -> MarginBound:
        """Return the bound of a phase, or the margin that the hand-overs at its ends leave where that is smaller."""
        bound = self.bounds[phase]
        least = min(float(bound.value), self.by_either[phase])
        return eqx.tree_at(lambda of: of.value, bound, as_device_array(least))


@on_host("optimise outside, and transform wholearm_jax.margin with the schedule")
def optimise(
    scene: Scene,
    *,
    knots: int | None = None,
    steps: int = 160,
    rate_limit: float | None = None,
    durations: tuple[float, float] | None = None,
    margin: float | None = None,
    passing: float = MIN_TRANSITION_SPEED,
    optimiser: optax.GradientTransformation | None = None,
    tolerance: float = 1e-3,
    callback: Callable[[IterationRecord], None] | None = None,
    traced: tuple[TracedPhase, ...] = (),
) -> OptimisationResult:
    """Find the torque schedule with the largest compressive margin (derivation, section 9).

    Each phase must arrive at its planned end in time: at speed where the next phase continues the motion, otherwise at
    rest, also where the plan allows any speed. Torques are linear between evenly spaced knots and stay within the
    scene's limits. There are 51 knots a phase, and 201 where a phase between rests stays more than 1 % below its bound
    with 51. A phase that holds the object keeps its duration and gets the best torque of its statics. Where
    no torque can hold a contact formation, nothing is searched and the status says so.

    Args:
        scene: the plan.
        knots: torque knots of every phase instead, at least two.
        steps: most iterations from each initial guess.
        rate_limit: largest torque rate [N m/s]. Torques then do not jump between phases either, and the object may
            wait, held by friction, for up to a quarter of a phase until the torque moves it (`rest_transition`).
        durations: (shortest, longest) [s], within which each phase chooses its own.
        margin: least force of every contact [N]: find the shortest durations with it, in place of the scene's.
        passing: least speed with which a phase is entered at speed, over its mean speed: an object that hardly moves
            where its contact formation changes may as well stop short of it.
        optimiser: replaces the interior point by any optax optimiser (`projected_gradient`).
        tolerance: of the margin, over its bound: iterations end within it of the bound, or where they gain less.
        callback: called with each iteration, one at a time; those of several problems come in no particular order.
        traced: the result of `trace`, to reuse it.

    Returns:
        The schedule, its simulation, and the bounds.

    Raises:
        RuntimeError: without float64.
        ValueError: for fewer than two knots, for numbers that are not positive, and for a `margin` that no motion has.

    >>> optimum = wa.optimise(wa.load("heptagon"))
    >>> optimum.result.status.label, [f"{fraction:.2f}" for fraction in optimum.bound_fraction]
    ('ok', ['1.00', '1.00'])
    """
    require_x64(scene)
    first_knots = DEFAULT_KNOTS if knots is None else knots
    require_knots(first_knots)
    rate_limit = None if rate_limit == np.inf else rate_limit
    require_positive(steps=steps, tolerance=tolerance, rate_limit=np.inf if rate_limit is None else rate_limit)
    parked = next((phase.name for phase in scene.phases if phase.formation.away), None)
    if rate_limit is not None and parked is not None:
        raise ValueError(f"rate_limit: in phase '{parked}' a finger is away, whose torque jumps to zero")
    if margin is not None and (durations is not None or not margin >= 0):
        raise ValueError("margin is a number of at least 0, and excludes durations")
    if durations is not None and not 0 < durations[0] <= durations[1]:
        raise ValueError("durations are (shortest, longest), positive and in this order")
    if durations is not None and durations[0] == durations[1]:
        scene, durations = _with_durations(scene, durations[0]), None

    # Compile while paths are traced.
    compiled = precompile_optimise(scene, knots=first_knots, optimiser=optimiser)
    traced = traced or trace(scene)
    if any(int(path.dynamics.status) == Status.OK for path in traced):
        wait_for(*compiled)
    if margin is not None:
        again = {
            "knots": first_knots,
            "steps": steps,
            "rate_limit": rate_limit,
            "passing": passing,
            "optimiser": optimiser,
        }
        solve = partial(optimise, **again, tolerance=tolerance, callback=callback, traced=traced)
        return shortest_plan(solve, scene, margin, traced)

    limits = _plan_limits(scene, durations, traced)
    refines = knots is None and rate_limit is None and optimiser is None
    most_knots = MOST_KNOTS if refines else first_knots
    rows = schedule_rows(len(scene.phases), first_knots), hand_over_row_count(scene, first_knots)
    heard = callback and _one_at_a_time(callback)
    further = steps, rate_limit, durations, passing, optimiser, tolerance, heard
    options = OptimiseOptions(first_knots, most_knots, *rows, *further)
    results = []
    for max_dwell in MAX_DWELLS if rate_limit is not None else MAX_DWELLS[:1]:
        results.append(_solve_plan(scene, traced, limits, options, max_dwell))
        if results[-1].result.status is Status.OK:
            return results[-1]
    return max(results, key=lambda plan: plan.result.margin)


def _plan_limits(scene: Scene, durations: tuple[float, float] | None, traced: tuple[TracedPhase, ...]) -> PlanLimits:
    """Bound what schedules reach in the scene's durations, or in any of a range."""
    # The pointwise bound covers speeds up to multiples of a path length a duration: take the shortest that a phase may
    # choose; for the convex one, the longest.
    shortest = scene
    if durations is not None:
        shortest = _with_durations(scene, max(durations[0], MIN_DURATION_FRACTION * durations[1]))
    pointwise, longest = bounds(shortest, traced=traced), scene
    if durations is not None:
        longest = _with_durations(scene, durations[1])
    motions = convex_bounds(longest, traced=traced)
    hand_overs = find_hand_overs(scene, traced)
    return PlanLimits(
        pointwise,
        limit_by_hand_overs(tighten_bounds(scene, pointwise, motions, traced), hand_overs, traced),
        hand_overs,
        margins_by_either_contact(hand_overs),
        too_short_phases(longest, pointwise, motions, traced),
    )


def _solve_plan(
    scene: Scene,
    traced: tuple[TracedPhase, ...],
    limits: PlanLimits,
    options: OptimiseOptions,
    max_dwell: float,
) -> OptimisationResult:
    """Solve all groups of phases side by side, with dwells of at most a fraction `max_dwell` of a phase."""
    groups, margin_bounds = group_phases(scene), limits.bounds
    transitions: list[RestTransition | None] = [None] * (len(groups) - 1)
    if options.rate_limit is not None:
        ranges = options.rate_limit, max_dwell, options.durations
        transitions = rest_transitions(scene, groups, traced, margin_bounds, *ranges)
    with ThreadPoolExecutor(os.cpu_count()) as threads:
        solve_group = partial(_solve_group, scene, traced, limits, options)
        solutions = list(threads.map(solve_group, groups, itertools.pairwise([None, *transitions, None])))
    schedules = [schedule for found in solutions for schedule in found.schedules]
    schedules = [_without_idle_torques(*each) for each in zip(scene.phases, schedules, strict=True)]
    reasons = [found.reason for found in solutions for _ in found.schedules]
    stopped = [_with_hand_over(reason, limits, k) for k, reason in enumerate(reasons)]
    history = [record for found in solutions for record in found.history]

    # Simulate the whole plan.
    durations = [float(np.asarray(schedule.times)[-1]) for schedule in schedules]
    phases = tuple(replace_duration(p, t) for p, t in zip(scene.phases, durations, strict=True))
    scene, torque = eqx.tree_at(lambda s: s.phases, scene, phases), concatenate_schedules(schedules)
    knots = max(options.knots, *(found.knots for found in solutions))
    simulate = partial(simulate_phases, scene, torque, traced)
    simulated = simulate_with_enough_steps(simulate, with_step_capacity(IntegratorOptions(), knots))
    search = Search(knots, options.rate_limit is not None)
    result = build_result(scene, torque, traced, simulated)
    result = explain(result, margin_bounds=limits.pointwise, search=search, too_short=limits.too_short)
    return OptimisationResult(scene, torque, result, margin_bounds, tuple(stopped), tuple(history), knots)


def _solve_group(
    scene: Scene,
    traced: tuple[TracedPhase, ...],
    limits: PlanLimits,
    options: OptimiseOptions,
    group: list[int],
    ends: tuple[RestTransition | None, RestTransition | None],
) -> GroupSolution:
    """Solve one group of phases, between the transitions at its `ends`."""
    phases, paths = tuple(scene.phases[k] for k in group), [traced[k] for k in group]
    if phases[0].arrive is Arrival.HOLD:
        schedule = holding_schedule(scene, phases[0], paths[0], options.knots, options.rate_limit, *ends)
        return GroupSolution([schedule], "the best torque of a linear programme", [])
    short = [k for k in group if k in limits.too_short]
    if short:
        schedules = [uniform_schedule(float(phase.duration), np.zeros((options.knots, 2))) for phase in phases]
        return GroupSolution(schedules, f"phase '{scene.phases[short[0]].name}' is too short for any motion", [])
    margin_bounds = [limits.reachable(k) for k in group]
    hand_over, next_hand_over = limits.hand_overs[group[0]], [*limits.hand_overs, None][group[-1] + 1]
    coupled = partial(CoupledPhases, group[0], phases, paths, margin_bounds, *ends, hand_over, next_hand_over)
    if len(group) > 1 or int(paths[0].dynamics.status) != Status.OK or not float(margin_bounds[0].value) > 0:
        return solve_coupled_phases(scene, coupled(None, True, 0, options))

    # A single phase: from its convex optimum, with more knots where they cost margin.
    may_wait = options.rate_limit is None and options.durations is None
    moving = float(phases[0].duration) - (ends[0].dwell_time if ends[0] is not None else 0.0)
    solutions: list[GroupSolution] = []
    for finer in options.refinements():
        about = StartOptions(scene, phases[0], paths[0], moving, finer.knots, hand_over)
        starts = convex_starts(about, may_wait)
        for convex in starts or [None]:
            problem = coupled(convex, len(starts) <= 1, len(solutions), finer)
            solutions.append(solve_coupled_phases(scene, problem))
            if solutions[-1].score >= (True, True, 1 - options.tolerance):
                break
        if may_wait and starts and not any(found.score.is_followable for found in solutions):
            hurried = hurried_start(about)
            if hurried is not None:
                solutions.append(solve_coupled_phases(scene, coupled(hurried, False, len(solutions), finer)))
        if any(found.score.is_ok and found.score.bound_fraction >= GOOD_BOUND_FRACTION for found in solutions):
            break
    best = max(solutions, key=lambda found: found.score)
    return best._replace(history=[record for found in solutions for record in found.history])


def _with_hand_over(reason: str, limits: PlanLimits, phase: int) -> str:
    """Add to why iterations ended what the hand-overs at a phase's ends leave of its bound."""
    left = limits.by_either[phase]
    if left >= GOOD_BOUND_FRACTION * float(limits.bounds[phase].value):
        return reason
    most = f"{left:.4g} N, the most with which torques serve by either contact of its hand-over"
    return reason.replace("the bound", most) if "the bound" in reason else f"{reason}; there are at most {most}"


def _without_idle_torques(phase: Phase, schedule: TorqueSchedule) -> TorqueSchedule:
    """Return a phase's schedule without torques of fingers that are away, which have no effect on its path."""
    if not phase.formation.away:
        return schedule
    return TorqueSchedule(schedule.times, as_device_array(idle_torques(phase, np.asarray(schedule.values))))


def _one_at_a_time(callback: Callable[[IterationRecord], None]) -> Callable[[IterationRecord], None]:
    """Return the same callback, called by one thread at a time."""
    lock = threading.Lock()

    def call(record: IterationRecord) -> None:
        with lock:
            callback(record)

    return call


def _with_durations(scene: Scene, duration: float) -> Scene:
    """Return the same plan with another duration of all phases that move the object."""
    phases = (p if p.arrive is Arrival.HOLD else replace_duration(p, duration) for p in scene.phases)
    return eqx.tree_at(lambda s: s.phases, scene, tuple(phases))
