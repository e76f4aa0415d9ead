"""Pace: one descent from its start to its end: how far its steps go, and when it stops.

Full steps of the interior point (`descent`) lead on fastest, but may go round in a circle for ever: where knots pass
kinks of the wire to and fro, and along ways that the loss hardly sees. Who circles is held back, more and more. Once
the margin has settled, steps only join the intervals: that converges quadratically, as the interior point does not.
A descent is given up where it comes to where an earlier start led.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import numpy as np

from wholearm_jax.dynamics import PathDynamics
from wholearm_jax.optimisation.interior_point import DEFECT_TOL, init_solver, take_step
from wholearm_jax.optimisation.linearisation import Limits
from wholearm_jax.optimisation.multiple_shooting import Variables
from wholearm_jax.simulation import IntegratorOptions

RISE = 0.01  # most that a step which is held back may raise the merit, as a share of the bound
DAMPING, DAMPED = 1e-8, 1.3  # price of its size, and by how much that grows from one such step to the next
CLOSE = 1e-5  # sum of the defects from which full steps close them
SETTLED, NEARLY = 0.05, 1e-2  # shares of the tolerance by which a margin that settled changes, sum of its defects
CLOSING = 1e3  # price of a step's size beside which the margin counts little: the smallest step that joins intervals
LOST = 1e-6  # share of a step at which a descent gives up
SAME_SOLUTION_TOL = (
    2e-3,
    2e-2,
)  # differences of states at knots [lengths, lengths a duration] with which descents end alike
CONVERGED, REPEATED = "the margin no longer improves", "an earlier start led there, too"
INTERVAL_OPTIONS = IntegratorOptions()


@dataclass(frozen=True)
class IterationRecord:
    """One step of the descent from one of a phase's starts: the temperature as a share of the bound, the least sampled
    force [N], how far apart the intervals still are (`shooting`), the time it took [s]."""

    phase: int
    start: int
    step: int
    temperature: float
    margin: float
    apart: float
    seconds: float


class Problem(NamedTuple):
    """What is descended on: phases with their tables and bounds [N] and their `limits`, `phase` being the first's
    number; at most `steps` steps, and a `tolerance` as a share of the bound."""

    phase: int
    phase_dynamics: PathDynamics
    bounds: np.ndarray
    limits: Limits
    steps: int
    tolerance: float


def solve(
    problem: Problem,
    start: Variables,
    number: int,
    method,
    callback: Callable[[IterationRecord], None] | None,
    ended: Sequence[Variables] = (),
) -> tuple[Variables, str, list[IterationRecord]]:
    """Descend from start number `number`: the variables where it ends, why it ends, and its steps.

    `method` is `descent.interior_point` or `descent.projected`; `ended` is where descents from earlier starts
    ended, of which none is followed to its end again.
    """
    d, rounds, margin_before, history = init_solver(start, method), 0, np.nan, []
    for count in range(problem.steps):
        begun = time.perf_counter()
        after = take_step(d, problem.phase_dynamics, problem.limits, INTERVAL_OPTIONS, method)
        least, apart, hot, coldest, shares, share = jax.device_get(
            (
                after.least,
                after.apart,
                after.state.temperature,
                after.state.coldest,
                after.state.steps,
                after.step_fraction,
            )
        )
        margin, near = float((least * problem.bounds).min()), least.min() >= 1 - problem.tolerance
        spent = time.perf_counter() - begun
        history.append(IterationRecord(problem.phase, number, count, float(hot), margin, float(apart), spent))
        if callback is not None:
            callback(history[-1])
        if apart < DEFECT_TOL and hot <= coldest and (shares.min() >= 1 or near):
            return d.p, CONVERGED, history
        if share < LOST:
            return d.p, "no step leads on", history
        if apart < NEARLY and any(_same_solution(d.p, other) for other in ended):
            return d.p, REPEATED, history
        settled = hot <= coldest and apart < NEARLY and _settled(problem, least.min(), margin - margin_before)
        circling = not settled and count >= problem.steps // 3 and apart > CLOSE
        rounds, margin_before = rounds + circling, margin
        d = after._replace(**(_JOINING if settled else _held_back(rounds) if circling else _FULL))
    return d.p, f"the limit of {problem.steps} steps", history


def _same_solution(p: Variables, other: Variables) -> bool:
    """Whether descents come to one end: states at all knots and durations differ little."""
    states = np.abs(np.asarray(p.state) - np.asarray(other.state)).max((0, 1))
    lasting = np.abs(np.asarray(p.log_duration) - np.asarray(other.log_duration)).max()
    return bool(np.all(states < SAME_SOLUTION_TOL) and lasting < SAME_SOLUTION_TOL[0])


def _settled(problem: Problem, least, change) -> bool:
    """Whether a margin is as good as at its bound, or changes no more."""
    return least >= 1 - problem.tolerance / 2 or abs(change) < SETTLED * problem.tolerance * problem.bounds.min()


def _held_back(rounds: int) -> dict[str, np.ndarray]:
    """How far steps go after so many that circled."""
    return _settings(reach=0.5, rise=RISE, damping=DAMPING * DAMPED**rounds)


def _settings(**values: float) -> dict[str, np.ndarray]:
    return {name: np.full((), value) for name, value in values.items()}


_FULL = _settings(reach=1.0, rise=np.inf, damping=0.0)
_JOINING = _settings(reach=1.0, rise=np.inf, damping=CLOSING)
