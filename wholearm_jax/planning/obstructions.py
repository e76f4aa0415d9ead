"""What stands in the way of a goal, in words."""

from collections.abc import Sequence

import numpy as np

from wholearm_jax.model import ANGLE_COORDINATES, Hand
from wholearm_jax.planning.goal import Goal
from wholearm_jax.planning.moves import Move
from wholearm_jax.tracing import PathEnd

MOST = 3  # moves that are named
FAR = 5.0  # distance from the palm's middle, over the hand's reach, at which a goal cannot be meant
FAR_ANGLE = 4 * np.pi  # [rad]


def explain_failure(goal: Goal, z: np.ndarray, moves: Sequence[Move], floor: float, *, out_of_time: bool) -> str:
    """Say how near a search came to a goal, and what stops the moves that would lead nearer.

    Args:
        goal: the goal.
        z: the nearest configuration that was reached (5,), SI.
        moves: the moves from there that lead nearer to the goal.
        floor: the least margin [N] that a plan must allow.
        out_of_time: whether the search ended before all moves were tried.
    """
    missing = [
        f"{name} is off by " + (f"{np.degrees(d):.3g} deg" if name in ANGLE_COORDINATES else f"{1e3 * d:.3g} mm")
        for name, d in zip(goal.values, goal.distance(z), strict=True)
        if d > goal.tolerance[name]
    ]
    limit = "the search's limit was reached" if out_of_time else "all moves were tried"
    lines = [_explain_move(move, floor) for move in moves[:MOST]] or ["nothing that touches leads nearer"]
    return f"no plan: {limit}; nearest: {', '.join(missing) or 'at the goal'}; there {'; '.join(lines)}"


def explain_vain_search(start: np.ndarray, goal: Goal, hand: Hand, overlaps: Sequence[str]) -> str:
    """Say why a search need not begin; nothing where it may find a plan.

    Args:
        start: the configuration (5,), SI.
        goal: the goal.
        hand: the hand.
        overlaps: what `describe_overlaps` says of the start.
    """
    if overlaps:
        return f"at the start {'; '.join(overlaps)}: {_advise_on_overlaps(overlaps, hand)}"
    if goal.is_reached(start):
        return "the start is within the goal's tolerances already; smaller ones (--tolerance) ask for more"
    return _explain_far_goal(goal, hand)


def _advise_on_overlaps(overlaps: Sequence[str], hand: Hand) -> str:
    """Say what helps where links overlap at the start, or a joint is beyond its range."""
    if any("cross" in line or "clearance" in line for line in overlaps):
        search = f"search for a hand that fits, as with --hand-from {hand_ranges(hand)}"
        less = "give them less clearance, " if float(hand.clearance) else ""
        return f"{search}, {less}or let its fingers pass each other (layered)"
    more_range = "give the joint more range, or " if any("range" in line for line in overlaps) else ""
    return f"{more_range}correct its pose and angles"


def hand_ranges(hand: Hand) -> str:
    """Write ranges around a hand's dimensions as `--hand-from` takes them."""
    lengths, joints = np.asarray(hand.length), abs(np.asarray(hand.joint)[:, 0])
    length, joint = (f"{0.6 * row.min():.3g}:{1.6 * row.max():.3g}" for row in (lengths, joints))
    return f"length={length},joint={joint}"


def _explain_far_goal(goal: Goal, hand: Hand) -> str:
    """Say that a goal is so far off that its unit must be another one; nothing where it may be meant."""
    far = FAR * float((abs(hand.joint).max(1) + hand.length).max())
    for name, value in goal.values.items():
        if name in ANGLE_COORDINATES and abs(value) > FAR_ANGLE:
            turns = abs(value) / (2 * np.pi)
            return (
                f"{name} = {value:.4g} rad is {turns:.3g} turns: angles are in radians, on the command line also 'deg'"
            )
        if name not in ANGLE_COORDINATES and abs(value) > far:
            return f"{name} = {value:.4g} m is far out of reach: lengths are in metres, on the command line also 'mm'"
    return ""


def _explain_move(move: Move, floor: float) -> str:
    """Say how small a move's margin gets, and from where on it is too small; or what ends it."""
    name = f"{' '.join(move.contacts)} toward {move.toward}"
    lowest = float(move.margins.min())
    if lowest > floor:
        return f"{name} ends too soon" + (" at an obstacle" if move.end_reason == PathEnd.OBSTACLE else "")
    first, worst = (int(np.argmax(chosen)) for chosen in (move.margins <= floor, move.margins == lowest))
    percent = 100 / (len(move.margins) - 1)
    held = f"has a margin of {lowest:.3g} N" if np.isfinite(lowest) else "cannot be held by torques within limits"
    before = f", first too little at {percent * first:.0f} %" if first < worst else ""
    return f"{name} {held} at {percent * worst:.0f} % of its path{before}"
