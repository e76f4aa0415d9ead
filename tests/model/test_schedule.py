"""Torque schedules: what cannot be followed is refused with its row; jumps, padding, joining."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from wholearm_jax.model.schedule import TorqueSchedule, find_schedule_defect, limit_violations, torque_schedule

ZEROS = np.zeros((4, 2))


def with_value(row, joint, value):
    values = ZEROS.copy()
    values[row, joint] = value
    return values


DEFECTS = {
    "NaN": ([0, 1, 2, 3], with_value(2, 0, np.nan), "must be finite: row 2 has tau1 = nan"),
    "infinity": ([0, 1, 2, 3], with_value(3, 1, -np.inf), "must be finite: row 3 has tau2 = -inf"),
    "time": ([0, np.nan, 2, 3], ZEROS, "must be finite: row 1 has t = nan"),
    "decreasing": ([0, 1, 0.5, 3], ZEROS, "must not decrease.*: row 2 has t = 0.5 after 1"),
    "three times": ([0, 1, 1, 1], ZEROS, "more than twice: row 3 has t = 1 after 1"),
    "three times, then less": ([1, 1, 1, 0], ZEROS, "row 2 has t = 1 after 1"),
    "one row": ([0], np.zeros((1, 2)), "at least two rows"),
    "shapes": ([0, 1, 2], ZEROS, "at least two rows"),
    "no axis": (0.0, ZEROS, "at least two rows"),
}


@pytest.mark.parametrize(("times", "values", "cause"), DEFECTS.values(), ids=DEFECTS.keys())
def test_what_cannot_be_followed_is_named_by_its_row(times, values, cause):
    with pytest.raises(ValueError, match=cause):
        torque_schedule(times, values)


def test_a_schedule_may_be_built_within_a_transformation():
    times = np.linspace(0.0, 1.0, 3)

    def total(values):
        return torque_schedule(times, values).values.sum() + torque_schedule(times * values[0, 0], ZEROS[:3]).times[-1]

    values = jnp.ones((3, 2))
    assert float(jax.jit(total)(values)) == 7.0
    assert jax.grad(total)(values).tolist() == [[2, 1], [1, 1], [1, 1]]
    assert jax.vmap(total)(jnp.stack([values, 2 * values])).tolist() == [7, 14]
    mixed = jax.jit(lambda torque: torque_schedule([0.0, 1.0], [[torque, 0.0], [0.0, torque]]).values)
    assert mixed(2.0).tolist() == [[2, 0], [0, 2]]
    with pytest.raises(ValueError, match="at least two rows"):
        jax.jit(lambda values: torque_schedule(times[:2], values).values)(values)
    with pytest.raises(ValueError, match="must not decrease"):
        jax.jit(lambda values: torque_schedule(times[::-1], values).values)(values)


def test_defects_of_a_schedule_built_by_hand():
    schedule = TorqueSchedule(jnp.arange(4.0), jnp.asarray(with_value(1, 1, np.nan)))
    assert "row 1 has tau2 = nan" in find_schedule_defect(schedule.times, schedule.values)
    assert find_schedule_defect(jnp.arange(4.0), jnp.asarray(ZEROS)) is None


def test_limits_that_are_exceeded():
    schedule = torque_schedule([0, 1, 2, 3], with_value(2, 1, -1.5))
    assert limit_violations(schedule, [1.0, 1.0]) == [(2, 1.5, 2.0, 1.0)]
    assert limit_violations(schedule, [1.0, 1.5]) == []
