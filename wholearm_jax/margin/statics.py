r"""Hold: the statics of an object that friction keeps at rest, and the margin with which it is kept.

At rest at `z` the forces of the contacts, `c_n` and `c_t` of each, and the dry friction `d` of the joints balance

    g + E tau + d + G_n^T c_n + G_t^T c_t = 0,     |c_t| <= mu c_n,     |d_i| <= D_i.

These are five equations for ten unknowns: the forces are not determined. The *margin* of a hold is therefore, by
definition, the largest `m` for which some forces within these limits have `c_n >= m` at every contact: the value of a
linear programme. Where there are none at all, it is minus the least adhesion `a` with which there would be,
`|c_t| <= mu (c_n + a)`.

Both are concave functions of the torque. While torque is linear in time, the least margin is thus at one end of the
interval, and the moment at which a hold becomes impossible is the solution of one more linear programme.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from wholearm_jax.model import (
    ContactFormation,
    Scene,
    TorqueSchedule,
    normal_jacobian,
    rigid_body,
    scaled_mechanics,
    tangential_jacobian,
    time_tolerance,
)

FEASIBILITY_TOL = -1e-8  # least margin that counts as possible, over the unit of force: rounding
SOLVER_TOL = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
MARGIN_CAP = 1e6  # the largest margin, over the unit of force: friction may let forces grow without end
NO_ROWS = np.zeros((0, 3))
MARGIN_TIE = (
    0.99  # share of the best margin for which a hold's torque moves away from where the object would start to move
)


class RestInterval(NamedTuple):
    """An object at rest for a while: `start` and `end` [s], its least margin [N], when, and at which contact.

    `loss_time` is the time from which no forces can hold it there, None where some always can.
    """

    start: float
    end: float
    margin: float
    time: float
    contact: str
    loss_time: float | None

    @property
    def message(self) -> str:
        """What friction holds, in one line."""
        span = f"held at rest from {self.start:.4g} to {self.end:.4g} s"
        if self.loss_time is not None:
            return f"{span}: not possible from t = {self.loss_time:.6g} s, {self.contact} would have to pull"
        return f"{span}, hold's margin {self.margin:.4g} N at {self.contact}"


class StaticMargin(NamedTuple):
    """The best that contacts can do at rest: `margin` [N], the `contact` that limits it, a `torque` [N m] for it."""

    margin: float
    contact: str
    torque: Float[np.ndarray, "2"]


class RestAccelerations(NamedTuple):
    """Accelerations `d2s/dt2` at rest, linear in `(1, tau1, tau2)`, with the friction of travel forward and backward.

    An object stays while the first is not positive and the second not negative.
    """

    ahead: Float[np.ndarray, "3"]
    behind: Float[np.ndarray, "3"]


@dataclass(frozen=True)
class Statics:
    """The balance of forces at one configuration: `wrench @ (c_n, c_t, d) + load @ (1, tau1, tau2) = 0`.

    Its rows are forces in units of `unit` [N], torques divided by the object's radius; the torques `tau` are in N m.
    """

    names: tuple[str, ...]
    wrench: Float[np.ndarray, "5 unknowns"]
    load: Float[np.ndarray, "5 3"]
    friction: Float[np.ndarray, "contacts"]
    dry: Float[np.ndarray, "2"]
    torque_limit: Float[np.ndarray, "2"]
    unit: float

    def support(self, torque) -> StaticMargin:
        """The hold's margin under a given torque [N m]."""
        return self._best(np.column_stack([torque, torque]))

    def best(self, departure: RestAccelerations | None = None) -> StaticMargin:
        """The largest margin of all torques within limits; with a `departure`, of those that do not move the object."""
        limits = np.column_stack([-self.torque_limit, self.torque_limit])
        return self._best(limits, _still(departure))

    def steadiest(self, departure: RestAccelerations) -> StaticMargin:
        """A torque with `MARGIN_TIE` of the largest margin, as far as it can be from those that move the object."""
        limits, still = np.column_stack([-self.torque_limit, self.torque_limit]), _still(departure)
        top = self._best(limits, still)
        if not top.margin > 0:
            return top
        central = self._maximise(limits, (0.0, None), floor=MARGIN_TIE * top.margin / self.unit, still=still, apart=1.0)
        return self.support(self._torque(central)) if central.status == 0 else top

    def loss_fraction(self, before, after) -> float:
        """The share of the way between two torques from which no forces hold the object: 1 if some always do."""
        ends = np.stack([before, after])
        limits = np.column_stack([ends.min(0), ends.max(0)])
        found = self._maximise(limits, (0.0, 1.0), path=ends)
        return float(found.x[-1]) if found.status == 0 else 0.0

    @staticmethod
    def _torque(found) -> Float[np.ndarray, "2"]:
        return found.x[-3:-1]

    def _best(self, limits, still=NO_ROWS) -> StaticMargin:
        """Maximise the margin; where no forces are possible, minus the least adhesion."""
        found = self._maximise(limits, (0.0, MARGIN_CAP), press=1.0, still=still)
        if found.status != 0:
            found = self._maximise(limits, (None, 0.0), press=1.0, adhesion=1.0, still=still)
        if found.status != 0:
            return StaticMargin(-np.inf, self.names[0], limits.mean(1))
        # Each contact's share of the price of the margin: its pressure's, and where it adheres that of its cone.
        pressure, one, other = -found.ineqlin.marginals[: 3 * len(self.names)].reshape(3, -1)
        price = pressure + self.friction * (one + other) * (found.x[-1] < 0)
        return StaticMargin(float(found.x[-1]) * self.unit, self.names[int(np.argmax(price))], self._torque(found))

    def _maximise(self, limits, bounds, *, press=0.0, floor=0.0, adhesion=0.0, still=NO_ROWS, apart=0.0, path=None):
        """The linear programme in `(c_n, c_t, d, tau1, tau2, m)` that maximises `m` within `bounds`, with

            c_n >= press m + floor,     |c_t| <= mu (c_n - adhesion m),     still @ (1, tau) <= -apart m

        and, along a `path`, `tau = path[0] + m (path[1] - path[0])`.
        """
        count = len(self.names)
        one, none, grip = np.eye(count), np.zeros((count, count)), np.diag(self.friction)
        forces = np.block([[-one, none], [-grip, one], [-grip, -one]])
        loosened = np.concatenate([np.full(count, press), *2 * [adhesion * self.friction]])
        upper = np.column_stack([forces, np.zeros((3 * count, 4)), loosened])
        moving = np.column_stack([np.zeros((len(still), 2 * count + 2)), still[:, 1:], np.full(len(still), apart)])
        equal = np.column_stack([self.wrench, self.load[:, 1:], np.zeros(5)])
        right = -self.load[:, 0]
        if path is not None:
            along = np.column_stack([np.zeros((2, 2 * count + 2)), np.eye(2), path[0] - path[1]])
            equal, right = np.vstack([equal, along]), np.append(right, path[0])
        free = [(None, None)] * (2 * count)
        from scipy.optimize import linprog  # takes half a second to import, and most plans have no holds

        return linprog(
            np.append(np.zeros(2 * count + 4), -1.0),
            A_ub=np.vstack([upper, moving]),
            b_ub=np.concatenate([np.full(count, -floor), np.zeros(2 * count), -still[:, 0]]),
            A_eq=equal,
            b_eq=right,
            bounds=[*free, *zip(-self.dry, self.dry, strict=True), *limits.tolist(), bounds],
            options=SOLVER_TOL,
        )


def contact_statics(scene: Scene, formation: ContactFormation, z: Float[Array, "5"]) -> Statics:
    """The balance of forces for an object at rest at `z` (SI) in a formation, of however many contacts."""
    mechanics, normal, slip = jax.device_get(_rows(scene, formation, z))
    slots, joints = list(formation.normal_rows), np.eye(5)[:, 3:]
    force, radius = float(mechanics.force_unit), float(mechanics.length)
    weight = np.append(mechanics.inertia[0] * mechanics.gravity * force, np.zeros(3))
    unit = float(np.abs(weight).max() + mechanics.torque_limit.max() / radius)
    return Statics(
        names=formation.names,
        wrench=np.hstack([normal[slots].T, slip[slots].T, joints]),
        load=np.column_stack([weight, joints / radius]) / unit,
        friction=np.asarray(mechanics.contacts.friction)[slots],
        dry=np.asarray(mechanics.dry) * force / unit,
        torque_limit=np.asarray(mechanics.torque_limit),
        unit=unit,
    )


@jax.jit
def _rows(scene: Scene, formation: ContactFormation, z):
    mechanics = scaled_mechanics(rigid_body(scene.object), scene.hand, scene.gravity, formation)
    here = z / mechanics.configuration_unit
    return mechanics, normal_jacobian(mechanics.contacts, here), tangential_jacobian(mechanics.contacts, here)


def rest_margin(balance: Statics, schedule: TorqueSchedule, start: float, end: float) -> RestInterval:
    """The margin of a hold from `start` to `end` [s] under a schedule, exactly: linear torque, concave margin."""
    times, torques = _corners(schedule, start, end)
    supports = [balance.support(torque) for torque in torques]
    worst = int(np.argmin([one.margin for one in supports]))
    floor = FEASIBILITY_TOL * balance.unit
    bad = next((k for k, one in enumerate(supports) if one.margin < floor), None)
    lost, which = None, supports[worst].contact
    if bad is not None:
        which = supports[bad].contact
        share = balance.loss_fraction(torques[bad - 1], torques[bad]) if bad > 0 else 1.0
        lost = times[max(bad - 1, 0)] + share * (times[bad] - times[max(bad - 1, 0)])
    return RestInterval(start, end, supports[worst].margin, times[worst], which, lost)


def _corners(schedule: TorqueSchedule, start: float, end: float):
    """Times and torques between which a schedule is linear from `start` to `end`; a step has both its sides, but for
    one at `start` or `end`, where only what is between counts."""
    times, values = np.asarray(schedule.times), np.asarray(schedule.values)
    near = time_tolerance(times, start, end)
    inside = (times > start + near) & (times < end - near)

    def at(time, row):
        row = int(np.clip(row, 0, len(times) - 2))
        gap = times[row + 1] - times[row]
        return values[row] + (values[row + 1] - values[row]) * ((time - times[row]) / gap if gap > 0 else 1.0)

    first = np.searchsorted(times, start + near, side="right") - 1
    last = np.searchsorted(times, end - near, side="left") - 1
    return [start, *times[inside].tolist(), end], [at(start, first), *values[inside], at(end, last)]


def _still(departure: RestAccelerations | None) -> Float[np.ndarray, "rows 3"]:
    """Rows with `row @ (1, tau) <= 0` while the object stays, of unit size in the torque."""
    if departure is None:
        return NO_ROWS
    rows = np.stack([departure.ahead, -departure.behind])
    return rows / np.linalg.norm(rows[:, 1:], axis=1, keepdims=True)
