"""The motion of one phase: adaptive steps that end on events."""

from wholearm_jax.simulation.closed_loop import (
    SEARCH_BLOCK,
    Actuation,
    PhaseLoop,
    memory_rate,
    place_on_path,
    torque_of,
)
from wholearm_jax.simulation.integrator import TerminalEvent, integrate_adaptive
from wholearm_jax.simulation.integrator_options import (
    Adjoint,
    IntegratorOptions,
    options_with_steps,
    tolerance_as_data,
    with_step_capacity,
)
from wholearm_jax.simulation.interpolation import (
    DenseOutput,
    dense_output,
    evaluate_dense,
    evaluate_memory,
    quintic_hermite,
)
from wholearm_jax.simulation.motion_record import Motion, torques_of_step
from wholearm_jax.simulation.path_ode import (
    PathODE,
    join_state,
    path_acceleration,
    solver_step,
    split_state,
    state_rate,
)
from wholearm_jax.simulation.phase_loop import loop_duration, phase_loop
from wholearm_jax.simulation.phase_motion import simulate_motion
from wholearm_jax.simulation.replay import integrate_with_replay_adjoint, replay_steps
