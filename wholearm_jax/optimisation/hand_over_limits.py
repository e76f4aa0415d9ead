"""Limits of torques at hand-overs: the first and the last of a motion serve by either contact.

The path of a phase knows one of the two contacts only. What torques must do by the other one is linear in them
(`HandOver.unplanned_rows`). It is asked for all times at which an object may be there that is a little early or late.
"""

import itertools
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from wholearm_jax.model import Scene
from wholearm_jax.optimisation.interval_samples import SLACKS_PER_SAMPLE
from wholearm_jax.phases import STARTING, STOPPING, HandOver, may_hand_over

EARLY_OR_LATE = 0.01  # of a phase, that an object may come before or after its time
ROWS_AT_ONE_TIME = SLACKS_PER_SAMPLE + 1


def hand_over_row_count(scene: Scene, knots: int) -> int:
    """Return the rows that each interval of a plan needs: none where no phase may begin with a hand-over."""
    if not any(may_hand_over(scene, *pair) for pair in itertools.pairwise(scene.phases)):
        return 0
    return ROWS_AT_ONE_TIME * (2 if knots > 2 else 4)


def hand_over_rows(
    begin: HandOver | None, end: HandOver | None, phases: int, intervals: int, count: int
) -> Float[np.ndarray, "phases intervals rows 5"]:
    """Build the rows of phases that are solved together.

    Args:
        begin: the hand-over with which the first phase begins, if any.
        end: that with which the last one ends.
        phases: how many there are.
        intervals: of each phase.
        count: number of rows of each interval, `hand_over_row_count`.

    Returns:
        What must not be negative, linear in 1 and the torques at both ends of the interval, over their limits; rows
        of zeros where there is no limit.
    """
    result = np.zeros((phases, intervals, count, 5))
    for over, sign, phase in ((begin, STARTING, 0), (end, STOPPING, -1)):
        rows = np.zeros((0, 3)) if over is None else over.unplanned_rows(sign)
        for interval, x, at in _times(sign, intervals, count):
            constant, torque = rows[:, :1], rows[:, 1:]
            result[phase, interval, at : at + len(rows)] = np.hstack([constant, (1 - x) * torque, x * torque])
    return result


def _times(sign: float, intervals: int, count: int) -> Iterator[tuple[int, float, int]]:
    """Yield when torques must serve: interval, fraction of the interval, and where the rows for that time begin.

    Between these times torques are linear: what holds at both ends of each interval's share holds within.
    """
    span = (0.0, EARLY_OR_LATE) if sign == STARTING else (1 - EARLY_OR_LATE, 1.0)
    first_row = count // 2 if intervals == 1 and sign == STOPPING else 0  # a single interval has both ends
    for interval in range(intervals):
        low, high = np.clip(np.array(span) * intervals - interval, 0.0, 1.0)
        if high > low:
            yield from ((interval, x, first_row + k * ROWS_AT_ONE_TIME) for k, x in enumerate((low, high)))
