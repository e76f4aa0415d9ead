"""Torque schedules: two joint torques over time, linear between rows; a repeated time is a step."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from wholearm_jax.core import as_device_array, take_row

ROW_MULTIPLE = 128  # schedules are padded to a multiple of this: those of like length share compiled programs
TIME_ROUNDING = 16  # times beside each other by this many of a precision's last digits are one


class TorqueSchedule(eqx.Module):
    """A torque schedule: `fused_matmul` [s], non-decreasing, and `values` [N m], one row `(tau1, tau2)` a time.

    A time that stands twice is a step: the first row holds before it, the second from it on.
    """

    times: Float[Array, "rows"]
    values: Float[Array, "rows 2"]


class PhaseSchedule(eqx.Module):
    """A schedule seen from one phase: `phase_time` is time in durations of the phase, 0 at its start and 1 at its end.

    Interval `k` runs from row `k` to row `k + 1`; those from `first` to `last` cover the phase. `slope` is the torque's
    rate per duration.
    """

    phase_time: Float[Array, "rows"]
    values: Float[Array, "rows 2"]
    slope: Float[Array, "rows_less_1 2"]
    first: Int[Array, ""]
    last: Int[Array, ""]


def torque_schedule(times, values) -> TorqueSchedule:
    """Build a schedule from `fused_matmul` `(rows,)` [s] and `values` `(rows, 2)` [N m], linear in between.

    Raises `ValueError` unless there are at least two rows, all finite, with times sorted and none more than twice.

    >>> wa.torque_schedule([0.0, 1.0], [[0.5, -0.2], [0.5, -0.4]]).values.shape
    (2, 2)
    >>> wa.torque_schedule([1.0, 0.0], [[0.5, -0.2], [0.5, -0.4]])
    Traceback (most recent call last):
    ValueError: times must not decrease, and none may stand more than twice
    """
    times, values = as_device_array(times, float), as_device_array(values, float)
    clock = np.asarray(times)
    if clock.ndim != 1 or clock.size < 2 or values.shape != (clock.size, 2):
        raise ValueError("a torque schedule needs at least two rows of t, tau1, tau2")
    if not (np.all(np.isfinite(clock)) and np.all(np.isfinite(np.asarray(values)))):
        raise ValueError("a torque schedule must be finite")
    if np.any(np.diff(clock) < 0) or np.any(clock[2:] == clock[:-2]):
        raise ValueError("times must not decrease, and none may stand more than twice")
    return TorqueSchedule(times, values)


def uniform_schedule(duration, values) -> TorqueSchedule:
    """A schedule of evenly spaced rows from time 0."""
    return TorqueSchedule(as_device_array(np.linspace(0.0, float(duration), len(values))), as_device_array(values))


def limit_violations(schedule: TorqueSchedule, limits) -> list[tuple[int, float, float, float]]:
    """Joints (1, 2) whose torque goes beyond its limit but for rounding, each with its largest magnitude [N m], when
    that is [s], and its limit."""
    times, sizes = np.asarray(schedule.times), np.abs(np.asarray(schedule.values))
    worst = sizes.argmax(0)
    told = zip((1, 2), sizes[worst, [0, 1]].tolist(), times[worst].tolist(), np.asarray(limits).tolist(), strict=True)
    return [(joint, size, when, limit) for joint, size, when, limit in told if size > limit * (1 + 1e-9)]


def concatenate_schedules(schedules: list[TorqueSchedule]) -> TorqueSchedule:
    """Schedules one after the other, each from time 0; a step where one follows another."""
    begins = np.cumsum([0.0, *(float(np.asarray(s.times)[-1]) for s in schedules[:-1])])
    times = [begin + np.asarray(s.times) for begin, s in zip(begins, schedules, strict=True)]
    return TorqueSchedule(
        *(as_device_array(np.concatenate(rows)) for rows in (times, [np.asarray(s.values) for s in schedules]))
    )


def has_jumps(schedule: TorqueSchedule, start: float, end: float) -> bool:
    """Whether the schedule steps between two times (a static choice for the integrator); a step that lies at one of
    them but for rounding does not count, as in `restrict_to_phase`."""
    times = np.asarray(schedule.times)
    stepped = times[1:][np.diff(times) == 0]
    near = time_tolerance(times, start, end)
    return bool(np.any((stepped > start + near) & (stepped < end - near)))


def time_tolerance(times: np.ndarray, start: float, end: float) -> float:
    """How far beside each other two times of a phase from `start` to `end` count as one, as in `restrict_to_phase`."""
    return TIME_ROUNDING * np.finfo(times.dtype).eps * (abs(start) + abs(end - start))


def round_up(rows: int, multiple: int = ROW_MULTIPLE) -> int:
    """The next multiple: as long as `pad_schedule` makes a schedule of `rows`."""
    return -(-rows // multiple) * multiple


@partial(jax.jit, static_argnames="multiple")
def pad_schedule(schedule: TorqueSchedule, multiple: int = ROW_MULTIPLE) -> TorqueSchedule:
    """The same schedule with its last row repeated."""
    missing = round_up(schedule.times.shape[0], multiple) - schedule.times.shape[0]
    ramp = schedule.times[-1] + (schedule.times[-1] - schedule.times[0]) * jnp.arange(1, missing + 1)
    rows = jnp.broadcast_to(schedule.values[-1], (missing, 2))
    return TorqueSchedule(jnp.concatenate([schedule.times, ramp]), jnp.concatenate([schedule.values, rows]))


def restrict_to_phase(schedule: TorqueSchedule, start: Float[Array, ""], duration: Float[Array, ""]) -> PhaseSchedule:
    """A schedule over one phase. Rows at its start or end but for rounding count as there: the times of phases are
    sums, and those of a file are rounded, so that a step between two phases would else be taken within one."""
    times = schedule.times
    gap = jnp.diff(times)
    rise = jnp.diff(schedule.values, axis=0)
    slope = jnp.where((gap > 0)[:, None], rise / jnp.where(gap > 0, gap, 1.0)[:, None], 0.0) * duration
    intervals = times.shape[0] - 1
    near = TIME_ROUNDING * jnp.finfo(times.dtype).eps * (jnp.abs(start) + duration)
    first = (times <= start + near).sum() - 1
    last = (times < start + duration - near).sum() - 1
    first = jnp.clip(first, 0, intervals - 1)
    return PhaseSchedule(
        phase_time=(times - start) / duration,
        values=schedule.values,
        slope=slope,
        first=first,
        last=jnp.clip(last, first, intervals - 1),
    )


def interval(phase_schedule: PhaseSchedule, phase_time: Float[Array, ""]) -> Int[Array, ""]:
    """The interval that holds at a share of the phase; a step belongs to what follows it, except at the phase's end."""
    return jnp.clip((phase_time >= phase_schedule.phase_time).sum() - 1, phase_schedule.first, phase_schedule.last)


def torque_at(phase_schedule: PhaseSchedule, number: Int[Array, ""], phase_time: Float[Array, ""]) -> Float[Array, "2"]:
    """The torque [N m] of one interval at a share of the phase."""
    return take_row(phase_schedule.values, number) + take_row(phase_schedule.slope, number) * (
        phase_time - take_row(phase_schedule.phase_time, number)
    )
