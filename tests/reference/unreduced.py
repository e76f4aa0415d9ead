"""An independent simulation without the contact path: Newton-Euler with constraints at acceleration level, in NumPy
and SciPy.

Nothing here is shared with the package; the contacts' geometry is `reference.mechanics`. All five coordinates
`z = (x, y, phi, theta1, theta2)` and their rates are integrated; at each time one system gives accelerations and
forces,

    [ M    -(G_n - Xi U G_t)^T ] [ z_ddot ]   [ E tau + g - B z_dot - D sgn(z_dot) ]
    [ G_n   0                  ] [ c_n    ] = [ -G_n_dot z_dot                     ]

A rolling contact adds a row of its own, `G_t z_ddot = -G_t_dot z_dot`, and a free tangential force `c_t`. Signs of
slips
(Xi) and of joint speeds are constants of a segment; segments end on torque knots and on reversals.
"""

from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

from tests.reference import mechanics

COORDINATES = ("x", "y", "phi", "theta1", "theta2")
LINKS = ("palm", "finger1", "finger2")


def quarter(a):
    """`a` turned by +90 degrees."""
    return np.array([-a[1], a[0]])


def uniform(vertices):
    """Area, centroid and polar second moment about the centroid of a polygon, as a fan of triangles from vertex 0."""
    p = np.asarray(vertices, float)
    corner = p[0]
    area, first, second = 0.0, np.zeros(2), 0.0
    for a, b in zip(p[1:-1] - corner, p[2:] - corner, strict=True):
        segment = (a[0] * b[1] - a[1] * b[0]) / 2
        area += segment
        first += segment * (a + b) / 3
        second += segment * (a @ a + a @ b + b @ b) / 6
    centroid = first / area
    return area, corner + centroid, second - area * centroid @ centroid


def constraint_rows(contacts):
    """Link, kind (0 vertex, 1 edge), feature and whether tangential, one row a constraint: two for `... rolling`."""
    rows = []
    for text in contacts:
        name, *rolls = text.split()
        link, feature = name.split(":")
        row = LINKS.index(link), "ve".index(feature[0]), int(feature[1:])
        rows += [(*row, False)] + ([(*row, True)] if rolls else [])
    return np.array(rows)


class Model:
    """One formation from plain numbers in SI units, nested as in a scene file."""

    def __init__(self, data, contacts):
        fingers = [data["hand"]["finger1"], data["hand"]["finger2"]]
        solid = data["object"]
        area, centroid, second = uniform(solid["vertices"])
        assert "center_of_mass" not in solid
        vertices, self.mass = np.array(solid["vertices"]) - centroid, solid["mass"]
        inertia = [
            self.mass,
            self.mass,
            solid.get("inertia", self.mass * second / area),
            *(f["inertia"] for f in fingers),
        ]
        gravity, friction = data["gravity"], solid["friction"]
        rows = constraint_rows(contacts)
        self.rolls = np.append(rows[1:, 3] > 0, False)[rows[:, 3] == 0]
        each = friction if isinstance(friction, dict) else dict.fromkeys(LINKS, friction)

        def of_fingers(key, default=0.0):
            return np.array([[f.get(key, default) for f in fingers]])

        self.contacts = mechanics.Model(
            vertices=vertices[None],
            count=np.array([len(vertices)]),
            friction=np.array([[each[link] for link in LINKS]]),
            joint=of_fingers("joint"),
            length=of_fingers("length"),
            offset=of_fingers("offset"),
            inertia=np.array([inertia]),
            viscous=of_fingers("viscous"),
            dry=of_fingers("dry"),
            gravity=self.mass * np.array([[0.0, -gravity] if np.isscalar(gravity) else gravity]),
            formation=tuple(rows[None, :, k] for k in range(3)),
            tangential=rows[None, :, 3] > 0,
        )
        self.normal, self.last = rows[:, 3] == 0, (None, None)
        self.friction = self.contacts.friction[0, self.normal]

    def _geometry(self, z, z_dot):
        """The contacts; kept for the next call, as the events of a step look at the same state one after the other."""
        state = z.tobytes(), z_dot.tobytes()
        if self.last[0] != state:
            values = self.contacts.geometry(z[None, None], z_dot[None, None])
            self.last = state, mechanics.Geometry(*(value[0, 0] for value in values))
        return self.last[1]

    def geometry(self, z, z_dot):
        """Gaps, `G_n`, `G_t` and `G_n_dot z_dot` of all contacts."""
        at, rows = self._geometry(z, z_dot), self.normal
        return at.gap[rows], at.normal_rows[rows], at.slip_rows[rows], at.left[rows]

    def rolling(self, z, z_dot):
        """`G_t` and `G_t_dot z_dot` of the contacts that roll."""
        at = self._geometry(z, z_dot)
        return at.normal_rows[~self.normal], at.left[~self.normal]

    def reversing(self, z, z_dot):
        """Slip velocities (0 for contacts that roll) and joint speeds: what must not change sign within a segment."""
        return np.concatenate([np.where(self.rolls, 0.0, self.geometry(z, z_dot)[2] @ z_dot), z_dot[3:]])

    def matrix(self, z, z_dot, signs):
        """The matrix of the equations of motion and of the constraints, and `G_dot z_dot` of the latter."""
        at, rows = self._geometry(z, z_dot), self.normal
        slipping = (self.friction * np.where(self.rolls, 0.0, signs[:-2]))[:, None] * at.slip_rows[rows]
        wrench = np.concatenate([at.normal_rows[rows] - slipping, at.normal_rows[~rows]]).T
        constraint = np.concatenate([at.normal_rows[rows], at.normal_rows[~rows]])
        left = np.concatenate([at.left[rows], at.left[~rows]])
        mass = np.diag(self.contacts.inertia[0])
        return np.block([[mass, -wrench], [constraint, np.zeros((len(left), len(left)))]]), left

    def solve(self, z, z_dot, torque, signs):
        """Accelerations (5) and constraint forces (every `c_n`, then `c_t` of those that roll) for given signs of slips
        and joint speeds (2)."""
        matrix, left = self.matrix(z, z_dot, signs)
        force = self.contacts.applied(z_dot[None, None], torque, signs[-2:])[0, 0]
        answer = np.linalg.solve(matrix, np.concatenate([force, -left]))
        return answer[:5], answer[5:]

    def direction(self, z, toward):
        """The unit tangent of the path at `z`, oriented by a coordinate and a sign such as `x-`."""
        null = np.linalg.svd(self._geometry(z, np.zeros(5)).normal_rows)[2][-1]
        return null if null[COORDINATES.index(toward[:-1])] * (1 if toward[-1] == "+" else -1) > 0 else -null

    # --- time ---------------------------------------------------------------------------------------------------------

    def simulate(self, z, toward, times, values, end, rtol=1e-12, atol=1e-14):
        """Move from rest at `z` from `times[0]` to `end` under a piecewise linear torque; rest is not
        handled."""
        signs = np.sign(self.reversing(z, self.direction(z, toward)))
        state, segments, reversals = np.concatenate([z, np.zeros(5)]), [], []
        for low, high, first, last in zip(times[:-1], times[1:], values[:-1], values[1:], strict=True):
            if high <= low or low >= end:
                continue
            slope, now = (last - first) / (high - low), low
            while now < min(high, end):
                found, which = self._segment(state, now, min(high, end), signs, low, first, slope, (rtol, atol))
                segments.append((found.t[0], found.t[-1], found.sol, signs, low, first, slope))
                state, now = found.y[:, -1], found.t[-1]
                if which is not None:
                    signs = signs * np.where(np.arange(len(signs)) == which, -1.0, 1.0)
                    reversals.append((now, which))
                    assert len(reversals) < 10, f"chattering, the object rests: {reversals}"
        return Run(self, segments, reversals)

    def _segment(self, state, begin, end, signs, low, first, slope, tolerances):
        def field(t, y):
            torque = first + slope * (t - low)
            return np.concatenate([y[5:], self.solve(y[:5], y[5:], torque, signs)[0]])

        def watch(k):
            def event(t, y):
                # The slip that ended the segment before, and rest at the start, are zeros that do not count.
                return 1.0 if t == begin else signs[k] * self.reversing(y[:5], y[5:])[k]

            event.terminal, event.direction = True, -1.0
            return event

        # A coordinate that never moves has sign 0 and needs no event.
        watched = [k for k in range(len(signs)) if signs[k] != 0]
        found = solve_ivp(
            field,
            (begin, end),
            state,
            method="DOP853",
            rtol=tolerances[0],
            atol=tolerances[1],
            dense_output=True,
            events=[watch(k) for k in watched],
        )
        assert found.success, found.message
        hit = [k for k, at in zip(watched, found.t_events, strict=True) if len(at)]
        assert len(hit) < 2, "several reversals at once: the object came to rest"
        return found, hit[0] if hit else None


@dataclass(frozen=True)
class Run:
    """A simulated phase; `reversals` are (time, row of `Model.reversing`)."""

    model: Model
    segments: list
    reversals: list

    def at(self, time):
        """`z`, `z_dot` and the contact forces at a time."""
        held = next(s for s in self.segments if time <= s[1])
        _, _, solution, signs, low, first, slope = held
        y = solution(time)
        return y[:5], y[5:], self.model.solve(y[:5], y[5:], first + slope * (time - low), signs)[1]
