"""Which hand? Proportions with which the plan to a goal has the largest certificate.

Hands of a grid over finger length and joint distance are tried, then those about the best one at half the spacing, and
last the proportions to which the best plan's own certificate leads, its phases held fixed. On each the object begins as
in the scene, lying on the same edge, with the fingers closed anew. The search on each hand is limited by
configurations, few at first and more where no hand has a plan with so few: near goals are quick, far ones found.
"""

import itertools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import numpy as np

from wholearm_jax.core import as_device_array
from wholearm_jax.model import Hand, Scene, edge_on_palm, link_overlaps, resting_configuration
from wholearm_jax.planning.plans import make_plan
from wholearm_jax.planning.search import PlanningResult, plan

EFFORTS = (12, 48, 192)  # configurations that the search on each hand expands, until some hand has a plan
PROPORTION_DECIMALS = 4  # of the lengths that are tried [m]
MAX_VARIATIONS = 60  # hands on which a plan's phases are traced anew, at most


@dataclass(frozen=True)
class HandTrial:
    """A hand that was tried: finger length and distance of each joint from the middle [m], and its plan's certificate.

    `bound` [N] is `-inf` where no plan was found, and NaN where the hand does not close on the object.
    """

    length: float
    joint: float
    bound: float


@dataclass(frozen=True)
class HandSearchResult:
    """The best hand of those that were tried, the scene with it, and the plans on it.

    Where no hand has a plan, the scene is the one that was given.
    """

    best: HandTrial | None  # None: no hand has a plan
    scene: Scene
    planning: PlanningResult | None
    trials: tuple[HandTrial, ...]
    nearest: Scene | None = None  # where no hand has a plan: the scene with the hand that came nearest to the goal


def plan_with_hand(
    scene: Scene,
    goal: Mapping[str, float] | None = None,
    *,
    length: tuple[float, float],
    joint: tuple[float, float],
    grid: int = 4,
    refinements: int = 1,
    max_nodes: int | None = None,
    callback: Callable[[int, float], None] | None = None,
    **options: Any,
) -> HandSearchResult:
    """Search over a hand's proportions for those with which the plan to a goal has the largest certificate.

    Args:
        scene: the object at rest on an edge, and a hand, whose other properties stay; a finger's inertia grows with
            the square of its length.
        goal: as of `plan`.
        length: least and largest finger length [m].
        joint: least and largest distance of each joint from the middle [m].
        grid: number of values of each in the first round.
        refinements: rounds about the best hand, each at half the spacing of the one before; 0: no last step, either.
        max_nodes: configurations that the search on each hand expands; unless given 12, or where no hand has a plan
            with those, 48 or at last 192.
        callback: called with the number of hands tried and the largest certificate so far.
        options: other arguments of `plan`: `by`, `tolerance`, `margin`, `count`, `max_phases`, `rolling`.

    Raises:
        ValueError: for ranges that are none, a start that does not lie on an edge, or a goal as `plan` refuses it.
    """
    for name, (low, high) in {"length": length, "joint": joint}.items():
        if not 0 < low <= high < np.inf:
            raise ValueError(f"{name}: the range must be of positive lengths, the smaller one first")
    edge = edge_on_palm(scene.object, np.asarray(scene.start))
    tried: dict[tuple[float, float], tuple[HandTrial, Scene, PlanningResult | None]] = {}

    spent: dict[tuple[float, float], float] = {}  # the effort on a hand; no end of it where more cannot help

    def attempt(lengths: Iterable[float], joints: Iterable[float], effort: int) -> None:
        for proportions in itertools.product(lengths, joints):
            if spent.get(proportions, 0) >= effort:
                continue
            changed = _start_in(scene, edge, *proportions)
            found = None if changed is None else plan(changed, goal, max_nodes=effort, **options)
            bound = np.nan if found is None else found.plans[0].bound if found.found else -np.inf
            spent[proportions] = effort if bound == -np.inf else np.inf
            tried[proportions] = HandTrial(*proportions, float(bound)), changed or scene, found
            if callback is not None:
                callback(len(tried), max((one.bound for one, _, _ in tried.values() if one.bound > 0), default=0.0))

    ranges = [length, joint]
    effort = 0
    for effort in EFFORTS if max_nodes is None else (max_nodes,):
        attempt(_values(*length, grid), _values(*joint, grid), effort)
        if _best(tried) is not None:
            break
    spacing = [(high - low) / max(grid - 1, 1) for low, high in ranges]
    for _ in range(refinements):
        best = _best(tried)
        if best is None:
            break
        spacing = [step / 2 for step in spacing]
        lengths, joints = (
            _values(max(centre - step, low), min(centre + step, high), 3)
            for centre, step, (low, high) in zip(best, spacing, ranges, strict=True)
        )
        attempt(lengths, joints, effort)
    best = _best(tried)
    planning = None if best is None else tried[best][2]
    if planning is not None and refinements:
        better_length, better_joint = _improve_hand(scene, edge, planning, best, ranges, spacing)
        attempt([better_length], [better_joint], effort)
        best = _best(tried)
    trials = tuple(trial for trial, _, _ in tried.values())
    if best is None:
        return HandSearchResult(None, scene, None, trials, _nearest(tried))
    return HandSearchResult(*tried[best], trials)


def _best(tried: Mapping[tuple[float, float], tuple[HandTrial, Scene, Any]]) -> tuple[float, float] | None:
    """Return the proportions with the largest certificate, the first of equals."""
    found = [(trial.bound, key) for key, (trial, _, _) in tried.items() if trial.bound > -np.inf]
    return max(found, key=lambda row: round(row[0], 6))[1] if found else None


def _nearest(tried: Mapping[Any, tuple[HandTrial, Scene, PlanningResult | None]]) -> Scene | None:
    """Return the scene whose search came nearest to its goal, the first of equals; None where no search began."""
    begun = [(found.distance, changed) for _, changed, found in tried.values() if found and found.distance < np.inf]
    return min(begun, key=lambda row: row[0])[1] if begun else None


def _improve_hand(scene: Scene, edge: int, planning: PlanningResult, proportions, ranges, spacing) -> list[float]:
    """Return the proportions with the largest certificate of a plan whose phases are held fixed.

    The certificate is the least over phases and, in each, over contacts and places, with kinks just where it is
    largest: its slopes do not lead there, so that the simplex method of Nelder and Mead (1965) is used.
    """
    best = planning.plans[0]
    duration = float(best.scene.phases[0].duration)

    def loss(proportions) -> float:
        changed = _start_in(scene, edge, *map(float, proportions))
        if changed is None:
            return np.inf
        moved = make_plan(changed, np.asarray(changed.start), best.steps, duration, planning.goal)
        return np.inf if moved is None else -moved.bound

    from scipy.optimize import minimize  # imported here: it takes long to import

    begin, steps = np.array(proportions), np.array(spacing) / 2
    inward = np.where(begin + steps > np.array(ranges)[:, 1], -steps, steps)
    options = {
        "initial_simplex": begin + np.vstack([np.zeros(2), np.diag(inward)]),
        "xatol": 10.0**-PROPORTION_DECIMALS,
        "fatol": 1e-3 * best.bound,
        "maxfev": MAX_VARIATIONS,
    }
    end = minimize(loss, begin, method="Nelder-Mead", bounds=ranges, options=options).x
    return [round(float(value), PROPORTION_DECIMALS) for value in end]


def _values(low: float, high: float, count: int) -> list[float]:
    """Return evenly spaced lengths."""
    return sorted({round(float(value), PROPORTION_DECIMALS) for value in np.linspace(low, high, count)})


def _start_in(scene: Scene, edge: int, length: float, joint: float) -> Scene | None:
    """Put the object into a hand of other proportions; None where that does not close on it, or its links overlap."""
    hand: Hand = scene.hand
    heights = np.asarray(hand.joint)[:, 1]
    changed = eqx.tree_at(
        lambda h: (h.joint, h.length, h.inertia),
        hand,
        (
            as_device_array(np.stack([[joint, -joint], heights], axis=1)),
            as_device_array([length, length]),
            as_device_array(np.asarray(hand.inertia) * (length / np.asarray(hand.length)) ** 2),
        ),
    )
    try:
        z = resting_configuration(scene.object, changed, edge, float(scene.start[0]))
    except ValueError:
        return None
    if float(link_overlaps(changed, as_device_array(z[3:])).max()) >= 0:
        return None
    return eqx.tree_at(lambda s: (s.hand, s.start, s.phases), scene, (changed, as_device_array(z), ()))
