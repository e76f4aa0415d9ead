"""The law of `docs/feedback.md`, written from that page and `controller.json` alone; imports nothing of the package."""

import json

import numpy as np


class Law:
    """One controller at work."""

    def __init__(self, path):
        with open(path) as file:
            self.c = json.load(file)
        self.n, self.t0, self.t, self.s, self.v, self.o = 0, 0.0, None, 0.0, 0.0, 0.0
        self.i, self.still, self.pressed, self.arrived = 0.0, 0.0, False, False

    def torque(self, t, angles):
        c, first = self.c, self.t is None
        if first:
            self.t0 = self.t = t
            self.s = self.o = project(c["phases"][0], angles, 0.0)
        h, w, p = t - self.t, c["stiffness"], c["phases"][self.n]
        # Observe.
        faster = np.diff(np.interp([self.t - self.t0, t - self.t0], p["time"], p["v_ref"]))[0]
        r, predicted = np.exp(-c["observer"] * h), self.s + h * (self.v + faster / 2)
        e = project(p, angles, predicted) - predicted
        self.s = predicted + (1 - r**2) * e
        self.v += faster + ((1 - r) ** 2 * e / h if h > 0 else 0.0)
        self.still = self.still + h if self.pressed and abs(self.v) < c["felt"][0] else 0.0
        # Change the phase.
        u, length, duration = t - self.t0, p["s"][-1], p["time"][-1]
        stopped = u >= duration and (p["reach"] == 0 or (self.pressed and self.still >= c["felt"][1]))
        over = u >= duration + c["patience"] or (self.s >= length if p["flows"] else stopped)
        if over and self.n + 1 == len(c["phases"]):
            self.arrived = True
        elif over:
            turn = np.dot(p["tangent"][-1], c["phases"][self.n + 1]["tangent"][0])
            self.v = self.v * turn if p["flows"] else 0.0
            self.n, self.t0, p, u = self.n + 1, t, c["phases"][self.n + 1], 0.0
            self.s = project(p, angles, 0.0)
            self.o, self.i, self.still, self.pressed = self.s - p["s_ref"][0], 0.0, 0.0, False
            length, duration = p["s"][-1], p["time"][-1]
        # Refer.
        s_ref, v_ref = np.interp(u, p["time"], p["s_ref"]), np.interp(u, p["time"], p["v_ref"])
        if u > duration:
            s_ref += min(p["approach"] * (u - duration), p["reach"])
            v_ref = p["approach"] if p["approach"] * (u - duration) < p["reach"] else 0.0
        s_ref += self.o * max(0.0, 1 - u / duration)
        # Act.
        g = table(p, "s", "gain", self.s)
        most = c["push"] / np.abs(g).max()
        ahead = min(most, p["press"]) if s_ref > length - p["reach"] else most
        wanted = w**2 * (s_ref - self.s) + 2 * w * (v_ref - self.v) + self.i
        a = np.clip(wanted, -most, ahead)
        self.i += h * c["integral"] * (a - 2 * w * (v_ref - self.v) - self.i)
        self.pressed, self.t = wanted >= ahead, t
        limit = np.array(c["torque_limit"])
        return np.clip(table(p, "time", "torque", u) + g * a, -limit, limit)


def table(phase, over, name, at):
    return np.array([np.interp(at, phase[over], column) for column in zip(*phase[name], strict=True)])


def project(phase, angles, s):
    for _ in range(3):
        cut = min(max(s, 0.0), phase["s"][-1])
        d = table(phase, "s", "tangent", cut)
        s += d @ (angles - table(phase, "s", "theta", cut) - (s - cut) * d)
    return s
