"""Precompilation: what `optimise` runs is compiled in the background, while paths are traced."""

import numpy as np
import optax

from wholearm_jax.core import BackgroundTask, as_device_array, compile_in_background
from wholearm_jax.dynamics import placeholder_dynamics
from wholearm_jax.margin import largest_margin, rest_to_rest
from wholearm_jax.model import Arrival, Scene
from wholearm_jax.optimisation.constraints import Limits
from wholearm_jax.optimisation.coupled_phases import (
    GUESS_TORQUE_FRACTION,
    schedule_rows,
    solver_method,
    stack_dynamics,
)
from wholearm_jax.optimisation.hand_over_limits import hand_over_row_count
from wholearm_jax.optimisation.initial_guess import initial_guesses
from wholearm_jax.optimisation.iteration import init_solver, take_step
from wholearm_jax.optimisation.multiple_shooting import extra_parts
from wholearm_jax.optimisation.quasistatic_plan import DEFAULT_KNOTS, rolling_count, upper_bound
from wholearm_jax.optimisation.solver import INTERVAL_OPTIONS
from wholearm_jax.optimisation.variables import Variables
from wholearm_jax.phases import group_phases, precompile_simulation
from wholearm_jax.simulation import IntegratorOptions, with_step_capacity
from wholearm_jax.tracing import Resolution


def precompile_optimise(
    scene: Scene, *, knots: int = DEFAULT_KNOTS, optimiser: optax.GradientTransformation | None = None
) -> tuple[BackgroundTask, ...]:
    """Compile what `optimise` runs, in the background; returns the tasks to wait for."""
    sizes = sorted({len(group) for group in group_phases(scene) if scene.phases[group[0]].arrive is not Arrival.HOLD})
    rolling = sorted({rolling_count(p) for p in scene.phases if p.arrive is not Arrival.HOLD})
    guesses = compile_in_background(_compile_guesses, tuple(sizes), tuple(rolling), knots)
    rows = hand_over_row_count(scene, knots)
    steps = [compile_in_background(_compile_step, n, knots, rows, optimiser) for n in sizes]
    options = with_step_capacity(IntegratorOptions(), knots)
    return (
        guesses,
        *steps,
        compile_in_background(precompile_simulation, schedule_rows(len(scene.phases), knots), options),
    )


def _compile_guesses(sizes: tuple[int, ...], rolling: tuple[int, ...], knots: int) -> None:
    """Compute bounds and initial guesses for groups of such sizes on placeholders."""
    dynamics, one = placeholder_dynamics(Resolution()), as_device_array(1.0)
    for count in rolling:
        upper_bound(dynamics, one, as_device_array(True), as_device_array(True), count)
        largest_margin(dynamics, one, rest_to_rest(), count)
    for phases in sizes:
        initial_guesses([dynamics] * phases, np.ones(phases), knots, GUESS_TORQUE_FRACTION)


def _compile_step(phases: int, knots: int, rows: int, optimiser: optax.GradientTransformation | None) -> None:
    """Take one step of the solver on placeholders, with so many `hand_over_rows`."""
    phase_dynamics = stack_dynamics([placeholder_dynamics(Resolution())] * phases)
    method = solver_method(optimiser, phases, extra_parts(phase_dynamics), rows)
    each, is_fixed, hand_over = np.ones(phases), np.zeros((phases, knots), bool), np.zeros((phases, knots - 1, rows, 5))
    values = (np.full(2, np.inf), each, each, np.zeros(()), is_fixed, each, hand_over)
    limits = Limits(*(as_device_array(a) for a in values))
    empty = (np.zeros((phases, knots, 2)), np.zeros((phases, knots, 2)), np.zeros(phases))
    p = Variables(*(as_device_array(a) for a in empty))
    take_step(init_solver(p, method), phase_dynamics, limits, INTERVAL_OPTIONS, method)
