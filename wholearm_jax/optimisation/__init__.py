"""Torque schedules with the largest margin: multiple shooting, interior point, Riccati recursion, the paper's
search."""

from wholearm_jax.optimisation.optimiser import (
    MIN_TRANSITION_SPEED,
    OptimisationResult,
    bounds,
    optimise,
    precompile_optimise,
    quasistatic,
)
from wholearm_jax.optimisation.step_search import precompile_search, search_by_steps
