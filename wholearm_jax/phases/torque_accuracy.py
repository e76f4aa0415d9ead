"""How exact torques must be: the error of them up to which a plan that is driven open loop ends where it should.

Nothing corrects an object that is a little behind its schedule. Where its contacts then drive it less, it falls back
more and more, exponentially in time, and a simulation, which makes no errors, does not show that. The displacement of
the end is a difference quotient: torques are changed by `TORQUE_ERROR`, each either way, and the plan is simulated
anew, by the same program. Some of the four changes let the object arrive too fast, which the path's end hides; those
against them let it stop short, by as much.
"""

import itertools
from collections.abc import Callable, Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

from wholearm_jax.core import Status, as_device_array
from wholearm_jax.model import TorqueSchedule, has_jumps
from wholearm_jax.phases.phase_ends import final_configuration
from wholearm_jax.phases.phase_simulation import SimulatedPhase
from wholearm_jax.phases.phase_tracing import TracedPhase
from wholearm_jax.phases.plan_simulation import simulate_phases
from wholearm_jax.phases.result import PhaseResult, Result
from wholearm_jax.simulation import options_with_steps

TORQUE_ERROR = 1e-6  # relative, of a difference quotient
MOTOR_ERROR = 0.01  # of its torque, that a motor may have
END_POSITION, END_ANGLE = 5e-4, 0.01  # [m, rad] from where a plan should end, that count as there


def torque_accuracy(result: Result, *, position: float = END_POSITION, angle: float = END_ANGLE) -> tuple[float, ...]:
    """Return how exact torques must be, open loop, for the object to end each phase where it should.

    Args:
        result: a simulated plan.
        position: distance from where the phase should end that is good enough [m].
        angle: the same of the object's angle [rad].

    Returns:
        The relative error of each joint's torque up to which a phase ends so near, to first order: infinite of a hold,
        NaN of a phase that is not `ok`. Errors of phases that follow one another at speed add up in the last of them.

    >>> optimum = wa.optimise(wa.load("heptagon"))
    >>> [f"{100 * accuracy:.1f} %" for accuracy in wa.torque_accuracy(optimum.result)]
    ['0.2 %', '0.7 %']
    """
    traced = tuple(phase.traced for phase in result.phases)
    steps = max(len(phase.outcome.motion.s) for phase in result.phases) - 1  # as many as the simulation was allowed
    jumps = any(_jumps_in_motion(phase, result.torque) for phase in result.phases)
    options = options_with_steps(steps, has_jumps=jumps)

    def simulated(torque: TorqueSchedule) -> Sequence[SimulatedPhase]:
        return simulate_phases(result.scene, torque, traced, options)

    accuracy = required_accuracy(simulated, result.torque, traced, position, angle)
    ok = [phase.status is Status.OK for phase in result.phases]
    return tuple(float(one) for one in np.where(ok, accuracy, np.nan))


def _jumps_in_motion(phase: PhaseResult, torque: TorqueSchedule) -> bool:
    """Whether torques jump while the object moves, and not just where a wait before its motion ends."""
    waits = (rest.end for rest in phase.holds if rest.start <= phase.start)
    return has_jumps(torque, max([phase.start, *waits]), phase.start + phase.duration)


def required_accuracy(
    simulated: Callable[[TorqueSchedule], Sequence[SimulatedPhase]],
    torque: TorqueSchedule,
    traced: Sequence[TracedPhase],
    position: float = END_POSITION,
    angle: float = END_ANGLE,
) -> Float[np.ndarray, "phases"]:
    """Return the largest relative error of torques with which each phase ends near where it does without.

    Args:
        simulated: simulates phases under a schedule.
        torque: the schedule.
        traced: the phases' paths.
        position: what is near [m].
        angle: what is near [rad].
    """

    def ends(schedule: TorqueSchedule) -> Float[np.ndarray, "phases 5"]:
        found = zip(traced, simulated(schedule), strict=True)
        return np.stack([np.asarray(final_configuration(path.dynamics, one.motion)) for path, one in found])

    planned, values = ends(torque), np.asarray(torque.values)
    displacement = np.zeros((len(traced), 2))  # distance [m] and angle [rad] a relative error
    for signs in itertools.product((-1, 1), repeat=2):
        changed = as_device_array(values * (1 + TORQUE_ERROR * np.array(signs)))
        moved = (ends(eqx.tree_at(lambda one: one.values, torque, changed)) - planned) / TORQUE_ERROR
        displacement = np.maximum(displacement, np.abs(np.c_[np.hypot(*moved[:, :2].T), moved[:, 2]]))
    with np.errstate(divide="ignore"):
        return (np.array([position, angle]) / displacement).min(1)
