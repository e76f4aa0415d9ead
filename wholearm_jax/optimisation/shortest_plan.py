"""The shortest plan with a wanted margin: the fastest motions, stretched until a schedule keeps the margin."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import equinox as eqx

from wholearm_jax.core import Status
from wholearm_jax.model import Scene, replace_duration
from wholearm_jax.optimisation.best_motion import convex_bounds, shortest_motions
from wholearm_jax.optimisation.plan_limits import margins_by_either_contact
from wholearm_jax.phases import TracedPhase, find_hand_overs

if TYPE_CHECKING:
    from wholearm_jax.optimisation.optimiser import OptimisationResult

STRETCHES = (1.01, 1.03, 1.08, 1.2, 1.5, 2.0, 4.0)  # durations that are tried, over the shortest


def shortest_plan(
    solve: Callable[[Scene], "OptimisationResult"], scene: Scene, margin: float, traced: tuple[TracedPhase, ...]
) -> "OptimisationResult":
    """Find durations, nearly the shortest, in which every phase keeps a margin.

    No torque as a function of time is faster than the convex optimum; torques that are linear between knots take a
    little longer. Phases that miss the margin are stretched, the others keep their durations.

    Args:
        solve: optimises a plan for the largest margin in its durations.
        scene: the plan.
        margin: least force of every contact [N].
        traced: of each phase.

    Raises:
        ValueError: where a phase reaches the margin in no duration, or no schedule was found that does.
    """
    fastest = shortest_motions(scene, margin, traced=traced)
    largest = convex_bounds(scene, any_duration=True, traced=traced)
    by_either = margins_by_either_contact(find_hand_overs(scene, traced))
    for phase, motion, best, left in zip(scene.phases, fastest, largest, by_either, strict=True):
        reached = None
        if motion is not None and best is not None and not (motion.feasible and best.margin >= margin):
            reached = f"at most {best.margin:.4g} N in any time" if best.feasible else "none in any time"
        elif left < margin:
            reached = f"torques that serve by either contact of its hand-over reach {left:.4g} N"
        if reached is not None:
            raise ValueError(f"no motion of phase '{phase.name}' has a margin of {margin:g} N: {reached}")
    tried = [0] * len(fastest)
    while max(tried) < len(STRETCHES):
        phases = (
            phase if motion is None else replace_duration(phase, STRETCHES[number] * motion.duration)
            for phase, motion, number in zip(scene.phases, fastest, tried, strict=True)
        )
        optimum = solve(eqx.tree_at(lambda s: s.phases, scene, tuple(phases)))
        short = [
            motion is not None and not (found.status is Status.OK and found.margin >= margin)
            for motion, found in zip(fastest, optimum.result.phases, strict=True)
        ]
        if not any(short):
            return optimum
        tried = [number + int(misses) for number, misses in zip(tried, short, strict=True)]
    raise ValueError(f"no schedule with a margin of {margin:g} N was found; add knots, or lower the margin")
