"""States and contacts over time, of an execution and of what it is compared with, and when contacts change.

When a contact is made or opened is read off the gaps, by one rule for both: it touches while its gap is below `TOUCH`
and it lies on its feature.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from wholearm_jax.model import (
    ContactFormation,
    Hand,
    RigidBody,
    Scene,
    contact_formation,
    contact_kinematics,
    contact_set,
    feature_pair,
    rigid_body,
)
from wholearm_jax.phases import Result, Trajectory

TOUCH = 1e-3  # gap below which a contact counts as touching [object radii]


class Event(NamedTuple):
    """A contact made or opened: when [s] in the prediction, and when in the execution; None where it was not."""

    contact: str
    made: bool
    predicted: float | None
    executed: float | None


class ExecutedMotion(NamedTuple):
    """States and contacts over time, SI units. `cn`, `ct` act on the object, 0 without contact; `touch` by `TOUCH`."""

    time: Float[np.ndarray, "samples"]
    z: Float[np.ndarray, "samples 5"]
    z_dot: Float[np.ndarray, "samples 5"]
    cn: Float[np.ndarray, "samples contacts"]
    ct: Float[np.ndarray, "samples contacts"]
    touch: Bool[np.ndarray, "samples contacts"]


def touching_contacts_at(scene: Scene, names: tuple[str, ...], z, slack: float | None = None) -> np.ndarray:
    """Which contacts are closed to within `slack` [m] (default: `TOUCH`) at configurations `z (samples, 5)`."""
    solid = rigid_body(scene.object)
    slack = TOUCH * float(np.hypot(*np.asarray(solid.vertices).T).max()) if slack is None else slack
    return np.asarray(_touching(solid, scene.hand, contact_formation(names), z, slack))


@jax.jit
def _touching(solid: RigidBody, hand: Hand, pairs: ContactFormation, z, slack):
    candidates = contact_set(solid, hand, pairs)
    at = jax.vmap(contact_kinematics, (None, 0))(candidates, z)
    on_feature = (at.along > candidates.lower - slack) & (at.along < candidates.upper + slack)
    return (jnp.abs(at.gap) < slack) & on_feature  # far behind an edge's line the gap is negative, and nothing touches


def expected_phases(
    prediction: Result, names: tuple[str, ...], courses: tuple[Trajectory, ...]
) -> list[ExecutedMotion]:
    """Return what the prediction, or a law's reference, has phase by phase, over all `names`."""
    phases = []
    for phase, at in zip(prediction.phases, courses, strict=False):
        cn, ct = np.zeros((2, len(at.time), len(names)))
        columns = [names.index(feature_pair(name)) for name in phase.contacts]
        cn[:, columns], ct[:, columns] = at.cn[:, : len(columns)], at.ct[:, : len(columns)]
        time, z, z_dot = (np.asarray(a) for a in (at.time, at.z, at.z_dot))
        phases.append(ExecutedMotion(time, z, z_dot, cn, ct, touching_contacts_at(prediction.scene, names, z)))
    return phases


def as_begun(phases: list[ExecutedMotion], begins: Sequence[float], end: float) -> list[ExecutedMotion]:
    """Move phases to when a law began them: each waits for the next one, or is cut short by it; the last until `end`.

    While it waits its forces are not known: the law presses.
    """
    moved = []
    for phase, begin, until in zip(phases, begins, [*begins[1:], end], strict=False):
        time = phase.time - phase.time[0] + begin
        kept = ExecutedMotion(*(field[time <= until] for field in (time, *phase[1:])))
        last = [field[-1:] for field in kept]
        unknown = np.full_like(last[3], np.nan)
        moved += [kept, ExecutedMotion(np.array([until]), last[1], 0 * last[2], unknown, unknown, last[5])]
    return moved


def contact_events(names: tuple[str, ...], expected: ExecutedMotion, course: ExecutedMotion) -> tuple[Event, ...]:
    """Changes of contact in the prediction, each beside the nearest like one in the execution; then what is left."""
    found, events = _changes(course), []
    for (contact, made), whens in _changes(expected).items():
        for when in whens:
            others = found.get((contact, made), [])
            nearest = min(others, key=lambda t, when=when: abs(t - when), default=None)
            if nearest is not None:
                others.remove(nearest)
            events.append(Event(names[contact], made, when, nearest))
    events += [Event(names[c], made, None, when) for (c, made), whens in found.items() for when in whens]
    return tuple(sorted(events, key=lambda e: e.executed if e.predicted is None else e.predicted))


def _changes(course: ExecutedMotion) -> dict[tuple[int, bool], list[float]]:
    """(contact, made) -> the times at which a contact is made (True) or opened (False)."""
    found: dict[tuple[int, bool], list[float]] = {}
    for row, contact in np.argwhere(course.touch[1:] != course.touch[:-1]):
        found.setdefault((int(contact), bool(course.touch[row + 1, contact])), []).append(float(course.time[row + 1]))
    return found
