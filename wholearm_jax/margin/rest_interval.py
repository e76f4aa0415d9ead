"""Times at which friction holds the object at rest, and their margin under a torque schedule.

While the torque is linear in time the margin of `statics` is concave, so that its minimum lies at an end.
"""

from typing import NamedTuple

import numpy as np

from wholearm_jax.margin.statics import Statics
from wholearm_jax.margin.strong_stability import moving_mode
from wholearm_jax.model import TorqueSchedule, time_tolerance

FEASIBILITY_TOL = -1e-8  # least margin that counts as possible, over the unit of force: rounding


class RestInterval(NamedTuple):
    """An object at rest for a while."""

    start: float  # [s]
    end: float  # [s]
    margin: float  # least margin [N]
    time: float  # of the least margin [s]
    contact: str  # that limits it, or that is lost
    loss_time: float | None  # time from which no forces can hold the object [s]; None: some always can
    may_move: tuple[str, ...] = ()  # what contacts may do instead, by Coulomb's law; none where the object must stay

    @property
    def message(self) -> str:
        """The interval and its margin, in one line."""
        span = f"held at rest from {self.start:.4g} to {self.end:.4g} s"
        if self.loss_time is not None:
            return f"{span}: not possible from t = {self.loss_time:.6g} s, {self.contact} would have to pull"
        weak = f"; weakly: by Coulomb's law it may as well move, {', '.join(self.may_move)}" if self.may_move else ""
        return f"{span}, hold's margin {self.margin:.4g} N at {self.contact}{weak}"


def rest_margin(
    balance: Statics, schedule: TorqueSchedule, start: float, end: float, *, judge_stability: bool = True
) -> RestInterval:
    """Compute the margin of an object at rest from `start` to `end` [s] under a schedule, exactly.

    `judge_stability` says whether to find out what else the contacts may do.
    """
    times, torques = schedule_corners(schedule, start, end)
    margins = [balance.margin_under(torque) for torque in torques]
    worst = int(np.argmin([each.margin for each in margins]))
    floor = FEASIBILITY_TOL * balance.unit
    lost = next((k for k, each in enumerate(margins) if each.margin < floor), None)
    if lost is None:
        may_move = moving_mode(balance, np.array(torques[:-1])) if judge_stability else ()  # at the end it may start
        least = margins[worst]
        return RestInterval(start, end, least.margin, times[worst], least.contact, None, may_move)
    before = max(lost - 1, 0)
    fraction = balance.loss_fraction(torques[before], torques[lost]) if lost > 0 else 1.0
    loss_time = times[before] + fraction * (times[lost] - times[before])
    return RestInterval(start, end, margins[worst].margin, times[worst], margins[lost].contact, loss_time)


def schedule_corners(schedule: TorqueSchedule, start: float, end: float) -> tuple[list[float], list[np.ndarray]]:
    """Return times and torques between which a schedule is linear.

    A jump has both its sides, except one at `start` or `end`: there only the side within counts.
    """
    times, values = np.asarray(schedule.times), np.asarray(schedule.values)
    tolerance = time_tolerance(times, start, end)
    inside = (times > start + tolerance) & (times < end - tolerance)

    def interpolate(time, row):
        row = int(np.clip(row, 0, len(times) - 2))
        gap = times[row + 1] - times[row]
        return values[row] + (values[row + 1] - values[row]) * ((time - times[row]) / gap if gap > 0 else 1.0)

    first = np.searchsorted(times, start + tolerance, side="right") - 1
    last = np.searchsorted(times, end - tolerance, side="left") - 1
    torques = [interpolate(start, first), *values[inside], interpolate(end, last)]
    return [start, *times[inside].tolist(), end], torques
