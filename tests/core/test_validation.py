"""What functions need of their arguments is said at once, by name, before anything is computed."""

import subprocess
import sys

import pytest
from support import layered

import wholearm_jax as wa
from wholearm_jax.ensembles.ensemble import make_ensemble
from wholearm_jax.execution.executions import execute
from wholearm_jax.execution.trials import Amounts, run_trials


@pytest.fixture(scope="module")
def plan():
    scene = layered("heptagon")
    torque = wa.torque_schedule([0.0, 2.0], [[0.0, 0.0], [0.0, 0.0]])
    return scene, torque, wa.simulate(scene, torque)


WRONG = {
    "tolerance of simulate": (
        lambda s, t, r: wa.simulate(s, t, tolerance=-1e-9),
        "tolerance must be positive, not -1e-09",
    ),
    "arrival": (lambda s, t, r: wa.simulate(s, t, arrival=0.0), "arrival must be positive"),
    "steps of simulate": (lambda s, t, r: wa.simulate(s, t, max_steps=0), "max_steps must be positive"),
    "samples": (lambda s, t, r: wa.trajectory(r, 0), "samples must be positive"),
    "knots of quasistatic": (lambda s, t, r: wa.quasistatic(s, knots=1), "knots must be at least 2, not 1"),
    "knots": (lambda s, t, r: wa.optimise(s, knots=1), "knots must be at least 2, not 1"),
    "steps": (lambda s, t, r: wa.optimise(s, steps=0), "steps must be positive"),
    "rate limit": (lambda s, t, r: wa.optimise(s, rate_limit=0.0), "rate_limit must be positive"),
    "tolerance": (lambda s, t, r: wa.optimise(s, tolerance=float("nan")), "tolerance must be positive, not nan"),
    "durations": (lambda s, t, r: wa.optimise(s, durations=(2.0, 1.0)), "durations are"),
    "no scenes": (lambda s, t, r: wa.check([], t), "there are no scenes to stack"),
    "count of none": (lambda s, t, r: wa.check(make_ensemble(s, {"mass": "5%"}), t, count=0), "count must be positive"),
    "more than given": (lambda s, t, r: wa.check([s], t, count=2), "count is 2, but 1 scenes are given"),
    "count": (lambda s, t, r: wa.check(make_ensemble(s, {"mass": "5%"}), t), "an ensemble has no end"),
    "chunk": (lambda s, t, r: wa.check([s], t, chunk=0), "chunk must be positive"),
    "tolerance of check": (lambda s, t, r: wa.check([s], t, tolerance=0.0), "tolerance must be positive"),
    "time step": (lambda s, t, r: execute(r, timestep=-1e-4), "timestep must be positive"),
    "executions": (lambda s, t, r: run_trials(r, 0, Amounts()), "count must be positive"),
    "shares": (lambda s, t, r: run_trials(r, 1, Amounts(mass=1.0)), "of the mass less than 1"),
    "geometry": (lambda s, t, r: run_trials(r, 1, Amounts(geometry=0.05)), "edges of the polygon could cross"),
}


@pytest.mark.parametrize(("call", "message"), WRONG.values(), ids=WRONG.keys())
def test_arguments_that_make_no_sense(call, message, plan):
    with pytest.raises(ValueError, match=message):
        call(*plan)


TOLD_WHAT_JAX_DOES = """
import jax
from wholearm_jax.core.validation import require_x64
jax.config.update("jax_enable_x64", True)
jax.monitoring.register_event_duration_secs_listener(lambda event, _, **__: print(event))
"""


@pytest.mark.parametrize(("call", "compiles"), [("require_x64()", False), ("jax.numpy.zeros(())", True)])
def test_who_asks_for_float64_does_not_wait_for_the_compiler(call, compiles):
    """Programs that compile beside hold up every array that is computed meanwhile, by seconds."""
    run = subprocess.run([sys.executable, "-c", TOLD_WHAT_JAX_DOES + call], capture_output=True, text=True, check=True)
    assert ("backend_compile" in run.stdout) == compiles
