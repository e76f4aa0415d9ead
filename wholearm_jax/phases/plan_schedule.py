"""A torque schedule against a plan: what the plan requires of it, its jumps, and the steps that it needs."""

import numpy as np

from wholearm_jax.core import is_traced
from wholearm_jax.model import Arrival, Scene, TorqueSchedule, find_schedule_defect, has_jumps
from wholearm_jax.simulation import IntegratorOptions, with_step_capacity

LONG_SCHEDULE = 3.0  # length of a schedule, over that of its plan, from which it is noted


def require_motion(scene: Scene) -> None:
    """Raise ValueError for a plan with a phase that holds the object, where only phases that move it make sense."""
    for phase in scene.phases:
        if phase.arrive is Arrival.HOLD:
            raise ValueError(f"phase '{phase.name}' holds the object; this is for phases that move it")


def require_covered(scenes: Scene, torque: TorqueSchedule) -> None:
    """Raise ValueError for a schedule that cannot be followed, or is shorter than the (longest of stacked) plans."""
    require_followable(torque)
    total, first, last = _plan_duration(scenes), float(torque.times[0]), float(torque.times[-1])
    if first > 0 or last < total * (1 - 1e-9):
        raise ValueError(f"the torque schedule covers {first:g} to {last:g} s, the plan 0 to {total:g} s")


def require_followable(torque: TorqueSchedule) -> None:
    """Raise ValueError for a schedule that is not finite or not sorted, naming the row."""
    defect = find_schedule_defect(torque.times, torque.values)
    if defect is not None:
        raise ValueError(defect)


def note_on_length(scene: Scene, torque: TorqueSchedule) -> str | None:
    """Say that a schedule is much longer than its plan, and whether its unit may be the cause; None where it is not."""
    total, last = _plan_duration(scene), float(torque.times[-1])
    if last < LONG_SCHEDULE * total:
        return None
    hint = "; are its times in milliseconds?" if last > 100 * total else ""
    return f"the torque schedule goes on to {last:g} s, {last / total:.3g} times the plan's {total:g} s{hint}"


def _plan_duration(scenes: Scene) -> float:
    """Return the duration [s] of a plan, or of the longest plan of stacked scenes."""
    return float(np.max(sum(np.asarray(p.duration) for p in scenes.phases)))


def with_plan_step_capacity(options: IntegratorOptions, scene: Scene, torque: TorqueSchedule) -> IntegratorOptions:
    """Add capacity for the steps that a schedule's rows require within a phase.

    Counted are the rows within a phase, or all where times or durations are being transformed.
    """
    rows = torque.times.shape[0]
    if not is_traced(torque.times, [phase.duration for phase in scene.phases]):
        ends = np.cumsum([0.0, *(float(phase.duration) for phase in scene.phases)])
        rows = int(np.max(np.diff(np.searchsorted(np.asarray(torque.times), ends))))
    return with_step_capacity(options, rows)


def has_torque_jumps(scenes: Scene, torque: TorqueSchedule) -> bool:
    """Say whether a schedule jumps within a phase of a scene, or of one of stacked scenes.

    False where times or durations are being transformed.
    """
    if is_traced(torque.times, [phase.duration for phase in scenes.phases]):
        return False
    ends = np.cumsum([np.asarray(phase.duration) for phase in scenes.phases], axis=0)
    first = 0.0
    for before, phase, end in zip([None, *scenes.phases], scenes.phases, ends, strict=False):
        # A phase that is left while moving may end early: then the next phase has its remaining torques.
        if before is None or before.arrive is not Arrival.MOVING:
            first = float(np.min(end - np.asarray(phase.duration)))
        if has_jumps(torque, first, float(np.max(end))):
            return True
    return False
