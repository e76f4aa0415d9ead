"""The paper's own way to torques (section 3.1): steps of ten per cent. Kept as an honest baseline, nothing more.

For each phase both joints first get the constant torques that would hold the object still with the best squeeze, within
a share of their limits (a few shares are tried, since the paper only says that it knew how much to begin with). Then
the torque of the pushing finger is raised by 10 % until the object begins to move, raised on while every contact stays
compressive, and lowered by 10 % when a contact opens; the last torque that works is recorded. Each phase therefore
begins with a step in the torque, and ends as soon as its wire does, at whatever speed: a phase of the search arrives
`caught`, and the next is taken to start from rest.

Derivation: section 10 of `docs/derivation.md`.
"""

import time
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from wholearm_jax.core import BackgroundTask, Status, compile_in_background, require_x64, wait_for
from wholearm_jax.margin import affine_coefficients, best_quasistatic_torque
from wholearm_jax.model import Arrival, Phase, Scene, TorqueSchedule, pad_schedule, replace_duration, round_up
from wholearm_jax.phases import (
    Result,
    TracedPhase,
    precompile_simulation,
    require_motion,
    simulate,
    simulate_phase,
    trace,
)
from wholearm_jax.simulation import IntegratorOptions

STEP = 1.1
HOLDS = tuple(STEP**-k for k in range(26, 0, -1))  # shares of the torque limits within which a series may begin
MOST = 60  # raises a series before the search gives up


@dataclass(frozen=True)
class SearchResult:
    """What the search found: the scene with the durations that came out, the schedule, its simulation and the cost."""

    scene: Scene
    torque: TorqueSchedule
    result: Result
    simulations: int
    seconds: float


def search_by_steps(scene: Scene, *, longest: float = 10.0, traced: tuple[TracedPhase, ...] = ()) -> SearchResult:
    """Search each phase's torques by steps of 10 %; no phase may take longer than `longest` seconds.

    A phase for which no raise works keeps the attempt with the largest margin, and the result's status says what it
    does. `traced` reuses the result of `trace`. Raises ValueError for a plan with a phase that holds the object.

    The paper's section 3.1 (derivation, section 10). Raises RuntimeError without float64.

    >>> found = wa.search_by_steps(wa.load("hexagon"))
    >>> found.result.status.label, found.torque.values.shape
    ('ok', (4, 2))
    """
    require_x64()
    require_motion(scene)
    begun = time.perf_counter()
    if not traced:
        compiled = precompile_search()
        traced = trace(scene)
        wait_for(compiled)
    phases, times, rows, start, count = [], [], [], 0.0, 0
    for phase, at in zip(scene.phases, traced, strict=True):
        torque, duration, tried = _search_phase(at, longest)
        count += tried
        phases.append(_arriving(replace_duration(phase, duration)))
        times += [start, start + duration]
        rows += [torque, torque]
        start += duration
    found = eqx.tree_at(lambda s: s.phases, scene, tuple(phases))
    schedule = TorqueSchedule(jnp.asarray(times), jnp.asarray(np.array(rows)))
    result = simulate(found, schedule, traced=traced)
    return SearchResult(found, schedule, result, count + len(phases), time.perf_counter() - begun)


def precompile_search() -> BackgroundTask:
    """Compile what `search_by_steps` runs in a thread of its own, while wires are traced; it is to be waited for."""
    return compile_in_background(precompile_simulation, round_up(2), IntegratorOptions())


def _arriving(phase: Phase) -> Phase:
    return Phase(phase.name, phase.formation, phase.target, phase.duration, arrive=Arrival.ANY_SPEED)


def _search_phase(at: TracedPhase, longest: float) -> tuple[np.ndarray, float, int]:
    """Torques, the time the wire takes under them, and the number of simulations."""
    if int(at.dynamics.status) != Status.OK:
        return np.zeros(2), 1.0, 0
    series = [_raise_torque(at.dynamics, share, longest) for share in HOLDS]
    count = sum(tried for *_, tried in series)
    torque, duration, _, _ = max(series, key=lambda one: (one[2] is Status.OK, one[3]))[:4]
    return torque, duration, count


def _raise_torque(dynamics, share: float, longest: float) -> tuple[np.ndarray, float, Status, float, int]:
    """One series of raises from the best hold within a share of the torque limits: the last that worked, or of those
    that failed the one with the largest margin."""
    limit = np.asarray(dynamics.torque_limit)
    tight = eqx.tree_at(lambda t: t.torque_limit, dynamics, share * dynamics.torque_limit)
    begin = _hold(tight, dynamics.breakpoints[0])
    torque = np.clip(np.asarray(begin.torque), -share * limit, share * limit)
    if not np.isfinite(float(begin.margin)):  # no torque within this share balances
        return torque, longest, Status.STUCK, -np.inf, 0
    pull = np.asarray(_coefficients(dynamics, dynamics.breakpoints[0])[0])[3:]
    # The pushing finger is the one whose torque, raised in its own direction, accelerates the object more.
    pushing = int(np.argmax(pull * np.sign(torque)))
    kept: tuple[np.ndarray, float, Status, float] = (torque, longest, Status.STUCK, -np.inf)
    count, going = 0, True
    while going and count < MOST:
        count += 1
        status, margin, end = _attempt(dynamics, torque, longest)
        margin = margin if np.isfinite(margin) else -np.inf  # what never moves has no least force
        if status is Status.OK or (kept[2] is not Status.OK and margin > kept[3]):
            kept = (torque, end, status, margin)
        opened = status is Status.CONTACT_LOST and kept[2] is Status.OK
        torque = np.where(np.arange(2) == pushing, STEP * torque, torque)
        # Where a contact opens, back by 10 %: that is the last one that worked.
        going = not opened and abs(torque[pushing]) <= limit[pushing]
    torque, end, status, margin = kept
    return torque, end, status, margin, count


_hold, _coefficients = eqx.filter_jit(best_quasistatic_torque), eqx.filter_jit(affine_coefficients)


def _attempt(dynamics, torque, longest) -> tuple[Status, float, float]:
    """One simulation under constant torques: status, margin and the time at which it ended."""
    schedule = pad_schedule(TorqueSchedule(jnp.asarray([0.0, longest]), jnp.asarray(np.stack([torque, torque]))))
    outcome = simulate_phase(
        dynamics, schedule, jnp.zeros(()), jnp.asarray(longest), IntegratorOptions(), Arrival.ANY_SPEED
    )
    end = float(outcome.motion.phase_time[int(outcome.motion.count)]) * longest
    return Status(int(outcome.assessment.status)), float(outcome.margin_result.margin), max(end, 1e-6)
