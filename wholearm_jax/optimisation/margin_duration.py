"""Margin against duration: the shortest plan for each of many margins."""

from dataclasses import dataclass

import numpy as np

from wholearm_jax.model import Scene
from wholearm_jax.optimisation.best_motion import convex_bounds, shortest_motions
from wholearm_jax.phases import TracedPhase, trace

MARGIN_FRACTIONS = (0.0, 0.2, 0.4, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98, 0.99, 0.999)


@dataclass(frozen=True)
class Tradeoff:
    """Shortest durations of a plan's moving phases for margins that all of them keep.

    `durations[k, p]` [s] belongs to `margins[k]` [N] and phase `phases[p]` of the plan; `largest[p]` [N] is the margin
    that the phase reaches in any time.
    """

    phases: tuple[int, ...]
    largest: np.ndarray
    margins: np.ndarray
    durations: np.ndarray

    @property
    def total(self) -> np.ndarray:
        """Time of all moving phases together [s]."""
        return self.durations.sum(1)


def tradeoff(
    scene: Scene, *, fractions: tuple[float, ...] = MARGIN_FRACTIONS, traced: tuple[TracedPhase, ...] = ()
) -> Tradeoff:
    """Return the shortest durations for margins from 0 to the largest that the plan's phases allow.

    Args:
        scene: the plan.
        fractions: margins as fractions of the largest that every phase reaches in any time, below 1.
        traced: the result of `trace`, to reuse it.

    Raises:
        ValueError: for a plan of which no phase moves the object with a positive margin.
        RuntimeError: without float64.
    """
    traced = traced or trace(scene)
    best = convex_bounds(scene, any_duration=True, traced=traced)
    moving = {k: motion for k, motion in enumerate(best) if motion is not None}
    phases, largest = tuple(moving), np.array([motion.margin for motion in moving.values()])
    if not phases or not largest.min() > 0:
        raise ValueError("no torque moves the object with every contact compressive")
    margins = largest.min() * np.asarray(fractions)
    motions = [shortest_motions(scene, margin, traced=traced) for margin in margins]
    durations = np.array([[motion.duration for motion in row if motion is not None] for row in motions])
    return Tradeoff(phases, largest, margins, durations)
