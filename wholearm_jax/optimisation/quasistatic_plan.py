"""Quasi-static torques of a plan and the upper bounds of its phases' margins.

Derivation: section 8 of `docs/derivation.md`.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from wholearm_jax.core import CachedJit, Status, as_device_array, computed_at_once, is_traced, require_x64
from wholearm_jax.margin import (
    MAX_ROLLING,
    MarginBound,
    margin_upper_bound,
)
from wholearm_jax.model import Arrival, Phase, Scene, TorqueSchedule, concatenate_schedules, uniform_schedule
from wholearm_jax.optimisation.initial_guess import initial_guesses, transformed_rest_to_rest_torques
from wholearm_jax.optimisation.plan_transitions import holding_schedule
from wholearm_jax.phases import TracedPhase, idle_torques, starts_at_rest, statics_at_start, trace

DEFAULT_KNOTS = 51  # torque knots of a phase, where their number is not given


def quasistatic(scene: Scene, *, knots: int = DEFAULT_KNOTS, traced: tuple[TracedPhase, ...] = ()) -> TorqueSchedule:
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
    if is_traced(scene, traced):
        return _transformed_quasistatic(scene, knots, traced or trace(scene))
    return _quasistatic_of_numbers(scene, knots, traced or trace(scene))


def _transformed_quasistatic(scene: Scene, knots: int, traced: tuple[TracedPhase, ...]) -> TorqueSchedule:
    """Return the schedule of `quasistatic` for a plan that is being transformed."""
    _refuse_holds(scene, "quasistatic")
    times, torques, begin = [], [], 0.0
    for path, phase in zip(traced, scene.phases, strict=True):
        times.append(begin + phase.duration * np.linspace(0.0, 1.0, knots))
        torques.append(transformed_rest_to_rest_torques(path.dynamics, phase.duration, knots))
        begin = begin + phase.duration
    return TorqueSchedule(jnp.concatenate(times), jnp.concatenate(torques))


def _refuse_holds(scene: Scene, name: str) -> None:
    """Raise TypeError for a plan with a phase that holds the object, which linear programmes on the host assess."""
    held = next((phase.name for phase in scene.phases if phase.arrive is Arrival.HOLD), None)
    if held is not None:
        raise TypeError(f"{name} cannot be transformed (jit, grad, vmap) with phase '{held}', which holds the object")


@computed_at_once
def _quasistatic_of_numbers(scene: Scene, knots: int, traced: tuple[TracedPhase, ...]) -> TorqueSchedule:
    def schedule(path, phase):
        if phase.arrive is Arrival.HOLD:
            return holding_schedule(scene, phase, path, knots)
        guess = initial_guesses([path.dynamics], [float(phase.duration)], knots, 1.0)[0]
        torque = path.dynamics.torque_limit * guess.torque[0]
        return uniform_schedule(float(phase.duration), idle_torques(phase, torque))

    return concatenate_schedules([schedule(*pair) for pair in zip(traced, scene.phases, strict=True)])


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
    ['0.417 N', '2.575 N']
    """
    require_x64(scene)
    if is_traced(scene, traced):
        return _transformed_bounds(scene, traced or trace(scene))
    return _bounds_of_numbers(scene, traced or trace(scene))


def _transformed_bounds(scene: Scene, traced: tuple[TracedPhase, ...]) -> tuple[MarginBound, ...]:
    """Return the bounds of a plan that is being transformed."""
    _refuse_holds(scene, "bounds")

    def bound(path, phase, from_rest):
        ends = jnp.asarray(from_rest), jnp.asarray(phase.arrive is Arrival.AT_REST)
        rolling = MAX_ROLLING if is_traced(phase.formation.tangential) else rolling_count(phase)
        found = upper_bound(path.dynamics, phase.duration, *ends, rolling)
        known = path.dynamics.status == int(Status.OK)
        return eqx.tree_at(lambda b: b.value, found, jnp.where(known, found.value, -jnp.inf))

    return tuple(bound(*row) for row in zip(traced, scene.phases, starts_at_rest(scene), strict=True))


@computed_at_once
def _bounds_of_numbers(scene: Scene, traced: tuple[TracedPhase, ...]) -> tuple[MarginBound, ...]:

    def bound(path, phase, from_rest):
        if int(path.dynamics.status) != Status.OK:
            return MarginBound(jnp.asarray(-np.inf), path.dynamics.breakpoints[0], jnp.zeros(()))
        if phase.arrive is not Arrival.HOLD:
            ends = as_device_array(from_rest), as_device_array(phase.arrive is Arrival.AT_REST)
            return upper_bound(path.dynamics, phase.duration, *ends, rolling_count(phase))
        statics, accelerations = statics_at_start(scene, phase, path)
        return MarginBound(jnp.asarray(statics.best(accelerations).margin), path.dynamics.breakpoints[0], jnp.zeros(()))

    return tuple(bound(*row) for row in zip(traced, scene.phases, starts_at_rest(scene), strict=True))


def require_knots(knots: int) -> None:
    """Raise ValueError for fewer knots than a schedule needs."""
    if knots < 2:
        raise ValueError(f"knots must be at least 2, not {knots}")


def rolling_count(phase: Phase) -> int:
    """Return the number of contacts of a phase that roll."""
    return int(np.asarray(phase.formation.tangential).sum())


upper_bound = CachedJit(margin_upper_bound)
