"""The solver: iterations from one initial guess to their end, with safeguards against cycling.

Full interior-point steps converge fastest but can cycle: when knots cross a kink of the path back and forth, or along
directions in which the objective hardly changes. After a third of the iterations, cycling is damped by half steps, a
merit test and a growing regularisation, from then on to the end. Once the margin has settled, steps only close the
defects, which converges quadratically. A solve ends early where it comes close to the solution from an earlier guess.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import numpy as np

from wholearm_jax.dynamics import PathDynamics
from wholearm_jax.optimisation.constraints import Limits
from wholearm_jax.optimisation.iteration import DEFECT_TOL, SolverState, init_solver, take_step
from wholearm_jax.optimisation.variables import Variables
from wholearm_jax.simulation import IntegratorOptions

MERIT_TOLERANCE = 0.01  # most that a damped step may raise the merit, over the force scale
REGULARISATION, REGULARISATION_GROWTH = 1e-8, 1.3  # of damped steps: the first one's, and its factor for each further
CYCLING_DEFECT = 1e-5  # sum of the defects above which an iterate may be cycling
SETTLED_CHANGE, SETTLED_DEFECT = 0.05, 1e-2  # of a settled margin: largest change over the tolerance, sum of defects
CLOSING_REGULARISATION = 1e3  # makes the step the smallest one that closes the defects
MIN_STEP_FRACTION = 1e-6  # shortest step
SAME_SOLUTION_TOL = (2e-3, 2e-2)  # largest differences of `s` and `v` at the knots between equal solutions
CONVERGED, REPEATED = "the margin no longer improves", "an earlier start led there, too"
NO_STEP = "no step leads on"
INTERVAL_OPTIONS = IntegratorOptions()


@dataclass(frozen=True)
class IterationRecord:
    """One iteration of a solve."""

    phase: int  # the first of the phases that are solved together
    start: int  # initial guess
    iteration: int
    mu: float  # barrier parameter, over the bound
    margin: float  # least sampled force [N]; NaN after a rejected step
    defect_norm: float  # sum of the defects; 0: the intervals join
    seconds: float


class Problem(NamedTuple):
    """Phases that are solved together."""

    phase: int  # index of the first one
    phase_dynamics: PathDynamics  # of all, stacked
    bounds: np.ndarray  # of their margins [N]
    limits: Limits
    steps: int  # most iterations
    tolerance: float  # of the margin, over the bound


def solve(
    problem: Problem,
    start: Variables,
    number: int,
    method,
    callback: Callable[[IterationRecord], None] | None,
    solutions: Sequence[Variables] = (),
) -> tuple[Variables, str, list[IterationRecord]]:
    """Iterate from initial guess `number`.

    Args:
        problem: what is solved.
        start: the initial guess.
        number: its index, for the records.
        method: `interior_point` or `projected_gradient`.
        callback: called with each record.
        solutions: solutions from earlier guesses; iterations that come close to one of them end.

    Returns:
        The last iterate, why iterations ended, and their records.
    """
    d, cycles, margin_before, history = init_solver(start, method), 0, np.nan, []
    for iteration in range(problem.steps):
        begun = time.perf_counter()
        after = take_step(d, problem.phase_dynamics, problem.limits, INTERVAL_OPTIONS, method)
        record, measures = _measure(problem, after, number, iteration, begun)
        history.append(record)
        if callback is not None:
            callback(record)
        if (reason := _end_reason(problem, d.p, measures, solutions)) is not None:
            return d.p, reason, history

        # Choose the next step: full, damped where iterates cycle, or closing the defects once the margin has settled.
        settled = _has_settled(problem, measures, record.margin - margin_before)
        may_cycle = cycles > 0 or measures.defect_norm > CYCLING_DEFECT  # a full step would leave where cycles end
        cycling = not settled and iteration >= problem.steps // 3 and may_cycle
        cycles, margin_before = cycles + int(cycling), record.margin
        d = replace(after, **(_CLOSING if settled else _damped(cycles) if cycling else _FULL))
    return d.p, f"the limit of {problem.steps} steps", history


class _Measures(NamedTuple):
    """What decides whether and how iterations go on."""

    min_force: np.ndarray  # of each phase, over its force scale
    defect_norm: float
    at_mu_min: bool
    step_lengths: np.ndarray
    step_fraction: float


def _measure(
    problem: Problem, after: SolverState, number: int, iteration: int, begun: float
) -> tuple[IterationRecord, _Measures]:
    """Fetch what an iteration has found out about the iterate before it."""
    state = after.optimiser
    values = after.min_force, after.defect_norm, state.mu, state.mu_min, state.step_lengths, after.step_fraction
    min_force, norm, mu, mu_min, lengths, fraction = jax.device_get(values)
    margin, seconds = float((min_force * problem.bounds).min()), time.perf_counter() - begun
    record = IterationRecord(problem.phase, number, iteration, float(mu), margin, float(norm), seconds)
    return record, _Measures(min_force, norm, mu <= mu_min, lengths, fraction)


def _end_reason(problem: Problem, p: Variables, at: _Measures, solutions: Sequence[Variables]) -> str | None:
    """Return why iterations end at `p`; None where they go on."""
    at_bound = at.min_force.min() >= 1 - problem.tolerance
    if at.defect_norm < DEFECT_TOL and at.at_mu_min and (at.step_lengths.min() >= 1 or at_bound):
        return CONVERGED
    if at.step_fraction < MIN_STEP_FRACTION:
        return NO_STEP
    if at.defect_norm < SETTLED_DEFECT and any(_same_solution(p, other) for other in solutions):
        return REPEATED
    return None


def _has_settled(problem: Problem, at: _Measures, change: float) -> bool:
    """Whether the margin is as good as at its bound or no longer changes, at the least barrier parameter."""
    at_bound = at.min_force.min() >= 1 - problem.tolerance / 2
    unchanged = abs(change) < SETTLED_CHANGE * problem.tolerance * problem.bounds.min()
    return bool(at.at_mu_min and at.defect_norm < SETTLED_DEFECT and (at_bound or unchanged))


def _same_solution(p: Variables, other: Variables) -> bool:
    """Whether two iterates are close: states at all knots, and durations."""
    state = np.abs(np.asarray(p.state) - np.asarray(other.state)).max((0, 1))
    log_duration = np.abs(np.asarray(p.log_duration) - np.asarray(other.log_duration)).max()
    return bool(np.all(state < SAME_SOLUTION_TOL) and log_duration < SAME_SOLUTION_TOL[0])


def _damped(cycles: int) -> dict[str, np.ndarray]:
    """Step control after so many iterations that cycled."""
    regularisation = REGULARISATION * REGULARISATION_GROWTH**cycles
    return _step_control(step_scale=0.5, merit_tolerance=MERIT_TOLERANCE, regularisation=regularisation)


def _step_control(**values: float) -> dict[str, np.ndarray]:
    return {name: np.full((), value) for name, value in values.items()}


_FULL = _step_control(step_scale=1.0, merit_tolerance=np.inf, regularisation=0.0)
_CLOSING = _step_control(step_scale=1.0, merit_tolerance=np.inf, regularisation=CLOSING_REGULARISATION)
