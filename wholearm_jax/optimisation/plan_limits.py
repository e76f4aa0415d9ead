"""What no schedule can exceed: the bound of each phase's margin in its duration, and the shortest duration.

The bound is the margin of the convex optimum, which covers motions of every speed. For a phase that is entered or left
at speed, which cannot wait first, it is the pointwise one (`quasistatic_plan.bounds`) where that is smaller. For one
that begins with a hand-over that no torque survives, it is the hand-over's margin, which is negative.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from wholearm_jax.core import as_device_array
from wholearm_jax.margin import MarginBound
from wholearm_jax.model import Arrival, Scene
from wholearm_jax.optimisation.best_motion import BestMotion, convex_bounds, shortest_motions
from wholearm_jax.optimisation.quasistatic_plan import bounds
from wholearm_jax.phases import STARTING, STOPPING, HandOver, TracedPhase, find_hand_overs, starts_at_rest, trace


def certified_bounds(
    scene: Scene, *, traced: tuple[TracedPhase, ...] = (), pointwise: tuple[MarginBound, ...] = ()
) -> tuple[MarginBound, ...]:
    """Return for each phase the bound of its margin in the phase's duration, that of the best motion.

    Where no motion takes so little time, it is the pointwise bound.

    Args:
        scene: the plan.
        traced: the result of `trace`, to reuse it.
        pointwise: the result of `bounds`, to reuse it.

    Returns:
        One `MarginBound` a phase: `value` [N], and where on the path it is tight.

    Raises:
        RuntimeError: without float64.
    """
    traced = traced or trace(scene)
    pointwise = pointwise or bounds(scene, traced=traced)
    tighter = tighten_bounds(scene, pointwise, convex_bounds(scene, traced=traced), traced)
    return limit_by_hand_overs(tighter, find_hand_overs(scene, traced), traced)


def tighten_bounds(
    scene: Scene,
    pointwise: tuple[MarginBound, ...],
    motions: tuple[BestMotion | None, ...],
    traced: tuple[TracedPhase, ...],
) -> tuple[MarginBound, ...]:
    """Return the margin of each phase's best motion, or its pointwise bound.

    The pointwise bound covers speeds up to multiples of a path length a duration; an object that waits may be faster
    than that afterwards, and only the best motion covers every speed. A phase that is entered or left at speed has the
    smaller of both.
    """
    pairs = zip(scene.phases, starts_at_rest(scene), strict=True)
    cannot_wait = [phase.arrive is Arrival.MOVING or not from_rest for phase, from_rest in pairs]

    def tighter(bound: MarginBound, motion: BestMotion | None, path: TracedPhase, moves: bool) -> MarginBound:
        if motion is None or not motion.feasible or not motion.margin > 0 or float(bound.value) <= 0:
            return bound
        if moves and motion.margin >= float(bound.value):
            return bound
        begin, length = path.dynamics.range()
        s = begin + motion.hardest_place * length
        return MarginBound(*(as_device_array(a) for a in (motion.margin, s, motion.hardest_place)))

    return tuple(tighter(*row) for row in zip(pointwise, motions, traced, cannot_wait, strict=True))


def limit_by_hand_overs(
    margin_bounds: tuple[MarginBound, ...], hand_overs: Sequence[HandOver | None], traced: tuple[TracedPhase, ...]
) -> tuple[MarginBound, ...]:
    """Return the margin of a hand-over as the bound of the phase that begins with it, where that is not positive."""

    def limited(bound: MarginBound, hand_over: HandOver | None, path: TracedPhase) -> MarginBound:
        if hand_over is None or (margin := hand_over.margin) > 0:
            return bound
        return MarginBound(*(as_device_array(a) for a in (margin, path.dynamics.range()[0], 0.0)))

    return tuple(limited(*row) for row in zip(margin_bounds, hand_overs, traced, strict=True))


def margins_by_either_contact(hand_overs: Sequence[HandOver | None]) -> Float[np.ndarray, "phases"]:
    """Return the largest margin of each phase [N] whose torques serve by either contact of the hand-overs at its ends.

    It is infinite for a phase without, and where no torque serves at all, which `limit_by_hand_overs` says.
    """
    left = np.full(len(hand_overs), np.inf)
    for k, over in enumerate(hand_overs):
        if over is not None and over.margin > 0:
            for phase, sign in ((k - 1, STOPPING), (k, STARTING)):
                left[phase] = min(left[phase], over.planned_margin(sign))
    return left


def too_short_phases(
    scene: Scene,
    pointwise: tuple[MarginBound, ...],
    motions: tuple[BestMotion | None, ...],
    traced: tuple[TracedPhase, ...],
) -> dict[int, float]:
    """Return the shortest duration [s] of each phase in whose duration no torque within limits can move the object.

    Args:
        scene: the plan.
        pointwise: bounds of its phases.
        motions: the best motions in the phases' durations.
        traced: of each phase.
    """

    def lacks_time(bound: MarginBound, motion: BestMotion | None) -> bool:
        return motion is not None and float(bound.value) > 0 and not (motion.feasible and motion.margin > 0)

    if not any(lacks_time(*pair) for pair in zip(pointwise, motions, strict=True)):
        return {}
    found = {}
    for k, fastest in enumerate(shortest_motions(scene, 0.0, traced=traced)):
        short = fastest is not None and fastest.feasible and float(scene.phases[k].duration) < fastest.duration
        if fastest is not None and short and lacks_time(pointwise[k], motions[k]):
            found[k] = fastest.duration
    return found
