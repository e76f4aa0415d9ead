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

from wholearm_jax.core import LinearProgramme, LinearProgrammeSolution
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

    def rest_rows(self, torque_unit: float | np.ndarray = 1.0) -> Float[np.ndarray, "2 3"]:
        """Rows with `row @ (1, torque) <= 0` while the object stays, of unit size in the torque, in `torque_unit`."""
        rows = np.stack([self.ahead, -self.behind])
        rows[:, 1:] *= torque_unit
        return rows / np.linalg.norm(rows[:, 1:], axis=1, keepdims=True)


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
        return self._best(limits, NO_ROWS if departure is None else departure.rest_rows())

    def steadiest(self, departure: RestAccelerations) -> StaticMargin:
        """A torque with `MARGIN_TIE` of the largest margin, as far as it can be from those that move the object."""
        limits, still = np.column_stack([-self.torque_limit, self.torque_limit]), departure.rest_rows()
        top = self._best(limits, still)
        if not top.margin > 0:
            return top
        floor = MARGIN_TIE * top.margin / self.unit
        central = self._maximise(limits, (0.0, np.inf), floor=floor, still=still, apart=1.0)
        return top if central is None else self.support(central.values["torque"])

    def loss_fraction(self, before, after) -> float:
        """The share of the way between two torques from which no forces hold the object: 1 if some always do."""
        ends = np.stack([before, after])
        limits = np.column_stack([ends.min(0), ends.max(0)])
        last = self._maximise(limits, (0.0, 1.0), path=ends)
        return 0.0 if last is None else float(last.values["m"][0])

    def _best(self, limits, still=NO_ROWS) -> StaticMargin:
        """Maximise the margin; where no forces are possible, minus the least adhesion."""
        best = self._maximise(limits, (0.0, MARGIN_CAP), press=1.0, still=still)
        if best is None:
            best = self._maximise(limits, (-np.inf, 0.0), press=1.0, adhesion=1.0, still=still)
        if best is None:
            return StaticMargin(-np.inf, self.names[0], limits.mean(1))
        margin, multipliers = float(best.values["m"][0]), best.multipliers
        # Each contact's part in what limits the margin: its pressure, and where it adheres its friction cone.
        cone = self.friction * (multipliers["cone_above"] + multipliers["cone_below"])
        weakest = int(np.argmax(multipliers["pressure"] + cone * (margin < 0)))
        return StaticMargin(margin * self.unit, self.names[weakest], best.values["torque"])

    def _maximise(
        self, limits, bounds, *, press=0.0, floor=0.0, adhesion=0.0, still=NO_ROWS, apart=0.0, path=None
    ) -> LinearProgrammeSolution | None:
        """Maximise `m` within `bounds` over forces as in `add_forces`, with `still @ (1, torque) <= -apart m`.

        Along a `path`, `torque = path[0] + m (path[1] - path[0])`.
        """
        programme = LinearProgramme()
        self.add_forces(programme, level="m", press=press, floor=floor, adhesion=adhesion)
        programme.add_variables("torque", *limits.T)
        programme.add_variables("m", *bounds)
        programme.at_most("rest", -still[:, 0], torque=still[:, 1:], m=apart)
        if path is not None:
            programme.equal("path", path[0], torque=np.eye(2), m=path[0] - path[1])
        return programme.maximise("m")

    def add_forces(
        self,
        programme: LinearProgramme,
        *,
        level: str,
        press: float = 0.0,
        floor: float = 0.0,
        adhesion: float = 0.0,
        torque: str = "torque",
        torque_unit: float | np.ndarray = 1.0,
        prefix: str = "",
    ) -> None:
        """Add the forces of the object at rest to a linear programme:

            c_n >= press m + floor,     |c_t| <= mu (c_n - adhesion m),     |d| <= D,     and their balance.

        Args:
            programme: gets the blocks `c_n`, `c_t` and `d`, in units of `unit`.
            level: name of the block `m`.
            press, floor, adhesion: as above.
            torque: name of the block of torques.
            torque_unit: unit of this block [N m].
            prefix: of the names of all blocks and rows that are added.
        """
        count = len(self.names)
        one, cone, zero, unbounded = np.eye(count), np.diag(self.friction), np.zeros(count), np.full(count, np.inf)
        c_n, c_t, d = (prefix + name for name in ("c_n", "c_t", "d"))
        programme.add_variables(c_n, -unbounded, unbounded)
        programme.add_variables(c_t, -unbounded, unbounded)
        programme.add_variables(d, -self.dry, self.dry)
        programme.at_most(prefix + "pressure", zero - floor, **{c_n: -one, level: press})
        for name, side in (("cone_above", one), ("cone_below", -one)):
            programme.at_most(prefix + name, zero, **{c_n: -cone, c_t: side, level: adhesion * self.friction})
        forces = dict(zip((c_n, c_t, d), np.split(self.wrench, [count, 2 * count], axis=1), strict=True))
        programme.equal(prefix + "balance", -self.load[:, 0], **forces, **{torque: self.load[:, 1:] * torque_unit})


def contact_statics(scene: Scene, formation: ContactFormation, z: Float[Array | np.ndarray, "5"]) -> Statics:
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
