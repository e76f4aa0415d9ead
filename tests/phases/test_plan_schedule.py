"""A schedule against its plan: refused where it cannot be followed, noted where it is much longer."""

import time
from pathlib import Path

import jax.numpy as jnp
import pytest
from support import layered, layered_file

import wholearm_jax as wa
from wholearm_jax.files.torque_csv import read_torque
from wholearm_jax.phases.plan_schedule import note_on_length


def schedule(last, rows=5):
    return wa.torque_schedule(jnp.linspace(0.0, last, rows), jnp.zeros((rows, 2)))


@pytest.mark.parametrize(
    ("row", "column", "value", "cause"),
    [
        (2, 0, jnp.nan, "row 2 has tau1 = nan"),
        (0, 1, jnp.nan, "row 0 has tau2 = nan"),
        (4, 1, jnp.inf, "row 4 has tau2 = inf"),
        (3, None, jnp.nan, "row 3 has t = nan"),
        (3, None, 0.1, "row 3 has t = 0.1 after 1"),
    ],
)
@pytest.mark.parametrize("function", [wa.simulate, lambda scene, torque: wa.check([scene], torque), wa.margin])
def test_a_schedule_that_cannot_be_followed_is_refused_at_once(function, row, column, value, cause):
    scene, start = layered("heptagon"), schedule(2.0)
    if column is None:
        torque = wa.TorqueSchedule(start.times.at[row].set(value), start.values)
    else:
        torque = wa.TorqueSchedule(start.times, start.values.at[row, column].set(value))
    begun = time.perf_counter()
    with pytest.raises(ValueError, match=cause):
        function(scene, torque)
    assert time.perf_counter() - begun < 2.0


@pytest.mark.parametrize(
    ("last", "noted"),
    [
        (2.0, None),
        (2.5, None),
        (8.0, "goes on to 8 s, 4 times the plan's 2 s"),
        (2000.0, "goes on to 2000 s, 1e+03 times the plan's 2 s; are its times in milliseconds?"),
    ],
)
def test_a_schedule_much_longer_than_its_plan_is_noted(last, noted):
    message = note_on_length(layered("heptagon"), schedule(last))
    assert message == (noted and f"the torque schedule {noted}")


def test_the_case_in_milliseconds(wholearm):
    path = Path(__file__).parents[1] / "data" / "cases" / "torque_ms.csv"
    assert "in milliseconds?" in note_on_length(layered("heptagon"), read_torque(path))
    _, _, errors = wholearm("simulate", layered_file("heptagon"), "--torque", path)
    assert f"note: {path}: the torque schedule goes on to 2000 s" in errors
