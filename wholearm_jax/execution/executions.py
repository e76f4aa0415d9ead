r"""Execute: a torque schedule driven open loop, or a controller, through `build_mujoco_model`, and what became
of it against the prediction.

The object is placed at the projected start of the plan's first path, at rest, every gap 0; nothing settles before the
torque begins. Each step holds the torque of its middle. The plan succeeded if at its end the object stands where the
prediction says and every contact of the last phase is closed, both to within a tolerance (`executed_motion` says which
contacts touch).
"""

# MuJoCo's names come from a compiled module, which type checkers cannot see into.
# pyright: reportAttributeAccessIssue=false

import enum
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from wholearm_jax.core import Status, require_positive
from wholearm_jax.execution.acting_pairs import choose_pairs
from wholearm_jax.execution.closed_loop import (
    ControlledMotor,
    Hardware,
    closed_loop_step,
)
from wholearm_jax.execution.coulomb_friction import advance, has_given_up
from wholearm_jax.execution.executed_motion import (
    Event,
    ExecutedMotion,
    as_begun,
    contact_events,
    expected_phases,
    touching_contacts_at,
)
from wholearm_jax.execution.link_meetings import record_meetings, unexpected_meetings
from wholearm_jax.execution.mujoco_model import ContactCompliance, MujocoModel, build_mujoco_model
from wholearm_jax.execution.pushes import Push, push_force
from wholearm_jax.feedback import Controller, planned_motion
from wholearm_jax.model import (
    Arrival,
    Scene,
    TorqueSchedule,
    feature_pair,
    object_radius,
)
from wholearm_jax.phases import END_ANGLE, END_POSITION, Result, target_configuration, trajectory

SAMPLES = 2001  # of the prediction, a phase

Motor = Callable[[int, Float[np.ndarray, "2"]], Float[np.ndarray, "2"] | None]
"""The torque of a time step from its number and the joint angles before it; None at the end."""


class Tolerance(NamedTuple):
    """How near the predicted end counts as success: `position` and the last contacts' gaps [m], `angle` [rad]."""

    position: float = END_POSITION
    angle: float = END_ANGLE


class ExecutionOutcome(enum.Enum):
    """What became of an execution."""

    OK = "ok"
    LINKS_MET = "links_met"  # links touched that should not have
    CONTACT_LOST = "contact_lost"  # a contact of the last phase is open
    ASTRAY = "astray"  # all are closed, but the object does not stand where it should
    DIVERGED = "diverged"  # MuJoCo gave up, or contacts crept farther than the tolerance: too long a time step


@dataclass(frozen=True)
class Execution:
    """An executed plan beside its prediction.

    `course` is what happened, at every step; `expected` what was predicted, or a law's reference (NaN: friction holds
    the object at rest, the prediction ended, or the law waits for the next phase); `begins` is when phases begin [s].
    A law changes phases by what it measures: its reference stands here phase by phase from when it did. Their contacts
    are `names`, all pairs that may touch; `planned` are those of the phases, which do not say here whether they should
    roll. `link_contacts` are what links met, and when first [s]. `creep` is how far contacts slipped against Coulomb's
    law, at most [m]: an execution that crept farther than its tolerance diverged.
    """

    prediction: Result
    course: ExecutedMotion
    expected: ExecutedMotion
    begins: tuple[float, ...]
    names: tuple[str, ...]
    target: Float[np.ndarray, "5"]
    tolerance: Tolerance
    ending: ExecutionOutcome
    creep: float
    open_at_end: tuple[str, ...]
    events: tuple[Event, ...]
    link_contacts: dict[str, float]
    timestep: float
    model_xml: str

    @property
    def planned(self) -> tuple[str, ...]:
        """The contacts of all phases, each once."""
        return tuple(dict.fromkeys(feature_pair(name) for phase in self.prediction.phases for name in phase.contacts))

    @property
    def position_error(self) -> float:
        """Distance of the object from where the plan ends [m]."""
        return float(np.hypot(*(self.course.z[-1] - self.target)[:2]))

    @property
    def angle_error(self) -> float:
        """Its angle against that of the plan's end [rad]."""
        return float(self.course.z[-1, 2] - self.target[2])

    @property
    def message(self) -> str:
        """What became of the execution, in one line."""
        off = f"{1e3 * self.position_error:.3g} mm and {abs(self.angle_error):.2g} rad from the predicted end"
        why = f" at {', '.join(self.open_at_end)}" if self.open_at_end else ""
        if self.ending is ExecutionOutcome.LINKS_MET:
            meetings = unexpected_meetings(self.prediction, self.link_contacts)
            why = ": " + ", ".join(
                f"{name} at {time:.4g} s" for name, time in self.link_contacts.items() if name in meetings
            )
        if self.ending is ExecutionOutcome.DIVERGED:
            crept = f"contacts crept {1e3 * self.creep:.3g} mm"
            why = f" ({crept if np.isfinite(self.creep) else 'MuJoCo gave up'}: take a shorter time step)"
        return f"{self.ending.value}{why}, {off}"

    def force(self, contact: str, times=None) -> Float[np.ndarray, "times"]:
        """A contact's executed normal force [N] at given times, by default those of `expected`."""
        times = self.expected.time if times is None else times
        return np.interp(times, self.course.time, self.course.cn[:, self.names.index(feature_pair(contact))])


def execute(
    prediction: Result,
    *,
    timestep: float = 2e-4,
    softness: ContactCompliance = ContactCompliance(),
    tolerance: Tolerance = Tolerance(),
    controller: Controller | None = None,
    hardware: Hardware = Hardware(),
    pushes: Sequence[Push] = (),
    seed: int = 0,
) -> Execution:
    """Drive the free bodies by a predicted plan's torque schedule or a controller, from its start to its end.

    The prediction may fail, but its paths must be known: raises ValueError where one could not be traced, and for a
    `timestep` that is not positive. A controller measures and acts through `hardware`, whose noise `seed` draws; it
    does not see `pushes`, which act on the bodies beside the torques.
    """
    require_positive(timestep=timestep)
    scene = prediction.scene
    require_paths(prediction)
    times, step = clock(scene, timestep)
    torques: Float[np.ndarray, "steps 2"] | Motor = motor_torques(prediction.torque, times, step)
    begins = [float(phase.start) for phase in prediction.phases]
    if controller is not None:
        step = closed_loop_step(controller, hardware, scene, timestep)
        torques = motor = ControlledMotor(controller, hardware, step, seed)
        begins = motor.begins  # filled on the way
    bodies = build_mujoco_model(scene, step, softness)
    course, creep, met = run_schedule(bodies, scene, start_of(prediction), torques, step, pushes)
    courses = trajectory(prediction, SAMPLES) if controller is None else planned_motion(controller, prediction)
    phases, target = expected_phases(prediction, bodies.names, courses), target_of(prediction)
    if controller is not None:
        phases = as_begun(phases, begins, float(course.time[-1]))
    expected = ExecutedMotion(*(np.concatenate(field) for field in zip(*phases, strict=True)))
    unexpected = unexpected_meetings(prediction, met)
    ending, lost = assess_execution(scene, course.z[-1], target, tolerance, creep, unexpected)
    return Execution(
        prediction=prediction,
        course=course,
        expected=expected,
        begins=tuple(begins),
        names=bodies.names,
        target=target,
        tolerance=tolerance,
        ending=ending,
        creep=creep,
        open_at_end=lost,
        events=contact_events(bodies.names, expected, course),
        link_contacts=met,
        timestep=step,
        model_xml=bodies.xml,
    )


def require_paths(prediction: Result) -> None:
    """Raise ValueError where a plan has no end to compare with."""
    for phase in prediction.phases:
        if int(phase.traced.dynamics.status) != Status.OK:
            raise ValueError(phase.message)


def clock(scene: Scene, timestep: float) -> tuple[Float[np.ndarray, "steps"], float]:
    """When the steps begin, and their length [s], the nearest to `timestep` that divides the plan's duration."""
    total = sum(float(phase.duration) for phase in scene.phases)
    count = max(1, round(total / timestep))
    return np.arange(count) * (total / count), total / count


def motor_torques(
    schedule: TorqueSchedule, begins: Float[np.ndarray, "steps"], step: float
) -> Float[np.ndarray, "steps 2"]:
    """The torque [N m] that each step of length `step` [s] holds: that at its middle."""
    times, values = np.asarray(schedule.times), np.asarray(schedule.values)
    middle = begins + step / 2
    return np.stack([np.interp(middle, times, values[:, k]) for k in range(2)], axis=1)


def start_of(prediction: Result) -> Float[np.ndarray, "5"]:
    """The projected start of the plan's first path."""
    traced = prediction.phases[0].traced
    radius = object_radius(prediction.scene.object)
    return np.asarray(traced.path.start) * np.array([radius, radius, 1.0, 1.0, 1.0])


def target_of(prediction: Result) -> Float[np.ndarray, "5"]:
    """Where the plan ends: its last phase's destination, or the predicted end where it need not stand still there."""
    last = prediction.phases[-1]
    moving = last.arrive in (Arrival.MOVING, Arrival.ANY_SPEED) and prediction.status is Status.OK
    end = (
        trajectory(prediction, 2)[-1].z[-1]
        if moving
        else target_configuration(prediction.scene.phases[-1], last.traced)
    )
    return np.asarray(end)


def run_schedule(
    bodies: MujocoModel, scene: Scene, start, torques, timestep: float, pushes: Sequence[Push] = ()
) -> tuple[ExecutedMotion, float, dict[str, float]]:
    """The course of `rollout`, how far contacts crept, and what links met, when first [s]."""
    z, z_dot, forces, creep, met = rollout(bodies, start, torques, pushes)
    times = np.arange(len(z)) * timestep
    return (
        ExecutedMotion(times, z, z_dot, forces[..., 0], forces[..., 1], touching_contacts_at(scene, bodies.names, z)),
        creep,
        met,
    )


def rollout(bodies: MujocoModel, start, torques: Float[np.ndarray, "steps 2"] | Motor, pushes: Sequence[Push] = ()):
    """Step the model from rest at `start`: `z`, `z_dot` and forces `(c_n, c_t)`; row `k` is the state before step `k`.

    `torques` are those of each step, or what says them while the bodies move.

    Then how far contacts slipped against Coulomb's law in all steps together, at most [m], infinite where MuJoCo gave
    up; and what links met, or which range ended, when first [s].
    """
    data, step = mujoco.MjData(bodies.model), stepper(bodies)
    motor = torques if callable(torques) else _scheduled_motor(torques)
    push = push_force(pushes, bodies.model.opt.timestep)
    z, z_dot, forces = [], [], []
    data.qpos[:] = start
    found, creep, met, last = np.zeros((len(bodies.names), 2)), 0.0, {}, np.zeros(2)
    while (torque := motor(len(z), data.qpos[3:])) is not None:
        z.append(data.qpos.copy())
        z_dot.append(data.qvel.copy())
        found, wrong = step(bodies, data, torque, found, push(len(z) - 1))
        forces.append(found)
        last, creep = torque, creep + wrong * bodies.model.opt.timestep
        record_meetings(bodies, data, (len(z) - 1) * bodies.model.opt.timestep, met)
    z.append(data.qpos.copy())
    z_dot.append(data.qvel.copy())
    forces.append(step(bodies, data, last, found)[0])  # beyond the end, for the forces there
    return np.array(z), np.array(z_dot), np.array(forces), np.inf if has_given_up(data) else creep, met


def _scheduled_motor(torques: Float[np.ndarray, "steps 2"]) -> Motor:
    """Return the motor that follows torques known beforehand."""
    return lambda k, angles: torques[k] if k < len(torques) else None


def stepper(bodies: MujocoModel) -> Callable:
    """`coulomb.step`, or the same with MuJoCo's own friction."""
    return advance if bodies.softness.friction == "coulomb" else _advance


def _advance(bodies: MujocoModel, data: mujoco.MjData, torque, before, push=0.0):
    choose_pairs(bodies.model, bodies.acting, data.qpos)
    data.ctrl[:] = torque
    data.qfrc_applied[:] = push
    mujoco.mj_step(bodies.model, data)  # its contacts are those of the state before the step
    forces = np.zeros_like(before)
    _read_forces(bodies, data, forces)
    return forces, 0.0


def _read_forces(bodies: MujocoModel, data: mujoco.MjData, into) -> None:
    """Add the forces of all contacts, `(c_n, c_t)` on the object, to their pairs' rows."""
    contact = data.contact
    if not len(contact.dist):
        return
    row = bodies.pair[contact.geom[:, 0], contact.geom[:, 1]]
    axes = contact.frame.reshape(-1, 3, 3)[:, :, :2]
    at = contact.efc_address
    acting = np.flatnonzero((at >= 0) & (row < len(bodies.names)))
    rows = at[acting, None] + np.arange(3)
    force = np.einsum("ci,cik->ck", data.efc_force[rows], axes[acting])
    toward = bodies.toward[row[acting]]
    normal = axes[acting, 0] * toward[:, None]
    force *= toward[:, None]
    np.add.at(into[:, 0], row[acting], (force * normal).sum(1))
    np.add.at(into[:, 1], row[acting], force[:, 0] * normal[:, 1] - force[:, 1] * normal[:, 0])


def assess_execution(
    scene: Scene, z, target, tolerance: Tolerance, creep: float = 0.0, links_met: Collection[str] = ()
) -> tuple[ExecutionOutcome, tuple[str, ...]]:
    """What became of an execution that ended at `z` and crept so far, and which contacts of the last phase are open."""
    names = tuple(map(feature_pair, scene.phases[-1].formation.names))
    closed = touching_contacts_at(scene, names, z[None], tolerance.position)[0]
    lost = tuple(name for name, there in zip(names, closed, strict=True) if not there)
    off = np.abs(z - target)
    near = np.hypot(*off[:2]) <= tolerance.position and off[2] <= tolerance.angle
    if links_met:
        return ExecutionOutcome.LINKS_MET, lost
    if not creep <= tolerance.position:
        return ExecutionOutcome.DIVERGED, lost
    return (ExecutionOutcome.CONTACT_LOST if lost else ExecutionOutcome.OK if near else ExecutionOutcome.ASTRAY), lost
