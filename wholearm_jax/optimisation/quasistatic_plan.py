"""Quasi-static torques of a plan and the upper bounds of its phases' margins.

Derivation: section 8 of `docs/derivation.md`.
"""

import jax.numpy as jnp
import numpy as np

from wholearm_jax.core import CachedJit, Status, as_device_array, require_x64
from wholearm_jax.margin import MarginBound, margin_upper_bound
from wholearm_jax.model import Arrival, Phase, Scene, TorqueSchedule, concatenate_schedules, uniform_schedule
from wholearm_jax.optimisation.initial_guess import initial_guesses
from wholearm_jax.optimisation.plan_transitions import holding_schedule
from wholearm_jax.phases import TracedPhase, statics_at_start, trace


def quasistatic(scene: Scene, *, knots: int = 51, traced: tuple[TracedPhase, ...] = ()) -> TorqueSchedule:
    """Return the quasi-static torques: at each knot the best internal force for a rest-to-rest motion, in closed form.

    The motion's speed is `v ~ u^p (1 - u)^q` in `u = t / duration`, with `p = q = 1` unless another of
    `SPEED_PROFILES` allows a larger margin. Torques are those of the inverse dynamics at the knots only: the schedule
    carries the object near the end of its path, not exactly to it. A phase that holds the object gets its best torque.

    Args:
        scene: the plan.
        knots: torque knots of each phase, at least two.
        traced: the result of `trace`, to reuse it.

    Returns:
        `knots` rows a phase, torques in N m.

    Raises:
        ValueError: for fewer than two knots.
        RuntimeError: without float64.

    >>> wa.quasistatic(wa.load("heptagon"), knots=11).values.shape
    (22, 2)
    """
    require_x64(scene)
    require_knots(knots)

    def schedule(path, phase):
        if phase.arrive is Arrival.HOLD:
            return holding_schedule(scene, phase, path, knots)
        guess = initial_guesses([path.dynamics], [float(phase.duration)], knots, 1.0)[0]
        return uniform_schedule(float(phase.duration), path.dynamics.torque_limit * guess.torque[0])

    return concatenate_schedules([schedule(*pair) for pair in zip(traced or trace(scene), scene.phases, strict=True)])


def bounds(scene: Scene, *, traced: tuple[TracedPhase, ...] = ()) -> tuple[MarginBound, ...]:
    """Return for each phase the certified upper bound of its margin under any torque within limits.

    For a phase that holds the object it is the largest margin of its statics; `-inf` where no path can be traced.
    Derivation, section 8.

    Args:
        scene: the plan.
        traced: the result of `trace`, to reuse it.

    Returns:
        One `MarginBound` a phase: `value` [N], and where on the path it is tight.

    Raises:
        RuntimeError: without float64.

    >>> [f"{float(bound.value):.3f} N" for bound in wa.bounds(wa.load("heptagon"))]
    ['0.966 N', '0.838 N']
    """
    require_x64(scene)
    starts_at_rest = [True, *(p.arrive is not Arrival.MOVING for p in scene.phases[:-1])]

    def bound(path, phase, from_rest):
        if int(path.dynamics.status) != Status.OK:
            return MarginBound(jnp.asarray(-np.inf), path.dynamics.breakpoints[0], jnp.zeros(()))
        if phase.arrive is not Arrival.HOLD:
            ends = as_device_array(from_rest), as_device_array(phase.arrive is Arrival.AT_REST)
            return upper_bound(path.dynamics, phase.duration, *ends, rolling_count(phase))
        statics, accelerations = statics_at_start(scene, phase, path)
        return MarginBound(jnp.asarray(statics.best(accelerations).margin), path.dynamics.breakpoints[0], jnp.zeros(()))

    return tuple(bound(*row) for row in zip(traced or trace(scene), scene.phases, starts_at_rest, strict=True))


def require_knots(knots: int) -> None:
    """Raise ValueError for fewer knots than a schedule needs."""
    if knots < 2:
        raise ValueError(f"knots must be at least 2, not {knots}")


def rolling_count(phase: Phase) -> int:
    """Return the number of contacts of a phase that roll."""
    return int(np.asarray(phase.formation.tangential).sum())


upper_bound = CachedJit(margin_upper_bound)
