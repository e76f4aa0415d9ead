"""A closed loop in continuous time: the law of `docs/feedback.md` on the five coordinates of `unreduced`.

Nothing here is shared with the package: the law's numbers are those of `controller.json`, the mechanics `unreduced`'s.
The state is `(z, z_dot, s, v, i)`; sampling becomes the limit of short periods, in which the observer of the page is
`ds/dt = v + 2 w_o e`, `dv/dt = dv_ref/dt + w_o^2 e`.
"""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from tests.reference.feedback_law import project, table


class ClosedLoop:
    """A phase of a controller that drives a `unreduced.Model`."""

    def __init__(self, content, phase, model, signs):
        self.c, self.p, self.model, self.signs = content, content["phases"][phase], model, signs
        self.offset, self.reversals = None, 0

    def reference(self, u):
        p, duration = self.p, self.p["time"][-1]
        s, v = np.interp(u, p["time"], p["s_ref"]), np.interp(u, p["time"], p["v_ref"])
        if u > duration:
            s += min(p["approach"] * (u - duration), p["reach"])
            v = p["approach"] if p["approach"] * (u - duration) < p["reach"] else 0.0
        return s + self.offset * max(0.0, 1 - u / duration), v

    def act(self, u, memory):
        """The torque, and the rate of the integral part."""
        c, p, (s, v, i) = self.c, self.p, memory
        s_ref, v_ref = self.reference(u)
        g, w = table(p, "s", "gain", s), c["stiffness"]
        most = c["push"] / np.abs(g).max()
        ahead = min(most, p["press"]) if s_ref > p["s"][-1] - p["reach"] else most
        wanted = w**2 * (s_ref - s) + 2 * w * (v_ref - v) + i
        a = min(max(wanted, -most), ahead)
        limit = np.array(c["torque_limit"])
        torque = np.clip(table(p, "time", "torque", u) + g * a, -limit, limit)
        return torque, c["integral"] * (a - 2 * w * (v_ref - v) - i)

    def observe(self, u, angles, memory):
        e, w = project(self.p, angles, memory[0]) - memory[0], self.c["observer"]
        time, v_ref = np.array(self.p["time"]), np.array(self.p["v_ref"])
        faster = (np.diff(v_ref) / np.diff(time))[min(max(np.sum(u > time) - 1, 0), len(time) - 2)] * (u <= time[-1])
        return np.array([memory[1] + 2 * w * e, faster + w**2 * e, self.act(u, memory)[1]])

    def field(self, u, y):
        z, z_dot, memory = y[:5], y[5:10], y[10:]
        z_ddot = self.model.solve(z, z_dot, self.act(u, memory)[0], self.signs)[0]
        return np.concatenate([z_dot, z_ddot, self.observe(u, z[3:], memory)])

    def depart(self, z, tangent):
        """When the object sets out from rest at `z`, and the law's memory then."""
        start = project(self.p, z[3:], 0.0)
        self.offset = start - self.p["s_ref"][0]

        def pull(u, memory):
            return self.model.solve(z, np.zeros(5), self.act(u, memory)[0], self.signs)[0] @ tangent

        now, memory = 0.0, np.array([start, 0.0, 0.0])
        for knot in self.p["time"][1:]:
            held = solve_ivp(
                lambda u, m: self.observe(u, z[3:], m),
                (now, knot),
                memory,
                method="DOP853",
                rtol=1e-11,
                atol=1e-13,
                dense_output=True,
            )
            if pull(knot, held.y[:, -1]) > 0:
                when = brentq(lambda u, held=held: pull(u, held.sol(u)), now, knot, xtol=1e-14)
                return when, held.sol(when)
            now, memory = knot, held.y[:, -1]
        raise AssertionError("the object stays at rest")

    def _advance(self, now, end, y, rtol):
        """Go on to `end`, or to the next reversal of a slip or a joint, whose sign changes there."""

        def watch(k):
            def event(u, y):
                return 1.0 if u == now else self.signs[k] * self.model.reversing(y[:5], y[5:10])[k]

            event.terminal, event.direction = True, -1.0
            return event

        moving = np.flatnonzero(self.signs)
        given = {"method": "DOP853", "rtol": rtol, "atol": 1e-11, "first_step": (end - now) / 2}
        found = solve_ivp(self.field, (now, end), y, events=[watch(k) for k in moving], **given)
        for k, hit in zip(moving, found.t_events, strict=True):
            if len(hit):
                self.signs = self.signs * np.where(np.arange(len(self.signs)) == k, -1.0, 1.0)
                self.reversals += 1
        return found.t[-1], found.y[:, -1]

    def follow(self, z, tangent, times, rtol=1e-9):
        """`(z, z_dot, memory)` and the least contact force at `times`, from rest at `z`."""
        begin, memory = self.depart(z, tangent)
        y, now, states = np.concatenate([z, np.zeros(5), memory]), begin, []
        knots = np.unique(np.concatenate([[t for t in self.p["time"] if t > begin], times[times > begin]]))
        for knot in knots[knots <= times[-1]]:
            while now < knot:
                now, y = self._advance(now, knot, y, rtol)
            if np.any(times == knot):
                torque = self.act(knot, y[10:])[0]
                states.append((y, self.model.solve(y[:5], y[5:10], torque, self.signs)[1].min()))
        return begin, states
