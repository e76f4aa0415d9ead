"""Closed-loop laws along a path: their design from a schedule, and the law itself."""

from wholearm_jax.feedback.controller import Controller, PhaseLaw
from wholearm_jax.feedback.design import feedback
from wholearm_jax.feedback.law import LawState, begin, step
from wholearm_jax.feedback.law_tables import law_tables, require_same_plan

__all__ = ["Controller", "LawState", "PhaseLaw", "begin", "feedback", "law_tables", "require_same_plan", "step"]
