"""Plans of three formations without a stop, executed on free bodies: they end where they were predicted to."""

import pytest
from support import layered

import wholearm_jax as wa
from wholearm_jax.execution.executions import execute


@pytest.mark.parametrize("name", ["flight", "passage"])
def test_flights_end_where_predicted(name):
    found = wa.optimise(layered(name))
    assert found.result.status is wa.Status.OK
    done = execute(found.result, timestep=2e-4)
    assert done.position_error < 5e-5
    assert abs(done.angle_error) < 1e-3
