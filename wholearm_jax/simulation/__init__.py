"""The motion of one phase: adaptive steps that end on events."""

from wholearm_jax.simulation.event_step import path_acceleration, solver_step
from wholearm_jax.simulation.integrator import (
    IntegratorOptions,
    TerminalEvent,
    integrate_adaptive,
    tolerance_as_data,
    with_step_capacity,
)
from wholearm_jax.simulation.phase_motion import Motion, simulate_motion
