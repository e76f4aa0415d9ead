"""In 32 bits paths are traced and margins computed, to the digits that there are; what needs 64 bits says so."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from support import layered

import wholearm_jax as wa

DATA = Path(__file__).parents[1] / "data"
PROGRAM = """
import sys
import wholearm_jax as wa
from support import layered
scene, torque = layered("heptagon"), wa.read_torque(sys.argv[1])
traced = wa.trace(scene)
print(traced[0].dynamics.breakpoints.dtype, *(int(one.dynamics.status) for one in traced))
print(float(wa.margin(scene, torque, options=wa.IntegratorOptions(tolerance=1e-5))))
try:
    wa.simulate(scene, torque)
except RuntimeError as error:
    print(error)
"""


@pytest.mark.slow
def test_margins_in_single_precision():
    schedule = DATA / "heptagon_torque.csv"
    surroundings = {name: value for name, value in os.environ.items() if name != "JAX_ENABLE_X64"}
    surroundings["PYTHONPATH"] = os.pathsep.join(sys.path)  # `support`
    command = [sys.executable, "-c", PROGRAM, str(schedule)]
    done = subprocess.run(command, env=surroundings, capture_output=True, text=True, check=True)
    traced, margin, refusal = done.stdout.splitlines()
    assert traced == "float32 0 0"
    exact = wa.simulate(layered("heptagon"), wa.read_torque(schedule)).margin
    assert float(margin) == pytest.approx(exact, rel=1e-4)
    assert float(margin) != exact
    assert "float64" in refusal


DEFAULTS = """
import sys
import wholearm_jax as wa
from support import layered
for name, torque in zip(("heptagon", "hexagon", "tipping"), sys.argv[1:]):
    print(float(wa.margin(layered(name), wa.read_torque(torque))))
"""


def run(program, *arguments):
    """Run a program in 32 bits, and return what it prints."""
    surroundings = {name: value for name, value in os.environ.items() if name != "JAX_ENABLE_X64"}
    surroundings["PYTHONPATH"] = os.pathsep.join(sys.path)  # `support`
    command = [sys.executable, "-c", program, *map(str, arguments)]
    return subprocess.run(command, env=surroundings, capture_output=True, text=True, check=True).stdout.splitlines()


def test_margins_in_single_precision_at_the_defaults():
    names = "heptagon", "hexagon", "tipping"
    schedules = [DATA / f"{name}_torque.csv" for name in names]
    margins = map(float, run(DEFAULTS, *schedules))
    for name, schedule, margin in zip(names, schedules, margins, strict=True):
        exact = wa.simulate(layered(name), wa.read_torque(schedule)).margin
        assert margin == pytest.approx(exact, rel=1e-4)
        assert margin != exact


REFUSING = """
import sys
import jax
import wholearm_jax as wa
from support import layered
from wholearm_jax.ensembles import make_ensemble, optimise_robustly
from wholearm_jax.phases.gradients import check_gradient, torque_gradient
from wholearm_jax.planning import successor_formations, touching_contacts

scene, torque = layered("heptagon"), wa.torque_schedule([0.0, 2.0], [[0.5, -0.2], [0.5, -0.2]])
ensemble = make_ensemble(scene, {"friction": "10%"})
CALLS = {
    "simulate": lambda: wa.simulate(scene, torque),
    "bounds": lambda: wa.bounds(scene),
    "quasistatic": lambda: wa.quasistatic(scene),
    "optimise": lambda: wa.optimise(scene),
    "search_by_steps": lambda: wa.search_by_steps(scene),
    "check": lambda: wa.check([scene], torque),
    "check of an ensemble": lambda: wa.check(ensemble, torque, count=2),
    "optimise_robustly": lambda: optimise_robustly(ensemble, samples=2),
    "torque_gradient": lambda: torque_gradient(scene, torque),
    "check_gradient": lambda: check_gradient(scene, torque),
    "touching_contacts": lambda: touching_contacts(scene, scene.start),
    "successor_formations": lambda: successor_formations(scene, scene.start),
}

def refused(name, call):
    try:
        call()
    except RuntimeError as error:
        print(f"{name}: {error}")

for name, call in CALLS.items():
    refused(name, call)
jax.config.update("jax_enable_x64", True)  # too late for this scene
for name, call in CALLS.items():
    refused(name, call)
print(len(CALLS))
"""


def test_what_needs_double_precision_refuses_single():
    """Also a scene in 32 bits where JAX computes in 64."""
    *refusals, count = run(REFUSING)
    assert len(refusals) == 2 * int(count)
    assert all("this function needs float64" in line for line in refusals)
    assert sum("not float32 arrays" in line for line in refusals) >= int(count)
