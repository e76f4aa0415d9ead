r"""A hand-written loop over a path's table: what simulating one phase costs without any framework, in numba.

    ds/du = w,    dw/du = T^2 (A0 + A3 tau1 + A4 tau2) + T A2 w + A1 w^2

by an embedded Runge-Kutta method of any tableau with diffrax's default step control. Steps end on the torque's knots
and land on a piece's end (a slip reversal, the path's end) by Newton's method on the last step's length. The object
starts moving and must not turn back: waiting, friction at rest and every check of the package are left out.
"""

from typing import NamedTuple

import numba
import numpy as np


class Tableau(NamedTuple):
    """Butcher's coefficients: `a` (stages x stages, strictly lower), `b`, `c`, the error's weights, the step's order.

    `first_same_as_last` says that the last stage is the next step's first.
    """

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    error: np.ndarray
    order: int
    first_same_as_last: bool


def tableau(solver) -> Tableau:
    """The tableau of a diffrax explicit Runge-Kutta solver as dense arrays."""
    rows = solver.tableau
    stages = rows.b_sol.shape[0]
    a = np.zeros((stages, stages))
    for k, row in enumerate(rows.a_lower):
        a[k + 1, : k + 1] = row
    c = np.concatenate([[0.0], rows.c])
    return Tableau(a, np.array(rows.b_sol), c, np.array(rows.b_error), solver.order(None), bool(rows.fsal))


class Motion(NamedTuple):
    """Accepted steps `nodes[: count + 1]`, rows (share, s, w), and how often the right-hand side was evaluated."""

    nodes: np.ndarray
    count: int
    evaluations: int


def arrays(dynamics, phase_schedule) -> tuple[np.ndarray, ...]:
    """A table and a torque window as the NumPy arrays that `simulate_motion` wants."""
    polynomials = np.ascontiguousarray(np.asarray(dynamics.acceleration))
    whole = (np.asarray(a).astype(np.int64) for a in (dynamics.first, dynamics.panels))
    reals = (np.asarray(a) for a in (dynamics.breakpoints, dynamics.speed_ratio))
    schedule = (np.asarray(a) for a in (phase_schedule.phase_time, phase_schedule.values, phase_schedule.slope))
    return (
        polynomials,
        *whole,
        *reals,
        int(dynamics.count),
        *schedule,
        int(phase_schedule.first),
        int(phase_schedule.last),
    )


def move(given, duration: float, method: Tableau, tolerance: float, max_steps: int = 4096) -> Motion:
    """Simulate one phase from rest at the path's start (`as_strong_array` by `arrays`)."""
    nodes = np.empty((max_steps + 1, 3))
    count, evaluations = loop(given, duration, method, tolerance, nodes)
    return Motion(nodes, count, evaluations)


@numba.njit(cache=True)
def _bend(polynomials, first, panels, low, high, s, w, tau1, tau2, duration):
    """`dw/du`."""
    share = (s - low) / (high - low) * panels
    local = min(max(int(np.floor(share)), 0), panels - 1)
    xi = 2 * (share - local) - 1
    rows = polynomials[first + local]
    k = rows.shape[0] - 1
    c0, c1, c2, c3, c4 = rows[k, 0], rows[k, 1], rows[k, 2], rows[k, 3], rows[k, 4]
    for k in range(rows.shape[0] - 2, -1, -1):
        c0 = rows[k, 0] + xi * c0
        c1 = rows[k, 1] + xi * c1
        c2 = rows[k, 2] + xi * c2
        c3 = rows[k, 3] + xi * c3
        c4 = rows[k, 4] + xi * c4
    return duration**2 * (c0 + c3 * tau1 + c4 * tau2) + duration * c2 * w + c1 * w**2


@numba.njit(cache=True)
def _step(polynomials, segment, torque, duration, method, share, s, w, length, ks, kw):
    """One step; the stages' slopes stand in `ks`, `kw`, the first of them already. Returns `s`, `w`, errors."""
    first, panels, low, high = segment
    tau1, tau2, rate1, rate2, begin = torque
    stages = method.b.shape[0]
    for i in range(1, stages):
        s_i, w_i = 0.0, 0.0
        for j in range(i):
            s_i += method.a[i, j] * ks[j]
            w_i += method.a[i, j] * kw[j]
        s_i, w_i = s + length * s_i, w + length * w_i
        ago = share + method.c[i] * length - begin
        ks[i] = w_i
        kw[i] = _bend(polynomials, first, panels, low, high, s_i, w_i, tau1 + rate1 * ago, tau2 + rate2 * ago, duration)
    rise_s, rise_w, miss_s, miss_w = 0.0, 0.0, 0.0, 0.0
    for j in range(stages):
        rise_s += method.b[j] * ks[j]
        rise_w += method.b[j] * kw[j]
        miss_s += method.error[j] * ks[j]
        miss_w += method.error[j] * kw[j]
    return s + length * rise_s, w + length * rise_w, length * miss_s, length * miss_w


@numba.njit(cache=True)
def loop(given, duration, method, tolerance, nodes):
    """Fill `nodes` with accepted steps; return how many, and the number of evaluations."""
    polynomials, starts, sizes, breaks, factor, segments, knots, values, slopes, row, last_row = given
    stages = method.b.shape[0]
    ks, kw = np.empty(stages), np.empty(stages)
    share, s, w, segment, count, evaluations = 0.0, breaks[0], 0.0, 0, 0, 0
    length, fresh = 1 / 32, True
    nodes[0] = share, s, w
    while share < 1.0 and count < nodes.shape[0] - 1:
        while row < last_row and knots[row + 1] <= share:
            row += 1
            fresh = True
        torque = (values[row, 0], values[row, 1], slopes[row, 0], slopes[row, 1], knots[row])
        here = (starts[segment], sizes[segment], breaks[segment], breaks[segment + 1])
        if fresh:
            ago = share - torque[4]
            tau1, tau2 = torque[0] + torque[2] * ago, torque[1] + torque[3] * ago
            ks[0] = w
            kw[0] = _bend(polynomials, here[0], here[1], here[2], here[3], s, w, tau1, tau2, duration)
            evaluations += 1
        goal = min(knots[row + 1], 1.0)
        # A step that would all but reach the knot ends on it.
        ends = share + length >= goal
        taken = goal - share if ends else length
        s_new, w_new, miss_s, miss_w = _step(polynomials, here, torque, duration, method, share, s, w, taken, ks, kw)
        evaluations += stages - 1
        scaled_s = miss_s / (tolerance * (1 + max(abs(s), abs(s_new))))
        scaled_w = miss_w / (tolerance * (1 + max(abs(w), abs(w_new))))
        error = np.sqrt((scaled_s**2 + scaled_w**2) / 2)
        grow = min(10.0, max(0.2, 0.9 * max(error, 1e-30) ** (-1 / method.order)))
        if error > 1:
            length, fresh = taken * grow, False
            continue
        if s_new > breaks[segment + 1] or w_new < 0:
            fitted, used = _land(polynomials, here, torque, duration, method, (share, s, w), taken, s_new, ks, kw)
            evaluations += used
            share, s, w = fitted
            count += 1
            nodes[count] = share, s, w
            if w <= 0 or segment + 1 >= segments:
                break
            s = breaks[segment + 1]
            segment += 1
            w *= factor[segment]
            fresh = True
            continue
        share, s, w = (goal if ends else share + taken), s_new, w_new
        count += 1
        nodes[count] = share, s, w
        # A step cut short by a knot says little about the length that the error allows: keep the longer.
        length = max(taken * grow, length) if ends else taken * grow
        fresh = not method.first_same_as_last
        if not fresh:
            ks[0], kw[0] = ks[stages - 1], kw[stages - 1]
    return count, evaluations


@numba.njit(cache=True)
def _land(polynomials, segment, torque, duration, method, node, longest, s_end, ks, kw):
    """Newton's method on the length of the step from `node` that ends on the piece's end, or at rest."""
    share, s, w = node
    high = segment[3]
    passed = s_end > high
    length = longest / 2
    stages, used = method.b.shape[0], 0
    for _ in range(20):
        s_new, w_new, _, _ = _step(polynomials, segment, torque, duration, method, share, s, w, length, ks, kw)
        ago = share + length - torque[4]
        tau1, tau2 = torque[0] + torque[2] * ago, torque[1] + torque[3] * ago
        bend = _bend(polynomials, segment[0], segment[1], segment[2], high, s_new, w_new, tau1, tau2, duration)
        used += stages
        change = (high - s_new) / w_new if passed else -w_new / bend
        length = min(max(length + change, 0.0), longest)
        if abs(change) < 1e-15:
            break
    return (share + length, high if passed else s_new, w_new if passed else 0.0), used
