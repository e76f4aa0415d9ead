"""Choices of the next path: combinations of contacts that hold at a configuration, in both directions."""

import itertools
from collections.abc import Iterator, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wholearm_jax.core import CachedJit
from wholearm_jax.margin import MAX_ROLLING
from wholearm_jax.model import (
    AWAY_NAMES,
    COORDINATES,
    Scene,
    constraint_jacobian,
    contact_formation,
    contact_kinematics,
    feature_pair,
    rigid_body,
    scaled_mechanics,
)
from wholearm_jax.tracing import hold_same_tip

WEDGING_CONDITION = 1e-6  # share of the largest singular value below which four constraints do not fix a path
ROWS_STEP = 8  # contacts whose rows one program computes; their number is rounded up to a multiple


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
    scene: Scene, z: Float[Array, "5"], contacts: Sequence[str], *, rolling: bool, away: Sequence[str] = ()
) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield each formation of contacts whose constraints fix a path, with either direction along it.

    Left out are those of which two contacts hold a fingertip at a vertex.

    Args:
        scene: the hand and the object.
        z: the configuration (5,), SI.
        contacts: names of the contacts to combine, as if none rolled.
        rolling: whether contacts may roll.
        away: fingers that may stand still without a contact, such as `finger1:away`.

    Yields:
        The names of a formation's contacts and the direction as scene files write it, by the coordinate that changes
        most: `("palm:v5", ...), "x-"`.
    """
    combinations = tuple(names for names in formation_names([*contacts, *away], rolling) if _is_possible(names))
    directions = _path_directions(scene, z, contacts, combinations) if combinations else ()
    for names, direction in zip(combinations, directions, strict=True):
        if direction is not None:
            steepest = COORDINATES[int(np.argmax(np.abs(direction)))]
            yield names, f"{steepest}-"
            yield names, f"{steepest}+"


def _path_directions(scene: Scene, z, contacts: Sequence[str], combinations) -> list[np.ndarray | None]:
    """Return the direction of each combination's path in the object's units; None where constraints depend."""
    # The normal and the tangential row of each contact, as if all rolled: one program for up to `ROWS_STEP` contacts.
    padded = [*contacts, *[contacts[0]] * (-len(contacts) % ROWS_STEP)]
    every = contact_formation([f"{name} rolling" for name in padded])
    at_z = _constraint_rows(rigid_body(scene.object), scene.hand, scene.gravity, every, jnp.asarray(z))
    rows, twice = (np.asarray(a) for a in at_z)
    rows_of = {name: rows[2 * k : 2 * k + 2] for k, name in enumerate(contacts)}
    rows_of |= {name: np.eye(5)[3 + k : 4 + k] for k, name in enumerate(AWAY_NAMES)}
    number = {name: k for k, name in enumerate(contacts)}
    # A path's direction is the null vector of its four rows.
    stacked = np.stack([np.concatenate([_rows_held(rows_of, name) for name in names]) for names in combinations])
    _, values, right = np.linalg.svd(stacked)
    independent = values[:, -1] > WEDGING_CONDITION * values[:, 0]
    may_hold = [not _holds_twice(names, number, twice[::2, ::2]) for names in combinations]
    return [right[k, 4] if independent[k] and may_hold[k] else None for k in range(len(combinations))]


def _holds_twice(names: Sequence[str], number: dict[str, int], twice: np.ndarray) -> bool:
    """Whether two of the contacts hold one fingertip at a vertex; `twice` says so of each two of all."""
    chosen = [number[pair] for name in names if (pair := feature_pair(name)) in number]
    return bool(twice[np.ix_(chosen, chosen)].any())


def _rows_held(rows_of: dict[str, np.ndarray], name: str) -> np.ndarray:
    contact, _, rolls = name.partition(" ")
    return rows_of[contact] if rolls else rows_of[contact][:1]


@CachedJit
def _constraint_rows(body, hand, gravity, formation, z):
    mechanics = scaled_mechanics(body, hand, gravity, formation)
    small = z / mechanics.configuration_unit
    contacts, at = mechanics.contacts, contact_kinematics(mechanics.contacts, small)
    return constraint_jacobian(contacts, small), hold_same_tip(contacts, at, contacts, at)
