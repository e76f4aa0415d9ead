"""Places between the phases of a plan, moved until its certificate is as large as it gets.

The search leaves moves at a few fractions of their paths only. Here each place at which a phase is left, but for the
last, moves to and fro along the phase's path for as long as the plan's certificate, the least bound of its phases, gets
larger; then by half as much (a compass search: Kolda, Lewis, Torczon, "Optimization by direct search", SIAM Review
45(3), 2003, section 3).
"""

import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from wholearm_jax.core import as_device_array
from wholearm_jax.model import COORDINATES, feature_pair
from wholearm_jax.planning.moves import move_along
from wholearm_jax.planning.plans import Plan, Step, leading_coordinate

FIRST_SHIFT, LAST_SHIFT = 1 / 4, 1 / 64  # of a place, as shares of its phase's displacement
LEAST_GAIN = 1e-3  # of the certificate, for which a place moves
MAX_TRIES = 60  # plans that are traced, at most
REACHED = 1e-6  # distance from a place at which a phase is said to end [m, rad]


def improve_plan(
    plan: Plan, unit: Float[np.ndarray, "5"], make: Callable[[tuple[Step, ...], float], Plan | None]
) -> Plan:
    """Move the places between a plan's phases until its certificate is as large as it gets.

    Args:
        plan: the plan.
        unit: of the coordinates.
        make: traces steps as a plan with a certificate above a floor [N]; None where they are none.

    Returns:
        A plan of the same formations in the same order, with a certificate at least as large.
    """
    shift, tries = FIRST_SHIFT, MAX_TRIES
    while shift >= LAST_SHIFT and tries > 0:
        moved = False
        for number, share in itertools.product(range(len(plan.steps) - 1), (shift, -shift)):
            steps = _moved(plan, number, share, unit)
            if steps is not None and tries > 0:
                found, tries = make(steps, (1 + LEAST_GAIN) * plan.bound), tries - 1
                plan, moved = found or plan, moved or found is not None
        if not moved:
            shift /= 2
    return plan


def _moved(plan: Plan, number: int, share: float, unit) -> tuple[Step, ...] | None:
    """Return a plan's steps with the end of one moved by a share of its displacement; None where it cannot be."""
    step, following = plan.steps[number : number + 2]
    if step.regrasp or following.regrasp:
        return None
    held, kept = ({*map(feature_pair, one.contacts)} for one in (step, following))
    if step.until is None and (share > 0 or not kept <= held):
        return None  # beyond its path's end, or without a contact that comes only there
    displacement = plan.ends[number] - plan.begins[number]
    name = step.until[0] if step.until else leading_coordinate(displacement, unit)
    row = COORDINATES.index(name)
    until = (name, float(plan.ends[number][row] + share * displacement[row]))
    return (*plan.steps[:number], replace(step, until=until, leaves=None), *plan.steps[number + 1 :])


def is_secure(plan: Plan, *, regrasps: bool) -> bool:
    """Say whether each phase is a move, and those before the last end as said, not just where a contact is lost."""
    for number, (step, begin, end) in enumerate(zip(plan.steps, plan.begins, plan.ends, strict=True)):
        if step.regrasp:
            continue
        move = move_along(plan.scene, as_device_array(begin), step.contacts, step.toward, regrasps=regrasps)
        if move is None:
            return False
        if step.until is not None and number < len(plan.steps) - 1:
            row = COORDINATES.index(step.until[0])
            last = move.places[move.secure if move.leaves else -1]
            if abs(end[row] - step.until[1]) > REACHED or (last - end)[row] * (end - begin)[row] < 0:
                return False
    return True
