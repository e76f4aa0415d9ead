"""Which contact formation can come next, and which lead to a goal."""

from wholearm_jax.planning.plans import Plan, PlanningResult
from wholearm_jax.planning.search import plan
from wholearm_jax.planning.successors import (
    Successor,
    exit_velocity,
    flush_sides,
    successor_formations,
    touching_contacts,
)

__all__ = [
    "Plan",
    "PlanningResult",
    "Successor",
    "exit_velocity",
    "flush_sides",
    "plan",
    "successor_formations",
    "touching_contacts",
]
