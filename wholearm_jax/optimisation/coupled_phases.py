"""Coupled phases: phases that follow one another at speed are one problem, solved from several initial guesses.

A group of coupled phases begins and ends at rest, or with the plan. Where torque rates are limited its first and last
torques are those that it shares with its neighbours (`rest_transition`). Solutions are compared by a simulation of
their schedules, not by the samples of their intervals.

Derivation: section 9 of `docs/derivation.md`.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
import optax

from wholearm_jax.core import Status, as_device_array, stack_trees
from wholearm_jax.margin import MarginBound
from wholearm_jax.model import (
    Arrival,
    Phase,
    Scene,
    TorqueSchedule,
    concatenate_schedules,
    pad_schedule,
    round_up,
    uniform_schedule,
)
from wholearm_jax.optimisation.constraints import Limits
from wholearm_jax.optimisation.convex_start import ConvexStart, Wait, wait_before
from wholearm_jax.optimisation.hand_over_limits import hand_over_rows
from wholearm_jax.optimisation.initial_guess import initial_guesses
from wholearm_jax.optimisation.interior_point import interior_point
from wholearm_jax.optimisation.multiple_shooting import extra_parts
from wholearm_jax.optimisation.projected_gradient import projected_gradient
from wholearm_jax.optimisation.rest_transition import RestTransition
from wholearm_jax.optimisation.solver import CONVERGED, REPEATED, IterationRecord, Problem, solve
from wholearm_jax.optimisation.variables import Variables
from wholearm_jax.phases import (
    HandOver,
    SimulatedPhase,
    TracedPhase,
    required_accuracy,
    rest_intervals,
    simulate_phase,
    simulate_with_enough_steps,
)
from wholearm_jax.simulation import IntegratorOptions, with_step_capacity

GUESS_TORQUE_FRACTION = 0.9  # of the torque limits, that an initial guess may use
MIN_DURATION_FRACTION = 0.01  # of its longest duration, that a phase takes at least
GOOD_BOUND_FRACTION = 0.99  # of the bound, with which no further guess is tried
FOLLOWABLE_ACCURACY = 1e-4  # of torques; no motor follows a schedule that needs a higher one, and friction is unknown


class SolutionQuality(NamedTuple):
    """How good a solution is, as its simulation has it; the largest is the best."""

    is_ok: bool
    is_followable: bool  # whether torques may be as wrong as `FOLLOWABLE_ACCURACY`, and an object that waits must stay
    bound_fraction: float  # least margin over its bound, that of a wait before the motion included


class GroupSolution(NamedTuple):
    """What was found for a group of phases."""

    schedules: list[TorqueSchedule]  # of each phase, from time 0
    reason: str  # why iterations ended
    history: list[IterationRecord]
    score: SolutionQuality = SolutionQuality(False, False, -np.inf)
    knots: int = 2  # of each phase


@dataclass(frozen=True)
class OptimiseOptions:
    """Arguments of `optimise`."""

    knots: int  # of each phase, and
    most_knots: int  # of one in which so few cost margin
    schedule_rows: int  # of the whole plan's schedule: plans with equal rows share programs
    hand_over_rows: int  # of each interval
    steps: int
    rate_limit: float | None
    durations: tuple[float, float] | None
    passing: float
    optimiser: optax.GradientTransformation | None
    tolerance: float
    callback: Callable[[IterationRecord], None] | None

    def refinements(self) -> tuple["OptimiseOptions", ...]:
        """Return the options of a single phase: these, and with most knots where those are more."""
        finer = replace(self, knots=self.most_knots, schedule_rows=schedule_rows(1, self.most_knots))
        return (self, finer) if self.most_knots > self.knots else (self,)


@dataclass(frozen=True)
class CoupledPhases:
    """Phases that are solved together."""

    index: int  # number of the first one
    phases: tuple[Phase, ...]
    traced: list[TracedPhase]
    margin_bounds: list[MarginBound]
    begin: RestTransition | None  # to the first phase, where torque rates are limited and another stands before
    end: RestTransition | None  # from the last phase
    hand_over: HandOver | None  # with which the first one begins
    next_hand_over: HandOver | None  # with which the last one ends
    convex: ConvexStart | None  # of a single phase
    tries_profile: bool  # whether a smooth motion is tried as well
    first_guess: int  # number of the first initial guess
    options: OptimiseOptions

    @property
    def fixed_torques(self) -> dict[tuple[int, int], np.ndarray]:
        """Torques that stay, over their limits, by phase and knot."""
        fixed = {}
        if self.begin is not None and self.begin.is_feasible:
            fixed[0, 0] = self.begin.departure_torque / self.torque_limits[0]
        if self.end is not None and self.end.is_feasible:
            fixed[-1, -1] = self.end.torque / self.torque_limits[-1]
        return fixed

    @property
    def best_possible(self) -> float:
        """The fraction of the bounds that the torques at both ends allow."""
        ends = (end for end in (self.begin, self.end) if end is not None and end.is_feasible)
        return min([1.0, *(end.margin_fraction for end in ends)])

    @property
    def waits(self) -> tuple[Wait, ...]:
        """The wait before the first phase's motion; empty without."""
        return () if self.convex is None or self.convex.wait is None else (self.convex.wait,)

    @property
    def dwell_times(self) -> np.ndarray:
        """How long the object waits in each phase before it starts [s]."""
        first = self.begin.dwell_time if self.begin is not None else 0.0
        first += sum(wait.time for wait in self.waits)
        return np.append(first, np.zeros(len(self.phases) - 1))

    @property
    def moving_times(self) -> np.ndarray:
        """How long it moves in each phase [s]."""
        return np.array([float(p.duration) for p in self.phases]) - self.dwell_times

    @property
    def torque_limits(self) -> np.ndarray:
        """Torque limits of each phase [N m]."""
        return np.stack([np.asarray(path.dynamics.torque_limit) for path in self.traced])

    @property
    def bounds(self) -> np.ndarray:
        """Upper bound of each phase's margin [N]."""
        return np.array([float(bound.value) for bound in self.margin_bounds])


def schedule_rows(phases: int, knots: int) -> int:
    """Return the rows that the schedule of so many phases may have, with two for a wait before each."""
    return round_up((knots + 2) * phases)


def solve_coupled_phases(scene: Scene, group: CoupledPhases) -> GroupSolution:
    """Solve from one initial guess after the other, until one comes near the bound or two agree.

    Returns the best schedules, why their iterations ended, and the records of all iterations.
    """
    options = group.options
    for path in group.traced:
        if int(path.dynamics.status) != Status.OK:
            reason = f"the path cannot be followed: {Status(int(path.dynamics.status)).label}"
            schedules = [uniform_schedule(t, np.zeros((options.knots, 2))) for t in group.moving_times]
            return GroupSolution(schedules, reason, [])
    phase_dynamics = [path.dynamics for path in group.traced]
    motion = None if group.convex is None else group.convex.motion
    guesses = initial_guesses(phase_dynamics, group.moving_times, options.knots, GUESS_TORQUE_FRACTION, motion)
    guesses = guesses if group.tries_profile else guesses[:1]
    if (reason := _infeasible_reason(group)) is not None:
        return GroupSolution(_schedules(group, guesses[0]), reason, [])

    best, history = _solve_from_guesses(scene, group, guesses)
    near_bound = best.is_ok and best.bound_fraction >= 1 - options.tolerance
    reason = f"within {options.tolerance:g} of the bound" if near_bound else best.reason
    # Where iterations end without torques, the phase is simulated under those of its first guess, which are in limits.
    found = best.p if np.isfinite(np.asarray(best.p.torque)).all() else guesses[0]
    fraction = min(best.bound_fraction, *(wait.margin / group.bounds[0] for wait in group.waits), np.inf)
    score = SolutionQuality(best.is_ok, best.is_ok and _is_followable(group, best.p), fraction)
    return GroupSolution(_schedules(group, found), reason, history, score, options.knots)


class _Candidate(NamedTuple):
    """A solution from one guess, as its simulation has it; the largest is the best."""

    is_ok: bool
    bound_fraction: float  # least margin over its bound
    reason: str  # why iterations ended
    p: Variables


def _infeasible_reason(group: CoupledPhases) -> str | None:
    """Return why no torques can solve the problem; None where some may."""
    weakest = int(np.argmin(group.bounds))
    if group.bounds[weakest] <= 0:
        percent = 100 * float(group.margin_bounds[weakest].path_fraction)
        return f"no torque within limits holds this formation at {percent:.0f} % of its path"
    if group.begin is not None and not group.begin.is_feasible:
        return "no torque lets this formation take over at the limited rate"
    return None


def _solve_from_guesses(
    scene: Scene, group: CoupledPhases, guesses: list[Variables]
) -> tuple[_Candidate, list[IterationRecord]]:
    """Solve from guesses in turn; returns the best solution, and the records of all iterations."""
    options, limits, stacked = group.options, _limits(group), stack_dynamics([path.dynamics for path in group.traced])
    problem = Problem(group.index, stacked, group.bounds, limits, options.steps, options.tolerance)
    method = solver_method(options.optimiser, len(group.phases), extra_parts(stacked), options.hand_over_rows)
    candidates: list[_Candidate] = []
    history: list[IterationRecord] = []
    for number, guess in enumerate(guesses, group.first_guess):
        for at, torque in group.fixed_torques.items():
            guess = eqx.tree_at(lambda p: p.torque, guess, guess.torque.at[at].set(torque))
        solutions = [known.p for known in candidates if known.is_ok and known.reason == CONVERGED]
        p, reason, records = solve(problem, guess, number, method, options.callback, solutions)
        history += records
        if reason == REPEATED:
            break
        is_ok, fraction = _verify_by_simulation(scene, group, p)
        best = max((known.bound_fraction for known in candidates if known.is_ok), default=np.nan)
        candidates.append(_Candidate(is_ok, fraction, reason, p))
        is_good = fraction >= GOOD_BOUND_FRACTION * group.best_possible
        if is_ok and (is_good or abs(fraction - best) <= options.tolerance):
            break
    return max(candidates, key=lambda known: known[:2]), history


def _schedules(group: CoupledPhases, p: Variables) -> list[TorqueSchedule]:
    """Return each phase's schedule, from time 0."""
    values, times = np.asarray(p.torque) * group.torque_limits[:, None], np.exp(np.asarray(p.log_duration))
    first, *others = [uniform_schedule(time, rows) for time, rows in zip(times, values, strict=True)]
    if group.begin is not None and group.begin.dwell_time > 0:
        times = np.append(0.0, group.begin.dwell_time + np.asarray(first.times))
        first = TorqueSchedule(as_device_array(times), as_device_array(np.vstack([group.begin.torque, first.values])))
    for wait in group.waits:
        first = wait_before(wait, first)
    return [first, *others]


def _verify_by_simulation(scene: Scene, group: CoupledPhases, p: Variables) -> tuple[bool, float]:
    """Simulate the schedules: whether all phases are `ok`, rests included, and the least margin over its bound."""
    fractions, is_ok, hand_over = [], [], group.hand_over
    torque = concatenate_schedules(_schedules(group, p))
    simulated_phases = _simulate_group(group, p, torque)
    for phase, path, simulated, bound in zip(group.phases, group.traced, simulated_phases, group.bounds, strict=True):
        rests = rest_intervals(scene, torque, phase, path, simulated, hand_over, judge_stability=False)
        hand_over = None
        stays = all(rest.loss_time is None for rest in rests)
        is_ok.append(int(simulated.assessment.status) == Status.OK and stays)
        fractions.append(float(simulated.margin_result.margin) / bound)
    least = min(fractions)
    return all(is_ok), least if np.isfinite(least) else -np.inf


def _simulate_group(group: CoupledPhases, p: Variables, torque: TorqueSchedule) -> Sequence[SimulatedPhase]:
    """Simulate the phases of a group, from time 0, under a schedule with the durations of `p`."""
    options = with_step_capacity(IntegratorOptions(), group.options.knots)
    return simulate_with_enough_steps(functools.partial(_simulate_group_within, group, p, torque), options)


def _simulate_group_within(
    group: CoupledPhases, p: Variables, torque: TorqueSchedule, options: IntegratorOptions
) -> list[SimulatedPhase]:
    """Simulate the phases of a group with no more steps than the options have."""
    start, incoming_velocity, simulated_phases = 0.0, None, []
    schedule = pad_schedule(torque, group.options.schedule_rows)
    ends = np.cumsum(np.exp(np.asarray(p.log_duration)) + group.dwell_times)
    for phase, path, end in zip(group.phases, group.traced, ends, strict=True):
        simulated = simulate_phase(
            path.dynamics, schedule, start, end - start, options, phase.arrive, incoming_velocity
        )
        motion = simulated.motion
        start += float(simulated.duration) * float(np.asarray(motion.phase_time)[int(motion.count)])
        incoming_velocity = simulated.exit_velocity if phase.arrive is Arrival.MOVING else None
        simulated_phases.append(simulated)
    return simulated_phases


def _is_followable(group: CoupledPhases, p: Variables) -> bool:
    """Whether torques that are a little wrong bring the object to where it should end, and it stays where it waits."""
    torque = concatenate_schedules(_schedules(group, p))
    accuracy = required_accuracy(lambda changed: _simulate_group(group, p, changed), torque, group.traced)
    return bool(np.all(accuracy >= FOLLOWABLE_ACCURACY)) and all(wait.is_strong for wait in group.waits)


def _limits(group: CoupledPhases) -> Limits:
    times, options = group.moving_times, group.options
    shortest, longest = (times, times)
    if options.durations is not None:
        shortest, longest = (duration - group.dwell_times for duration in options.durations)
    rate = np.full(2, np.inf if options.rate_limit is None else float(options.rate_limit))
    is_fixed = np.zeros((len(times), options.knots), bool)
    for at in group.fixed_torques:
        is_fixed[at] = True
    shortest, unit = np.maximum(shortest, MIN_DURATION_FRACTION * longest), np.maximum(group.bounds, 1e-300)
    begin = None if is_fixed[0, 0] else group.hand_over
    end = None if is_fixed[-1, -1] else group.next_hand_over
    rows = hand_over_rows(begin, end, len(times), options.knots - 1, options.hand_over_rows)
    values = rate, shortest, longest, np.asarray(options.passing), is_fixed, unit, rows
    return Limits(*(as_device_array(a) for a in values))


@functools.cache
def solver_method(optimiser, phases: int, further_parts: int, hand_over_rows: int):
    """Return one transformation for every use, so that programs are not compiled again."""
    if optimiser is None:
        return interior_point(phases, further_parts, hand_over_rows)
    return projected_gradient(optimiser)


stack_dynamics = jax.jit(stack_trees)
