"""Step search: the paper's own way to torques (section 3.1), by steps of ten per cent; a baseline for the optimiser.

For each phase both joints first get the constant torques of the best internal force that holds the object still, within
a fraction of their limits (several fractions are tried, as the paper does not say with which torque it begins). Then
the torque of the pushing finger is raised by 10 % until the object begins to move, raised on while every contact stays
compressive, and lowered by 10 % when a contact opens; the last torque that works is recorded. Each phase therefore
begins with a jump of the torque and ends at the end of its path at any speed; the next is taken to start from rest.

Derivation: section 10 of `docs/derivation.md`.
"""

import time
from dataclasses import dataclass, replace
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from wholearm_jax.core import BackgroundTask, Status, compile_in_background, on_host, require_x64, wait_for
from wholearm_jax.dynamics import PathDynamics
from wholearm_jax.margin import affine_coefficients, best_quasistatic_torque
from wholearm_jax.model import Arrival, Phase, Scene, TorqueSchedule, pad_schedule, replace_duration, round_up
from wholearm_jax.phases import (
    Result,
    TracedPhase,
    idle_torques,
    precompile_simulation,
    require_motion,
    simulate,
    simulate_phase,
    trace,
)
from wholearm_jax.simulation import IntegratorOptions

TORQUE_FACTOR = 1.1  # of one raise
INITIAL_TORQUE_FRACTIONS = tuple(TORQUE_FACTOR**-k for k in range(26, 0, -1))  # of the limits, where a series begins
MAX_RAISES = 60  # in a series


@dataclass(frozen=True)
class SearchResult:
    """Result of the step search."""

    scene: Scene  # with the durations that came out
    torque: TorqueSchedule
    result: Result  # of its simulation
    simulations: int  # number of simulations
    seconds: float


class _Trial(NamedTuple):
    """Constant torques and the phase under them."""

    torque: np.ndarray  # [N m]
    duration: float  # until it ended [s]
    status: Status
    margin: float  # [N]; -inf if the object never moves


@on_host("search outside of the transformation")
def search_by_steps(scene: Scene, *, longest: float = 10.0, traced: tuple[TracedPhase, ...] = ()) -> SearchResult:
    """Search each phase's torques by steps of 10 % (the paper's section 3.1; derivation, section 10).

    A phase for which no raise works keeps the torques with the largest margin, and the result's status says what it
    does.

    Args:
        scene: the plan.
        longest: longest duration of a phase [s].
        traced: the result of `trace`, to reuse it.

    Raises:
        RuntimeError: without float64.
        ValueError: for a plan with a phase that holds the object.

    >>> search = wa.search_by_steps(wa.load("heptagon"))
    >>> search.result.status.label, search.torque.values.shape
    ('ok', (4, 2))
    """
    require_x64(scene)
    require_motion(scene)
    begun = time.perf_counter()
    if not traced:
        compiled = precompile_search()
        traced = trace(scene)
        wait_for(compiled)
    phases, times, rows, start, count = [], [], [], 0.0, 0
    for phase, path in zip(scene.phases, traced, strict=True):
        torque, duration, simulations = _search_phase(path, longest)
        torque = idle_torques(phase, torque)
        count += simulations
        phases.append(_with_any_speed(replace_duration(phase, duration)))
        times += [start, start + duration]
        rows += [torque, torque]
        start += duration
    searched = eqx.tree_at(lambda s: s.phases, scene, tuple(phases))
    schedule = TorqueSchedule(jnp.asarray(times), jnp.asarray(np.array(rows)))
    result = simulate(searched, schedule, traced=traced)
    return SearchResult(searched, schedule, result, count + len(phases), time.perf_counter() - begun)


def precompile_search() -> BackgroundTask:
    """Compile what `search_by_steps` runs, in the background; returns the task to wait for."""
    return compile_in_background(precompile_simulation, round_up(2), IntegratorOptions())


def _with_any_speed(phase: Phase) -> Phase:
    return replace(phase, arrive=Arrival.ANY_SPEED)


def _search_phase(path: TracedPhase, longest: float) -> tuple[np.ndarray, float, int]:
    """Return the best torques, the time that the path takes under them, and the number of simulations."""
    if int(path.dynamics.status) != Status.OK:
        return np.zeros(2), 1.0, 0
    series = [_raise_torque(path.dynamics, fraction, longest) for fraction in INITIAL_TORQUE_FRACTIONS]
    best = max((trial for trial, _ in series), key=lambda trial: (trial.status is Status.OK, trial.margin))
    return best.torque, best.duration, sum(simulations for _, simulations in series)


def _raise_torque(dynamics: PathDynamics, fraction: float, longest: float) -> tuple[_Trial, int]:
    """Raise the torque from the best internal force within a fraction of the limits.

    Returns the last trial that worked, or of those that failed the one with the largest margin, and their number.
    """
    limit = np.asarray(dynamics.torque_limit)
    tightened = eqx.tree_at(lambda t: t.torque_limit, dynamics, fraction * dynamics.torque_limit)
    at_rest = _rest_torque(tightened, dynamics.breakpoints[0])
    torque = np.clip(np.asarray(at_rest.torque), -fraction * limit, fraction * limit)
    best, count = _Trial(torque, longest, Status.STUCK, -np.inf), 0
    if not np.isfinite(float(at_rest.margin)):  # no torque within this fraction balances
        return best, 0

    # The pushing finger is the one whose torque, raised in its own direction, accelerates the object more.
    by_torque = np.asarray(_coefficients(dynamics, dynamics.breakpoints[0])[0])[3:]
    pushing = int(np.argmax(by_torque * np.sign(torque)))
    while count < MAX_RAISES:
        trial, count = _simulate_constant(dynamics, torque, longest), count + 1
        worked = best.status is Status.OK
        if trial.status is Status.OK or (not worked and trial.margin > best.margin):
            best = trial
        torque = np.where(np.arange(2) == pushing, TORQUE_FACTOR * torque, torque)
        # Where a contact opens, back by 10 %: that is the last trial that worked.
        if (trial.status is Status.CONTACT_LOST and worked) or not abs(torque[pushing]) <= limit[pushing]:
            break
    return best, count


_rest_torque, _coefficients = eqx.filter_jit(best_quasistatic_torque), eqx.filter_jit(affine_coefficients)


def _simulate_constant(dynamics: PathDynamics, torque, longest: float) -> _Trial:
    """Simulate a phase under constant torques."""
    schedule = pad_schedule(TorqueSchedule(jnp.asarray([0.0, longest]), jnp.asarray(np.stack([torque, torque]))))
    duration = jnp.asarray(longest)
    simulated = simulate_phase(dynamics, schedule, jnp.zeros(()), duration, IntegratorOptions(), Arrival.ANY_SPEED)
    end = float(simulated.motion.phase_time[int(simulated.motion.count)]) * longest
    margin = float(simulated.margin_result.margin)  # an object that never moves has no least force
    status = Status(int(simulated.assessment.status))
    return _Trial(torque, max(end, 1e-6), status, margin if np.isfinite(margin) else -np.inf)
