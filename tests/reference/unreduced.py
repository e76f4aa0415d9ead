"""An independent simulation without the wire: Newton-Euler with four gap constraints, in NumPy and SciPy only.

Nothing here is shared with the package. All five coordinates `z = (x, y, phi, theta1, theta2)` and their rates are
integrated; at each time one 9x9 system gives accelerations and contact forces,

    [ M    -(G_n - Xi U G_t)^T ] [ z_ddot ]   [ E tau + g - B z_dot - D sgn(z_dot) ]
    [ G_n   0                  ] [ c_n    ] = [ -G_n_dot z_dot                     ]

A rolling contact adds a row of its own, `G_t z_ddot = -G_t_dot z_dot`, and a free tangential force `c_t`; `G_t_dot` is
taken by complex-step differentiation, so that no second derivative is written down.

Signs of slips (Xi) and of joint speeds are constants of a segment; segments end on torque knots and on reversals.
"""

from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

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


@dataclass(frozen=True)
class Contact:
    """`kind` "v": vertex `feature` on the link's edge; "e": the fingertip on edge `feature`. `link` 0 is the palm."""

    link: int
    kind: str
    feature: int
    rolls: bool = False


def contact(text):
    """`finger1:v2` or `palm:v6 rolling` as a `Contact`."""
    name, *rolls = text.split()
    link, feature = name.split(":")
    return Contact(LINKS.index(link), feature[0], int(feature[1:]), rolls == ["rolling"])


class Model:
    """One formation from plain numbers, nested as in a scene file."""

    def __init__(self, data, contacts):
        fingers = [data["hand"]["finger1"], data["hand"]["finger2"]]
        self.joint = np.array([f["joint"] for f in fingers])
        self.length = np.array([f["length"] for f in fingers])
        self.offset = np.array([f.get("offset", 0.0) for f in fingers])
        self.viscous = np.array([f.get("viscous", 0.0) for f in fingers])
        self.dry = np.array([f.get("dry", 0.0) for f in fingers])
        solid = data["object"]
        area, centroid, second = uniform(solid["vertices"])
        assert "center_of_mass" not in solid
        self.vertices = np.array(solid["vertices"]) - centroid
        self.mass = solid["mass"]
        self.inertia = solid.get("inertia", self.mass * second / area)
        self.mass_matrix = np.diag([self.mass, self.mass, self.inertia, *(f["inertia"] for f in fingers)])
        gravity = data["gravity"]
        self.gravity = np.array([0.0, -gravity] if np.isscalar(gravity) else gravity)
        self.contacts = [contact(text) for text in contacts]
        friction = solid["friction"]
        each = friction if isinstance(friction, dict) else dict.fromkeys(LINKS, friction)
        self.friction = np.array([each[LINKS[c.link]] for c in self.contacts])
        self.rolls = np.array([c.rolls for c in self.contacts])

    # --- gaps, their gradients, slips and what is left of the second derivative without acceleration -----------------

    def _contact(self, c, z, z_dot):
        """Gap, `G_n`, `G_t` and `G_n_dot z_dot` of one contact."""
        q, phi = z[:2], z[2]
        turn = np.array([[np.cos(phi), -np.sin(phi)], [np.sin(phi), np.cos(phi)]])
        vertex = turn @ self.vertices[c.feature]
        gap_row, slip_row = np.zeros((2, 5), np.result_type(z, z_dot))
        rate = z_dot[2]
        if c.link == 0:
            gap_row[:3] = 0.0, 1.0, vertex[0]
            slip_row[:3] = 1.0, 0.0, -vertex[1]
            return q[1] + vertex[1], gap_row, slip_row, -vertex[1] * rate**2
        finger, side = c.link - 1, (1.0 if c.link == 1 else -1.0)
        spin = z_dot[3 + finger]
        along = np.array([np.cos(z[3 + finger]), np.sin(z[3 + finger])])
        normal = side * quarter(along)
        velocity = z_dot[:2] + rate * quarter(vertex)
        if c.kind == "v":
            reach = q + vertex - self.joint[finger]
            tangent = -quarter(normal)
            gap = normal @ reach - self.offset[finger]
            gap_row[:3] = *normal, normal @ quarter(vertex)
            gap_row[3 + finger] = -side * (along @ reach)
            slip_row[:3] = *tangent, tangent @ quarter(vertex)
            slip_row[3 + finger] = -(tangent @ quarter(reach))
            left = -2 * side * spin * (along @ velocity) - spin**2 * (normal @ reach) - rate**2 * (normal @ vertex)
            return gap, gap_row, slip_row, left
        after = turn @ self.vertices[(c.feature + 1) % len(self.vertices)]
        edge = (after - vertex) / np.sqrt((after - vertex) @ (after - vertex))
        normal = quarter(edge)
        arm = self.length[finger] * along + self.offset[finger] * side * quarter(along)
        tip = self.joint[finger] + arm
        away = q + vertex - tip
        tangent = edge
        gap_row[:3] = *normal, quarter(normal) @ away + normal @ quarter(vertex)
        gap_row[3 + finger] = -(normal @ quarter(arm))
        slip_row[:3] = *tangent, tangent @ quarter(tip - q)
        slip_row[3 + finger] = -(tangent @ quarter(arm))
        left = (
            -(rate**2) * (normal @ away)
            + 2 * rate * (quarter(normal) @ (velocity - spin * quarter(arm)))
            + normal @ (-(rate**2) * vertex + spin**2 * arm)
        )
        return normal @ away, gap_row, slip_row, left

    def geometry(self, z, z_dot):
        """Gaps, `G_n`, `G_t` and `G_n_dot z_dot` of all contacts."""
        return [np.array(column) for column in zip(*(self._contact(c, z, z_dot) for c in self.contacts), strict=True)]

    def rolling(self, z, z_dot):
        """`G_t` and `G_t_dot z_dot` of the contacts that roll."""
        step = 1e-30
        beside = self.geometry(z + 1j * step * z_dot, z_dot)[2]
        return self.geometry(z, z_dot)[2][self.rolls], (beside.imag / step @ z_dot)[self.rolls]

    def reversing(self, z, z_dot):
        """Slip velocities (0 for contacts that roll) and joint speeds: what must not change sign within a segment."""
        return np.concatenate([np.where(self.rolls, 0.0, self.geometry(z, z_dot)[2] @ z_dot), z_dot[3:]])

    def matrix(self, z, z_dot, signs):
        """The matrix of the equations of motion and of the constraints, and `G_dot z_dot` of the latter."""
        _, gap_rows, slip_rows, left = self.geometry(z, z_dot)
        wrench = gap_rows - (self.friction * np.where(self.rolls, 0.0, signs[:-2]))[:, None] * slip_rows
        held_rows, held_left = self.rolling(z, z_dot)
        wrench, gap_rows = np.concatenate([wrench, held_rows]).T, np.concatenate([gap_rows, held_rows])
        left = np.concatenate([left, held_left])
        return np.block([[self.mass_matrix, -wrench], [gap_rows, np.zeros((len(left), len(left)))]]), left

    def solve(self, z, z_dot, torque, signs):
        """Accelerations (5) and constraint forces (every `c_n`, then `c_t` of those that roll) for given signs of slips
        and joint speeds (2)."""
        matrix, left = self.matrix(z, z_dot, signs)
        force = np.concatenate([self.mass * self.gravity, [0.0], torque])
        force[3:] -= self.viscous * z_dot[3:] + self.dry * signs[-2:]
        answer = np.linalg.solve(matrix, np.concatenate([force, -left]))
        return answer[:5], answer[5:]

    def direction(self, z, toward):
        """The unit tangent of the wire at `z`, oriented by a coordinate and a sign such as `x-`."""
        rows = np.concatenate([self.geometry(z, np.zeros(5))[1], self.rolling(z, np.zeros(5))[0]])
        null = np.linalg.svd(rows)[2][-1]
        return null if null[COORDINATES.index(toward[:-1])] * (1 if toward[-1] == "+" else -1) > 0 else -null

    # --- time ---------------------------------------------------------------------------------------------------------

    def simulate(self, z, toward, times, values, end, rtol=1e-12, atol=1e-14):
        """Move from rest at `z` from `fused_matmul[0]` to `end` under a piecewise linear torque; rest is not
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
