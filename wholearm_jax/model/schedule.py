"""Torque schedules: two joint torques over time, linear between rows; a repeated time is a step."""

from typing import Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from wholearm_jax.core import array_module, as_concrete_array, as_device_array, is_traced, take_row

ROW_MULTIPLE = 128  # schedules are padded to a multiple of it, so that similar lengths share compiled programs
TIME_ROUNDING = 16  # times that differ by this many units of machine epsilon are one


class TorqueSchedule(eqx.Module):
    """A torque schedule: `times` [s], non-decreasing, and `values` [N m], one row `(tau1, tau2)` a time.

    A repeated time is a step: the first row holds before it, the second from it on. Batches have leading axes.
    """

    times: Float[Array | np.ndarray, "*lanes rows"]
    values: Float[Array | np.ndarray, "*lanes rows 2"]


class PhaseSchedule(eqx.Module):
    """A schedule in the time of one phase: `phase_time` is 0 at the phase's start and 1 at its end.

    Interval `k` runs from row `k` to row `k + 1`; those from `first` to `last` cover the phase. `slope` is the torque's
    rate per duration.
    """

    phase_time: Float[Array, "rows"]
    values: Float[Array, "rows 2"]
    slope: Float[Array, "rows_less_1 2"]
    first: Int[Array, ""]
    last: Int[Array, ""]


def torque_schedule(times, values) -> TorqueSchedule:
    """Build a torque schedule, linear between its rows.

    Args:
        times: Times `(rows,)` [s], sorted; a time that stands twice is a step.
        values: Torques `(rows, 2)` [N m], one row `(tau1, tau2)` a time.

    Returns:
        The schedule. Within a transformation shapes alone are checked.

    Raises:
        ValueError: For fewer than two rows, another shape, and, naming the row, for a number that is not finite and for
            times that decrease or stand more than twice.

    >>> wa.torque_schedule([0.0, 1.0], [[0.5, -0.2], [0.5, -0.4]]).values.shape
    (2, 2)
    >>> wa.torque_schedule([1.0, 0.0], [[0.5, -0.2], [0.5, -0.4]])
    Traceback (most recent call last):
    ValueError: times must not decrease, and none may stand more than twice: row 1 has t = 0 after 1
    """
    times, values = as_concrete_array(times, float), as_concrete_array(values, float)
    defect = find_schedule_defect(times, values)
    if defect is not None:
        raise ValueError(defect)
    return TorqueSchedule(times, values)


def find_schedule_defect(times, values) -> str | None:
    """Say why the rows of a schedule cannot be followed, naming the first that is wrong (from 0), or return None."""
    shape = times.shape
    if len(shape) != 1 or shape[0] < 2 or values.shape != (*shape, 2):
        return "a torque schedule needs at least two rows of t, tau1, tau2"
    if not is_traced(values):
        values = np.asarray(values)
        rows, joints = np.nonzero(~np.isfinite(values))
        if rows.size:
            row, joint = int(rows[0]), int(joints[0])
            return f"a torque schedule must be finite: row {row} has tau{joint + 1} = {values[row, joint]:g}"
    if is_traced(times):
        return None
    times = np.asarray(times)
    if not np.all(np.isfinite(times)):
        row = int(np.argmin(np.isfinite(times)))
        return f"a torque schedule must be finite: row {row} has t = {times[row]:g}"
    bad = np.flatnonzero(np.append(np.diff(times) < 0, False) | np.append(times[2:] == times[:-2], [False, False]))
    if bad.size:
        row = int(bad[0]) + (1 if times[bad[0] + 1] < times[bad[0]] else 2)
        order = f"row {row} has t = {times[row]:g} after {times[row - 1]:g}"
        return f"times must not decrease, and none may stand more than twice: {order}"
    return None


def uniform_schedule(duration, values) -> TorqueSchedule:
    """Return a schedule of uniformly spaced rows from time 0."""
    return TorqueSchedule(as_device_array(np.linspace(0.0, float(duration), len(values))), as_device_array(values))


def limit_violations(schedule: TorqueSchedule, limits) -> list[tuple[int, float, float, float]]:
    """Return the joints whose torque exceeds its limit by more than rounding.

    Each is `(number, magnitude [N m], time [s], limit [N m])` of its largest torque.
    """
    times, sizes = np.asarray(schedule.times), np.abs(np.asarray(schedule.values))
    rows = sizes.argmax(0)
    largest = zip((1, 2), sizes[rows, [0, 1]].tolist(), times[rows].tolist(), np.asarray(limits).tolist(), strict=True)
    return [(joint, size, time, limit) for joint, size, time, limit in largest if size > limit * (1 + 1e-9)]


def concatenate_schedules(schedules: list[TorqueSchedule]) -> TorqueSchedule:
    """Join schedules, each from time 0, one after the other, with a step between them."""
    begins = np.cumsum([0.0, *(float(np.asarray(s.times)[-1]) for s in schedules[:-1])])
    times = [begin + np.asarray(s.times) for begin, s in zip(begins, schedules, strict=True)]
    return TorqueSchedule(
        *(as_device_array(np.concatenate(rows)) for rows in (times, [np.asarray(s.values) for s in schedules]))
    )


def has_jumps(schedule: TorqueSchedule, start: float, end: float) -> bool:
    """Say whether the schedule jumps between two times, a static choice for the integrator.

    Jumps within rounding of `start` or `end` do not count, as in `restrict_to_phase`.
    """
    times = np.asarray(schedule.times)
    jumps = times[1:][np.diff(times) == 0]
    tolerance = time_tolerance(times, start, end)
    return bool(np.any((jumps > start + tolerance) & (jumps < end - tolerance)))


def time_tolerance(times: np.ndarray, start: float, end: float) -> float:
    """Return the difference [s] below which two times of a phase from `start` to `end` count as one."""
    return TIME_ROUNDING * np.finfo(times.dtype).eps * (abs(start) + abs(end - start))


def round_up(rows: int, multiple: int = ROW_MULTIPLE) -> int:
    """Return the next multiple: the length to which `pad_schedule` pads a schedule of `rows`."""
    return -(-rows // multiple) * multiple


def pad_schedule(schedule: TorqueSchedule, multiple: int = ROW_MULTIPLE) -> TorqueSchedule:
    """Pad a schedule, or several along leading axes, with rows after its end that repeat the last torque."""
    xp = array_module(schedule)
    times, values = xp.asarray(schedule.times), xp.asarray(schedule.values)
    missing = round_up(times.shape[-1], multiple) - times.shape[-1]
    ramp = times[..., -1:] + (times[..., -1:] - times[..., :1]) * np.arange(1, missing + 1, dtype=times.dtype)
    rows = xp.repeat(values[..., -1:, :], missing, axis=-2)
    return TorqueSchedule(xp.concatenate([times, ramp], -1), xp.concatenate([values, rows], -2))


def restrict_to_phase(
    schedule: TorqueSchedule, start: float | Float[Array, ""], duration: float | Float[Array, ""]
) -> PhaseSchedule:
    """Restrict a schedule to one phase.

    Rows within rounding of the phase's ends count as on them; otherwise a jump meant to fall between two phases could
    land inside one.
    """
    times, values = jnp.asarray(schedule.times), jnp.asarray(schedule.values)
    gap, rise = jnp.diff(times), jnp.diff(values, axis=0)
    slope = jnp.where((gap > 0)[:, None], rise / jnp.where(gap > 0, gap, 1.0)[:, None], 0.0) * duration
    intervals = times.shape[0] - 1
    tolerance = TIME_ROUNDING * jnp.finfo(times.dtype).eps * (jnp.abs(start) + duration)
    first = (times <= start + tolerance).sum() - 1
    last = (times < start + duration - tolerance).sum() - 1
    first = jnp.clip(first, 0, intervals - 1)
    return PhaseSchedule(
        phase_time=(times - start) / duration,
        values=values,
        slope=slope,
        first=first,
        last=jnp.clip(last, first, intervals - 1),
    )


@runtime_checkable
class HasIntervals(Protocol):
    """What has intervals over phase time: a schedule, or a closed-loop law."""

    @property
    def phase_time(self) -> Float[Array, "rows"]: ...
    @property
    def first(self) -> Int[Array, ""]: ...
    @property
    def last(self) -> Int[Array, ""]: ...


def interval(phase_schedule: HasIntervals, phase_time: Float[Array, ""]) -> Int[Array, ""]:
    """Return the interval of a normalised time; a jump belongs to the interval after it, except at the phase's end."""
    return jnp.clip((phase_time >= phase_schedule.phase_time).sum() - 1, phase_schedule.first, phase_schedule.last)


def torque_at(phase_schedule: PhaseSchedule, index: Int[Array, ""], phase_time: Float[Array, ""]) -> Float[Array, "2"]:
    """Evaluate the torque [N m] of interval `index` at a normalised time of the phase."""
    since = phase_time - take_row(phase_schedule.phase_time, index)
    return take_row(phase_schedule.values, index) + take_row(phase_schedule.slope, index) * since
