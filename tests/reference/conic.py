"""A path programme as a sparse conic programme, for solvers of other people: HiGHS, and Clarabel where time counts.

It shares the coefficients of the points with the package, nothing of the solver. Viscous torque is linear in `b` about
a given profile: at the optimum both programmes have the same conditions of optimality.
"""

import numpy as np
import scipy.sparse as sparse
from scipy.optimize import linprog


class ConicProgramme:
    """Rows of `A x <= c`, `A x = c` and of second-order cones in the unknowns `b, tau1, tau2, m, v, times`."""

    def __init__(self, programme, profile) -> None:
        self.p = {name: np.asarray(value) for name, value in vars(programme).items()}
        self.n, self.points = len(self.p["width"]), len(self.p["s"])
        sizes = [self.n + 1, self.points, self.points, 1, self.n + 1, self.n]
        self.b, self.tau1, self.tau2, self.m, self.v, self.time = np.cumsum([0, *sizes[:-1]])
        self.size = sum(sizes)
        self.profile = np.asarray(profile)
        self.upper, self.equal, self.cones = [], [], []
        for point in range(self.points):
            if self.p["is_live"][point]:
                self._point(point)
        for k in range(self.n + 1):
            if self.p["is_fixed"][k]:
                self.equal += [({k: 1.0}, self.p["end_b"][k]), ({self.v + k: 1.0}, self.p["end_b"][k] ** 0.5)]
            else:
                self.upper += [({k: -1.0}, 0.0), ({k: 1.0}, self.p["cap"][k])]

    def _affine(self, point, terms):
        """`c0 + cb b + c1 tau1 + c2 tau2` at a point as coefficients."""
        ends = (point, point + 1) if point < self.n else (self.p["side_node"][point - self.n],) * 2
        row = {self.tau1 + point: terms[2], self.tau2 + point: terms[3]}
        for k in ends:
            row[k] = row.get(k, 0.0) + terms[1] / 2
        return row, ends

    def _point(self, point) -> None:
        acceleration = self.p["acceleration"][:, point]
        for force in self.p["force"][:, :, point]:
            row, _ = self._affine(point, -force)
            self.upper.append((row | {self.m: 1.0}, force[0]))
        row, ends = self._affine(point, -acceleration)
        if point < self.n:
            for k, sign in zip(ends, (-1, 1), strict=True):
                row[k] += sign / (2 * self.p["width"][point])
            self.equal.append((row, acceleration[0]))
        elif sign := self.p["side_sign"][point - self.n]:
            self.upper.append(({k: sign * value for k, value in row.items()}, sign * acceleration[0]))
        at = max(np.mean([self.profile[k] for k in ends]), 0.0)
        for joint, tau in enumerate((self.tau1, self.tau2)):
            drag = self.p["viscous"][joint, point]
            slope = drag / (2 * at**0.5) if at > 0 else 0.0
            for sign in (1, -1):
                row = {tau + point: float(sign)}
                for k in ends:
                    row[k] = row.get(k, 0.0) + sign * slope / 2
                self.upper.append((row, 1 - sign * drag * at**0.5 + sign * slope * at))

    def _matrix(self, rows):
        data = [(k, column, value) for k, (row, _) in enumerate(rows) for column, value in row.items()]
        k, column, value = zip(*data, strict=True)
        return sparse.csc_matrix((value, (k, column)), shape=(len(rows), self.size))

    def largest_margin_at_any_time(self) -> float:
        """By HiGHS."""
        cost = np.zeros(self.size)
        cost[self.m] = -1.0
        answer = linprog(
            cost,
            A_ub=self._matrix(self.upper),
            b_ub=[c for _, c in self.upper],
            A_eq=self._matrix(self.equal),
            b_eq=[c for _, c in self.equal],
            bounds=(None, None),
        )
        assert answer.status == 0
        return -answer.fun

    def solve_with_time(self, margin: float | None = None) -> float:
        """Largest margin in the programme's duration, or shortest time with a `margin`: by Clarabel."""
        import clarabel

        upper, equal, cost = list(self.upper), list(self.equal), np.zeros(self.size)
        if margin is None:
            cost[self.m] = -1.0
            upper.append(({self.time + k: 1.0 for k in range(self.n)}, float(self.p["duration"])))
        else:
            cost[self.time :] = 1.0
            equal.append(({self.m: 1.0}, margin))
        cones = []
        for k in np.flatnonzero(~self.p["is_fixed"]):  # v^2 <= b
            cones += [({k: -0.5}, 0.5), ({k: -0.5}, -0.5), ({self.v + k: -1.0}, 0.0)]
        for k, width in enumerate(self.p["width"]):  # time (v + v') >= 2 h
            sides = {self.v + k: 1.0, self.v + k + 1: 1.0}
            cones += [
                ({key: -value for key, value in sides.items()} | {self.time + k: -1.0}, 0.0),
                (sides | {self.time + k: -1.0}, 0.0),
                ({}, (8 * width) ** 0.5),
            ]
        rows = [*equal, *upper, *cones]
        kinds = [clarabel.ZeroConeT(len(equal)), clarabel.NonnegativeConeT(len(upper))]
        kinds += [clarabel.SecondOrderConeT(3)] * (len(cones) // 3)
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-9
        empty = sparse.csc_matrix((self.size, self.size))
        constants = np.array([c for _, c in rows])
        answer = clarabel.DefaultSolver(empty, cost, self._matrix(rows), constants, kinds, settings).solve()
        assert "Solved" in str(answer.status)
        return answer.obj_val if margin is not None else -answer.obj_val
