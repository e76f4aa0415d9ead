"""In 32 bits wires are traced and margins computed, to the digits that there are; what needs 64 bits says so."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import wholearm_jax as wa

DATA = Path(__file__).parents[1] / "data"
PROGRAM = """
import sys
import wholearm_jax as wa
scene, torque = wa.load("heptagon"), wa.read_torque(sys.argv[1])
traced = wa.trace(scene)
print(traced[0].dynamics.breakpoints.dtype, *(int(one.dynamics.status) for one in traced))
print(float(wa.margin(scene, torque, options=wa.IntegratorOptions(tolerance=1e-5))))
try:
    wa.simulate(scene, torque)
except RuntimeError as error:
    print(error)
"""


def test_margins_in_single_precision():
    schedule = DATA / "heptagon_torque.csv"
    surroundings = {name: value for name, value in os.environ.items() if name != "JAX_ENABLE_X64"}
    command = [sys.executable, "-c", PROGRAM, str(schedule)]
    done = subprocess.run(command, env=surroundings, capture_output=True, text=True, check=True)
    traced, margin, refusal = done.stdout.splitlines()
    assert traced == "float32 0 0"
    exact = wa.simulate(wa.load("heptagon"), wa.read_torque(schedule)).margin
    assert float(margin) == pytest.approx(exact, rel=1e-4)
    assert float(margin) != exact
    assert "float64" in refusal
