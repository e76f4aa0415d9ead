"""Torque schedules with the largest margin: multiple shooting, interior point, Riccati recursion, the paper's search.

`optimiser` explains how the parts work together."""

from wholearm_jax.optimisation.advice import Search, explain
from wholearm_jax.optimisation.best_motion import convex_bounds, shortest_motions
from wholearm_jax.optimisation.margin_duration import Tradeoff, tradeoff
from wholearm_jax.optimisation.optimiser import MIN_TRANSITION_SPEED, OptimisationResult, optimise
from wholearm_jax.optimisation.plan_limits import certified_bounds
from wholearm_jax.optimisation.precompilation import precompile_optimise
from wholearm_jax.optimisation.quasistatic_plan import DEFAULT_KNOTS, bounds, quasistatic
from wholearm_jax.optimisation.step_search import precompile_search, search_by_steps
