"""Closed-loop laws along a path: their design from a schedule, and the law itself."""

from wholearm_jax.feedback.controller import Controller, PhaseLaw
from wholearm_jax.feedback.design import ENCODER_COUNTS, feedback
from wholearm_jax.feedback.held_set import HeldSet, held_set
from wholearm_jax.feedback.law import LawState, begin, step
from wholearm_jax.feedback.law_tables import law_tables, require_same_plan
from wholearm_jax.feedback.passing_impulses import PassingImpulse, least_passing_impulse
from wholearm_jax.feedback.planned_motion import planned_motion

__all__ = [
    "ENCODER_COUNTS",
    "Controller",
    "HeldSet",
    "LawState",
    "PassingImpulse",
    "PhaseLaw",
    "begin",
    "feedback",
    "held_set",
    "law_tables",
    "least_passing_impulse",
    "planned_motion",
    "require_same_plan",
    "step",
]
