"""Plans in which a finger is away, or moves alone: what their schedules and paths must keep, and the statics of a hold.

Nothing turns a finger that is away while its torque stays within the dry friction of its joint, as its weight rests on
the joint; a schedule of no torque always does. While a finger moves alone the object must stay where it is.
"""

from typing import NamedTuple

import numpy as np

from wholearm_jax.core import Status
from wholearm_jax.margin import RestInterval, contact_statics, rest_margin, schedule_corners, without_joint
from wholearm_jax.model import AWAY_NAMES, LINKS, Phase, Scene, TorqueSchedule, regrasp_finger
from wholearm_jax.phases.phase_ends import describe_end
from wholearm_jax.phases.phase_tracing import TracedPhase
from wholearm_jax.tracing import PathEnd

IDLE_ROUNDING = 1e-9  # share of the torque limit by which an idle torque may exceed dry friction
STANDING_TOL = 1e-6  # [m] and [rad], within which the object stays where it is


class Defect(NamedTuple):
    """What is wrong with a phase in which a finger is away or moves alone."""

    status: Status
    time: float  # [s]
    detail: str


def idle_torques(phase: Phase, torques):
    """Return torques `(..., 2)` with zeros for the fingers that are away."""
    idle = [AWAY_NAMES.index(name) for name in phase.formation.away]
    return np.where(np.isin([0, 1], idle), 0.0, torques) if idle else torques


def find_standing_defect(
    scene: Scene, torque: TorqueSchedule, phase: Phase, traced: TracedPhase, start: float, duration: float
) -> Defect | None:
    """Find what is wrong with a phase whose path is known; None where nothing is."""
    wrong = _find_path_defect(scene, phase, traced)
    if wrong is not None:
        return Defect(wrong[0], start, wrong[1])
    for joint in map(AWAY_NAMES.index, phase.formation.away):
        times, torques = schedule_corners(torque, start, start + duration)
        dry, limit = float(scene.hand.dry[joint]), float(scene.hand.torque_limit[joint])
        turned = np.flatnonzero(np.abs(np.array(torques)[:, joint]) > dry + IDLE_ROUNDING * limit)
        if len(turned):
            size = abs(float(torques[turned[0]][joint]))
            detail = f"{LINKS[joint + 1]} does not stay away: its torque of {size:.3g} N m exceeds {dry:.3g} N m of dry"
            return Defect(Status.LEFT_FORMATION, float(times[turned[0]]), f"{detail} friction")
    return None


def _find_path_defect(scene: Scene, phase: Phase, traced: TracedPhase) -> tuple[Status, str] | None:
    """Say where the object would move in a regrasp, or what the finger meets instead of its contact."""
    if phase.regrasp is None:
        return None
    moved = np.abs(np.asarray(traced.end) - np.asarray(traced.begin))
    joint = 2 + regrasp_finger(phase.regrasp)
    if np.delete(moved, joint).max() > STANDING_TOL:
        return Status.LEFT_FORMATION, f"{' '.join(phase.formation.names)} do not hold the object while the finger moves"
    end = describe_end(scene, phase, traced)
    if bool(traced.dynamics.ends_at_obstacle):
        return Status.OBSTACLE, end
    made = int(traced.path.end_reason) == PathEnd.CONTACT_MADE
    if made and phase.regrasp in AWAY_NAMES:
        return Status.OBSTACLE, f"{end} before the finger is away"
    if made and end != f"{phase.regrasp} is made":
        return Status.OBSTACLE, f"{end} before {phase.regrasp}"
    return None


def hold_during_regrasp(
    scene: Scene, torque: TorqueSchedule, phase: Phase, traced: TracedPhase, start: float, duration: float
) -> RestInterval:
    """Return the statics of the hold in a phase in which a finger moves alone: its joint has no part in them."""
    assert phase.regrasp is not None
    statics = contact_statics(scene, phase.formation, traced.begin)
    return rest_margin(without_joint(statics, regrasp_finger(phase.regrasp)), torque, start, start + duration)
