"""What must hold of a traced, simulated and judged scene: residuals and violations, by `tests.reference.mechanics` in
NumPy.

Every function takes batches with a leading axis of scenes. Residuals are relative: an equation's error against its
largest term. Violations are counted by name; a scene may have several.
"""

import itertools
from typing import NamedTuple

import numpy as np

from tests.reference.mechanics import Model, dot, quarter

OK, LOST, STUCK, REVERSED, NOT_REACHED, LEFT, AMBIGUOUS, SINGULAR, NO_CONVERGENCE, MAX_STEPS, OBSTACLE = range(11)
MADE, BEYOND, UNTIL, MET = 1, 2, 3, 4  # why a path ends


class Limits(NamedTuple):
    """Residuals from which on a result counts as wrong."""

    closure: float
    tables: float
    motion: float
    energy: float
    sign: float
    place: float
    overlap: float
    gradient: float


# Terms smaller than this beside others are rounding: the drag of a joint that stands still has a speed of 1e-17.
FLOOR = 1e-9
IDLE = 1e-6  # the same for a whole column, beside what it would be if all moved, or turned, at the rate of `s`
DOUBLE = Limits(closure=1e-9, tables=1e-7, motion=1e-7, energy=1e-6, sign=1e-6, place=1e-7, overlap=1e-9, gradient=1e-5)
SINGLE = Limits(closure=1e-4, tables=1e-2, motion=1e-2, energy=1e-2, sign=1e-2, place=1e-3, overlap=1e-4, gradient=1.0)

VIOLATIONS = (
    "number missing",
    "closure",
    "tangent",
    "equations of the table",
    "sign within a piece",
    "seam between pieces",
    "contact beyond its feature",
    "link in the object",
    "links overlap",
    "ok although links overlap",
    "end without a cause",
    "start not the nearest",
    "start heads the wrong way",
    "equations of motion",
    "constraint",
    "energy",
    "margin above a force",
    "ok with a tensile force",
    "tension not seen in time",
    "rest contradicts accelerations",
    "departure contradicts accelerations",
    "end of the motion",
    "refused although touching",
    "refused although in place",
    "refused although links are apart",
    "singular without a reason",
    "gradient not finite",
    "modes of gradients differ",
    "margin that comes with a gradient",
)


class Units(NamedTuple):
    """What one object unit is in SI, a row a scene: configuration, torque, force; and the columns of a table."""

    z: np.ndarray
    torque: np.ndarray
    force: np.ndarray

    @classmethod
    def of(cls, model):
        one = np.ones_like(model.size)
        z = np.stack([model.size, model.size, one, one, one], axis=1)
        return cls(z, model.mass * model.size**2, model.mass * model.size)

    def remove(self, at):
        """Readings in object units."""

        def shaped(unit, value, trailing=0):
            return unit.reshape(len(unit), *([1] * (value.ndim - 1 - trailing)), *unit.shape[1:])

        found = {key: np.asarray(value, float) for key, value in at.items()}
        for key in ("z", "x", "bend"):
            if key in found:
                found[key] = found[key] / shaped(self.z, found[key], 1)
        if "torque" in found:
            found["torque"] = found["torque"] / shaped(self.torque, found["torque"])
        one = np.ones_like(self.torque)
        columns = np.stack([one, one, one, self.torque, self.torque], axis=1)
        if "acceleration" in found:
            found["acceleration"] = found["acceleration"] * shaped(columns, found["acceleration"], 1)
            found["force"] = found["force"] * shaped(columns, found["force"], 1)
        for key in ("force", "parts"):
            if key in found:
                found[key] = found[key] / shaped(self.force, found[key])
        return found


def largest(*terms):
    """The largest magnitude over the last axis of several arrays."""
    return np.max(np.stack([np.abs(t).max(-1) for t in terms]), axis=0)


def relative(error, *terms):
    """An error against the largest of its terms."""
    return np.abs(error).max(-1) / np.maximum(largest(*terms), 1e-300)


# --- along the path --------------------------------------------------------------------------------------------------


def path_residuals(model: Model, at) -> dict[str, np.ndarray]:
    """Closure, tangents, accelerations and forces of a table, column by column, at places of the path.

    `at` holds `z`, `x = dz/ds` (object units), the `chart`, the table's `acceleration` (scenes, places, 5) and `force`
    (scenes, places, 4, 5), and the signs `slip` and `joint`. Each column of the equations of motion is judged against
    its largest term along the path.
    """
    here = model.geometry(at["z"])
    span = np.abs(at["z"]).max(-1) + 1.0
    x, bend = model.curve(at["z"], at["chart"])
    found = {
        "closure": np.abs(here.gap).max(-1) / span,
        "tangent": np.abs(at["x"] - x).max(-1) / np.abs(x).max((1, 2), keepdims=True)[..., 0],
    }
    wrench = model.wrench(here, at["slip"])
    weight = np.zeros((*at["z"].shape[:2], 5))
    torque, drag = np.broadcast_to(np.eye(5)[3:], (*weight.shape[:2], 2, 5)), weight.copy()
    weight[..., :2] = model.gravity[:, None]
    weight[..., 3:] -= model.dry[:, None] * at["joint"]
    drag[..., 3:] = -model.viscous[:, None] * x[..., 3:]
    inertia, worst, one = model.inertia[:, None], [], np.ones(len(span))
    busy = [0 * one, model.inertia.max(1), model.viscous.max(1), one, one]
    for k, push in enumerate([weight, -inertia * bend, drag, torque[..., 0, :], torque[..., 1, :]]):
        inertial = inertia * x * at["acceleration"][..., k, None]
        contact = np.einsum("npic,npc->npi", wrench, at["force"][..., k])
        size = largest(inertial, contact, push).max(1, keepdims=True)
        size = np.maximum(size, IDLE * busy[k][:, None])
        worst.append(np.abs(inertial - contact - push).max(-1) / np.maximum(size, FLOOR * (1 + size.max(1))[:, None]))
    found["columns"] = np.max(worst, axis=0)
    return found


def path_signs(model: Model, at) -> np.ndarray:
    """How far slips and joint speeds contradict the signs of their piece (0: nowhere)."""
    here = model.geometry(at["z"])
    size = np.sqrt(dot(at["x"], at["x"]))[..., None]
    slip = np.where(model.slides[:, None], np.einsum("npci,npi->npc", here.slip_rows, at["x"]) / size, 0.0)
    speeds = np.concatenate([slip, at["x"][..., 3:] / size], axis=-1)
    signs = np.concatenate([at["slip"], at["joint"]], axis=-1)
    return np.where(signs == 0, np.abs(speeds), np.maximum(-speeds * signs, 0.0)).max(-1)


def outside(model: Model, z) -> np.ndarray:
    """How far contacts lie beyond their features (0: nowhere)."""
    low, high = model.limits()
    along = model.geometry(z).along
    return np.maximum(np.maximum(low[:, None] - along, along - high[:, None]).max(-1), 0.0)


def holds_one_tip(model: Model, z, tolerance) -> np.ndarray:
    """Whether two contacts hold a fingertip at one vertex, not a notch, where it slips off along either side (scenes).

    A vertex on that finger and an edge of which it is an end, or both edges beside it.
    """
    along, (_, extent) = model.geometry(z[:, None]).along[:, 0], model.limits()
    row, following = np.arange(len(z))[:, None], model.following()
    after = following[row, model.feature]
    at_end = np.where(along > extent - tolerance, after, -1)
    corner = np.where(model.kind == 0, model.feature, np.where(along < tolerance, model.feature, at_end))
    edge = model.vertices[row, following] - model.vertices
    turn = dot(quarter(edge), edge[row, following])  # at the end of each edge
    notch = np.zeros(edge.shape[:2], bool)
    np.put_along_axis(notch, following, turn < 0, axis=1)
    found = np.zeros(len(z), bool)
    for i, j in itertools.combinations(range(model.kind.shape[1]), 2):
        same = (model.link[:, i] == model.link[:, j]) & (corner[:, i] == corner[:, j]) & (corner[:, i] >= 0)
        tip = (model.kind[:, i] == 1) | (model.kind[:, j] == 1)
        both = (model.kind[:, i] == 1) & (model.kind[:, j] == 1)
        held = ~model.tangential[:, i] & ~model.tangential[:, j]
        found |= same & tip & held & ~(both & notch[row[:, 0], corner[:, i]])
    return found


def rests_on_a_link(model: Model, z, tolerance) -> np.ndarray:
    """Whether a vertex of the object that no contact holds touches the line of a link (scenes)."""
    away, directions = model._poses(z[:, None])
    joint, _, offset, side = model._links()
    points = z[:, None, None, :2] + away
    found = np.zeros(len(z), bool)
    number = np.arange(points.shape[2])
    for link in range(3):
        normal = side[link] * quarter(directions[..., link, :])
        gap = dot(normal[:, :, None], points - joint[:, None, None, link]) - offset[:, link, None, None]
        held = (model.link == link)[:, :, None] & (model.kind == 0)[:, :, None] & (model.feature[:, :, None] == number)
        free = ~held.any(1) & (number < model.count[:, None])
        found |= (free & (np.abs(gap[:, 0]) < tolerance)).any(1)
    return found


def end_is_real(model: Model, z, why, contact, until, tolerance) -> np.ndarray:
    """Whether something does end the path: a contact made, a contact at its feature's limit, a value met."""
    z = z[:, None]
    low, high = model.limits()
    along = model.geometry(z).along[:, 0]
    row = np.arange(len(z))
    which = np.minimum(contact, 3)
    at_limit = np.minimum(np.abs(along - low), np.abs(along - high))[row, which] < tolerance
    capacity = model.vertices.shape[1]
    group, feature = contact // capacity, contact % capacity
    corner = group >= 5
    group = np.where(corner, 0, group)
    other = model.take(np.arange(len(z)))
    other.link = np.repeat(np.array([0, 1, 2, 1, 2])[group][:, None], 4, axis=1)
    other.kind = np.repeat(np.array([0, 0, 0, 1, 1])[group][:, None], 4, axis=1)
    other.feature = np.repeat(feature[:, None], 4, axis=1)
    other.tangential = np.zeros_like(other.tangential)
    made = np.abs(other.geometry(z).gap[:, 0, 0]) < tolerance
    met_corner = model.corner_from_edge(z, np.maximum(contact // capacity - 5, 0), feature) < tolerance
    made = np.where(corner, met_corner, made)
    coordinate, value = until
    met = np.abs(z[row, 0, coordinate] - value) < tolerance
    return np.select([why == MADE, why == BEYOND, why == UNTIL], [made, at_limit, met], False)


# --- the motion ------------------------------------------------------------------------------------------------------


def motion_residuals(model: Model, at) -> dict[str, np.ndarray]:
    """The five equations of motion at times, with the accelerations `x a + x' v^2` and forces of the result.

    `at` holds `z`, `x`, `bend`, `a`, `v`, `torque`, `force` and its `parts` in object units, and the signs. Where
    weight and torques all but cancel each other, an equation is judged against them, not against what is left.
    """
    z_dot = at["x"] * at["v"][..., None]
    z_ddot = at["x"] * at["a"][..., None] + at["bend"] * (at["v"] ** 2)[..., None]
    here = model.geometry(at["z"], z_dot)
    wrench = model.wrench(here, at["slip"])
    contact = np.einsum("npic,npc->npi", wrench, at["force"])
    parts = np.einsum("npic,npc->npi", np.abs(wrench), at["parts"])
    inertial = model.inertia[:, None] * z_ddot
    applied = model.applied(z_dot, at["torque"], at["joint"])
    held = np.einsum("npci,npi->npc", here.normal_rows, z_ddot) + here.left
    return {
        "motion": relative(inertial - contact - applied, inertial, parts, applied, np.full_like(applied, 1e-30)),
        "constraint": np.abs(held).max(-1) / (np.abs(z_ddot).max(-1) + dot(z_dot, z_dot) + 1e-30),
    }


def energy_residual(model: Model, ends, at, weights) -> np.ndarray:
    """Change of energy from the first to the last of `ends` minus the work along `at`, against the largest part."""
    z_dot = at["x"] * at["v"][..., None]
    here = model.geometry(at["z"], z_dot)
    slip = np.einsum("npci,npi->npc", here.slip_rows, z_dot)
    friction = -model.friction[:, None] * at["slip"] * at["force"]
    joint = z_dot[..., 3:]
    powers = [
        at["torque"] * joint,
        friction * slip,
        -model.viscous[:, None] * joint**2,
        -model.dry[:, None] * at["joint"] * joint,
    ]
    weights = np.where(weights > 0, weights, 0.0)
    parts = [np.where(weights[..., None] > 0, p, 0.0).sum(-1) * weights for p in powers]
    work = sum(p.sum(1) for p in parts)
    spent = np.max([np.abs(p).sum(1) for p in parts], axis=0)
    kinetic = (model.inertia[:, None] * (ends["x"] * ends["v"][..., None]) ** 2).sum(-1) / 2
    potential = -(model.gravity[:, None] * ends["z"][..., :2]).sum(-1)
    change = np.diff(kinetic + potential, axis=1)[:, 0]
    # A tolerance on `s` and its rate allows an error of energy on the scale of the path's forces, however short it is.
    speed = np.maximum(np.abs(at["v"]), 1e-300)
    pull = np.max([np.where(weights > 0, np.abs(p.sum(-1)) / speed, 0.0).max(1) for p in powers], axis=0)
    size = np.max([spent, np.abs(kinetic).max(1), np.abs(np.diff(potential, axis=1)[:, 0]), 0.01 * pull], axis=0)
    return np.abs(change - work) / np.maximum(size, 1e-300)


class Rest:
    """What objects at rest would do: accelerations forward and backward, linear in the torque."""

    def __init__(self, model: Model, z, toward):
        torque = np.broadcast_to(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), (len(z), 3, 2))
        some = (len(z), 3, 5)
        answers, health = model.resting(
            np.broadcast_to(z[:, None], some), np.broadcast_to(toward[:, None], some), torque
        )
        self.maps = [np.stack([a[:, 0], a[:, 1] - a[:, 0], a[:, 2] - a[:, 0]], axis=1) for a in answers]
        slip = np.einsum("npci,npi->npc", model.geometry(z[:, None]).slip_rows, toward[:, None])[:, 0]
        size = np.sqrt(dot(toward, toward))[:, None]
        # Exactly where a slip reverses it has no sign of its own.
        sure = np.all((np.abs(slip) > 1e-6 * size) | (model.friction == 0) | ~model.slides, axis=1)
        self.healthy = sure & (np.minimum(health[0][:, 0], health[1][:, 0]) > 1e-9)

    def at(self, torque):
        """Forward and backward accelerations at torques (scenes, times, 2), each against the size of its terms."""
        found = []
        for m in self.maps:
            terms = np.stack(
                [np.broadcast_to(m[:, :1], torque.shape[:2]), m[:, 1:2] * torque[..., 0], m[:, 2:] * torque[..., 1]]
            )
            found.append(terms.sum(0) / np.maximum(np.abs(terms).max(0), 1e-300))
        return found


def resting_verdicts(rest: Rest, status, torque, live, tolerance) -> np.ndarray:
    """Whether a verdict on an object at rest contradicts the accelerations, under the torques from then on.

    `torque` (scenes, times, 2) holds the torque when it came to rest, at every knot after, and at the end; `live` says
    which count. The first is the moment of a `reversed` or `ambiguous` verdict.
    """
    forward, backward = rest.at(torque)
    ahead = np.where(live, forward, -np.inf).max(1)
    behind = np.where(live, -backward, -np.inf).max(1)
    first_ahead, first_behind = forward[:, 0], -backward[:, 0]
    wrong = np.select(
        [status == STUCK, status == REVERSED, status == AMBIGUOUS],
        [
            (ahead > tolerance) | (behind > tolerance),
            (first_behind < -tolerance) | (first_ahead > tolerance),
            (first_behind < -tolerance) | (first_ahead < -tolerance),
        ],
        False,
    )
    return wrong & rest.healthy


def departures(rest: Rest, torque, live, departing, tolerance) -> np.ndarray:
    """Whether an object that departed could have done so before, or could not when it did.

    `torque` (scenes, times, 2) covers the time before the departure, `departing` is the torque just after it.
    """
    forward, backward = rest.at(torque)
    waited = live[:, 1:].any(1) & (live.sum(1) > 2)
    earlier = np.where(live, np.maximum(forward, -backward), -np.inf)
    now = rest.at(departing[:, None])[0][:, 0]
    return ((now < -tolerance) | (waited & (earlier[:, :-1].max(1) > tolerance))) & rest.healthy


# --- scenes that are refused -----------------------------------------------------------------------------------------


def _orientation(model, z, x):
    """`det [G_n; x]`."""
    return np.linalg.det(np.concatenate([model.geometry(z[:, None]).normal_rows[:, 0], x[:, None]], axis=1))


def loses_rank(model: Model, z, x, *, step=0.02, steps=400) -> np.ndarray:
    """Whether `G_n` loses rank on a path followed from `z` along `x`: `det [G_n; x]` changes sign or vanishes."""
    found = np.zeros(len(z), bool)
    active = np.arange(len(z))
    z, x = z.copy(), x.copy()
    sign = np.sign(_orientation(model, z, x))
    for _ in range(steps):
        some = model.take(active)
        ahead = (z[active] + step * x[active])[:, None]
        rows, u = None, x[active]
        for _ in range(3):
            at = some.geometry(ahead)
            rows = np.concatenate([at.normal_rows[:, 0], u[:, None]], axis=1)
            left = np.concatenate([at.gap[:, 0], dot(u, ahead[:, 0] - z[active])[:, None] - step], axis=1)
            safe = np.abs(np.linalg.det(rows)) > 1e-12
            rows = np.where(safe[:, None, None], rows, np.eye(5))
            ahead -= np.clip(np.linalg.solve(rows, left[..., None])[:, None, :, 0], -0.1, 0.1)
        z[active] = ahead[:, 0]
        direction, least, most = some.tangent(ahead, u[:, None])
        x[active] = direction[:, 0]
        det = _orientation(some, ahead[:, 0], direction[:, 0])
        lost = (least[:, 0] < 1e-3 * most[:, 0]) | (np.sign(det) * sign[active] < 0) | ~safe
        lost |= dot(direction[:, 0], u) < 0.9
        found[active[lost]] = True
        active = active[~lost]
        if not len(active):
            break
    return found


def wedged(model: Model, z, toward, slip) -> np.ndarray:
    """Whether friction turns the 5x5 determinant's sign at some of the places, or makes it vanish."""
    x, _, _ = model.tangent(z, toward)
    at = model.geometry(z)
    column = (model.inertia[:, None] * x)[..., None]
    with_friction, without = (
        np.concatenate([column, -model.wrench(at, s)], axis=-1) for s in (slip, np.zeros_like(slip))
    )
    ratio = np.linalg.det(with_friction) / np.linalg.det(without)
    values = np.linalg.svd(with_friction, compute_uv=False)
    return np.any((ratio < 1e-9) | (values[..., -1] < 1e-12 * values[..., 0]), axis=1)
