"""Which contact formation can come next, and which lead to a goal."""

from wholearm_jax.planning.goal import make_goal
from wholearm_jax.planning.hand_search import HandSearchResult, HandTrial, plan_with_hand
from wholearm_jax.planning.obstructions import hand_ranges
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
    "HandSearchResult",
    "HandTrial",
    "Plan",
    "PlanningResult",
    "Successor",
    "exit_velocity",
    "flush_sides",
    "hand_ranges",
    "make_goal",
    "plan",
    "plan_with_hand",
    "successor_formations",
    "touching_contacts",
]
