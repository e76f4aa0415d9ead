"""Choices of the next path: combinations of contacts that hold at a configuration, in both directions."""

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.margin import MAX_ROLLING
from wholearm_jax.model import AWAY_NAMES, COORDINATES, Scene, feature_pair
from wholearm_jax.planning.contact_rows import ContactRows, contact_rows
from wholearm_jax.planning.rest_margins import Tangents, both_senses, path_tangents, rest_margins

LEAST_HOLD = 0.02  # distance of a contact from its feature's end, in object radii, below which a hand may miss it
CLOSING_RATE = 1e-3  # of a gap, for a unit step along a path, above which a contact that touches already ends the path
PathChoice = tuple[tuple[str, ...], str]  # names of a formation's contacts, and the direction as scene files write it


def formation_names(contacts: Sequence[str], rolling: bool) -> Iterator[tuple[str, ...]]:
    """Yield the combinations of contacts with four constraints: one for a sliding contact, two for a rolling one."""
    yield from itertools.combinations(contacts, 4)
    for count in range(1, MAX_ROLLING + 1) if rolling else ():
        for rolls in itertools.combinations(contacts, count):
            others = [name for name in contacts if name not in rolls]
            for slides in itertools.combinations(others, 4 - 2 * count):
                yield *(f"{name} rolling" for name in rolls), *slides


def _is_possible(names: Sequence[str]) -> bool:
    """Whether at most one finger is away, and that one has no contact and does not roll."""
    away = [name for name in names if feature_pair(name) in AWAY_NAMES]
    if not away:
        return True
    finger = away[0].partition(":")[0]
    return away[0] in AWAY_NAMES and away == [name for name in names if name.startswith(finger)]


def path_choices(
    scene: Scene,
    z: Float[Array, "5"],
    contacts: Sequence[str],
    *,
    rolling: bool,
    away: Sequence[str] = (),
    floor: float = -np.inf,
) -> Iterator[PathChoice]:
    """Yield each formation of contacts whose constraints fix a path, with either direction along it.

    Left out are those of which two contacts hold a fingertip at a vertex, or one rolls without friction.

    Args:
        scene: the hand and the object.
        z: the configuration (5,), SI.
        contacts: names of the contacts to combine, as if none rolled.
        rolling: whether contacts may roll.
        away: fingers that may stand still without a contact, such as `finger1:away`.
        floor: margin at rest [N] that a move has to exceed where it begins, with every other contact free to part
            there; unless given, none has to.

    Yields:
        The names of a formation's contacts and the direction as scene files write it, by the coordinate that changes
        most: `("palm:v5", ...), "x-"`.
    """
    combinations = tuple(names for names in formation_names([*contacts, *away], rolling) if _is_possible(names))
    if not combinations:
        return
    rows = contact_rows(scene, z, contacts, away)
    for rolls, group in itertools.groupby(combinations, key=_rolling_count):
        chosen = tuple(group)
        tangents = both_senses(path_tangents(rows, contact_numbers(rows, chosen), rolls))
        begins = _may_begin(rows, tangents, floor)
        for k, names in enumerate(chosen):
            direction = tangents.direction[k]
            steepest = int(np.argmax(np.abs(direction)))
            ahead, back = (k, k + len(chosen)) if direction[steepest] > 0 else (k + len(chosen), k)
            for sign, number in (("-", back), ("+", ahead)):
                if begins[number]:
                    yield names, f"{COORDINATES[steepest]}{sign}"


def _may_begin(rows: ContactRows, tangents: Tangents, floor: float) -> Bool[np.ndarray, "formations"]:
    """Which paths begin: with a margin at rest above a floor [N], if there is one, and not stopped at once."""
    number, rolling = tangents.number, tangents.number[:, : tangents.rolling]
    begins = tangents.is_path & ~rows.same_tip[number[:, :, None], number[:, None, :]].any((1, 2))
    begins &= (rows.friction[rolling] > 0).all(1)
    if floor == -np.inf:
        return begins
    return begins & (rest_margins(rows, tangents) > floor) & ~_are_stopped(rows, tangents)


def _are_stopped(rows: ContactRows, tangents: Tangents) -> Bool[np.ndarray, "formations"]:
    """Which paths end where they begin: one of the other contacts is pressed on, away from its feature's ends."""
    others = np.tile(rows.clearance > LEAST_HOLD, (len(tangents.number), 1))
    np.put_along_axis(others, tangents.number, False, axis=1)
    approach = -tangents.direction @ rows.normal.T
    return np.any(others & (approach > CLOSING_RATE), axis=1)


def _rolling_count(names: Sequence[str]) -> int:
    return sum(name != feature_pair(name) for name in names)


def contact_numbers(rows: ContactRows, combinations: Sequence[Sequence[str]]) -> Int[np.ndarray, "formations contacts"]:
    """Number the contacts of formations among the rows."""
    number = {name: k for k, name in enumerate(rows.names)}
    return np.array([[number[feature_pair(name)] for name in names] for names in combinations])
