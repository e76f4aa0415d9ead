"""Linear programmes that are built from named blocks of variables and of rows."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

LINPROG_OPTIONS = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}


class LinearProgrammeSolution(NamedTuple):
    """An optimum: values by block of variables, and multipliers (not negative) by block of inequalities."""

    values: dict[str, Float[np.ndarray, "size"]]
    multipliers: dict[str, Float[np.ndarray, "rows"]]


class _Rows(NamedTuple):
    """Rows `sum of coefficients[name] @ x[name]`, at most or equal to a right-hand side."""

    name: str
    right: Float[np.ndarray, "rows"]
    coefficients: dict[str, Float[np.ndarray, "rows size"]]


class LinearProgramme:
    """A linear programme whose variables and rows keep the order in which they are added.

    >>> import numpy as np
    >>> from wholearm_jax.core import LinearProgramme
    >>> programme = LinearProgramme()
    >>> programme.add_variables("x", [0.0, 0.0], [2.0, 2.0])
    >>> programme.add_variables("level", 0.0, np.inf)
    >>> programme.at_most("sum", [3.0], x=np.ones((1, 2)), level=1.0)
    >>> programme.at_most("below", [0.0, 0.0], x=-np.eye(2), level=1.0)
    >>> [float(programme.maximise("level").values["level"][0])]
    [1.0]
    """

    def __init__(self) -> None:
        self._bounds: dict[str, Float[np.ndarray, "size 2"]] = {}
        self._at_most: list[_Rows] = []
        self._equal: list[_Rows] = []

    def add_variables(self, name: str, lower, upper) -> None:
        """Add a block of variables within bounds (infinite: none)."""
        self.set_bounds(name, lower, upper)

    def set_bounds(self, name: str, lower, upper) -> None:
        """Change the bounds of a block of variables."""
        self._bounds[name] = np.stack(np.broadcast_arrays(*map(np.atleast_1d, (lower, upper))), axis=1).astype(float)

    def at_most(self, name: str, right, **coefficients) -> None:
        """Add the rows `sum of coefficients[block] @ x[block] <= right`.

        A coefficient is a matrix; that of a block of one variable may be a vector or a number.
        """
        self._at_most.append(_rows(name, right, coefficients))

    def at_least(self, name: str, right, **coefficients) -> None:
        """Add the rows `sum of coefficients[block] @ x[block] >= right`."""
        self.at_most(name, -np.asarray(right), **{block: -np.asarray(a) for block, a in coefficients.items()})

    def equal(self, name: str, right, **coefficients) -> None:
        """Add the rows `sum of coefficients[block] @ x[block] = right`."""
        self._equal.append(_rows(name, right, coefficients))

    def maximise(self, name: str) -> LinearProgrammeSolution | None:
        """Maximise the sum of a block; returns None where no values satisfy all rows."""
        return self._solve(name, -1.0)

    def minimise(self, name: str) -> LinearProgrammeSolution | None:
        """Minimise the sum of a block; returns None where no values satisfy all rows."""
        return self._solve(name, 1.0)

    def _solve(self, name: str, sign: float) -> LinearProgrammeSolution | None:
        from scipy.optimize import linprog  # imported here: it takes long to import, and most plans need none

        ends = np.cumsum([0, *map(len, self._bounds.values())]).tolist()
        columns = {block: slice(*ends[k : k + 2]) for k, block in enumerate(self._bounds)}
        cost = np.zeros(ends[-1])
        cost[columns[name]] = sign
        answer = linprog(
            cost,
            *_assemble(self._at_most, columns, ends[-1]),
            *_assemble(self._equal, columns, ends[-1]),
            bounds=np.concatenate([*self._bounds.values()]),
            options=LINPROG_OPTIONS,
        )
        if answer.status != 0:
            return None
        ends = np.cumsum([len(rows.right) for rows in self._at_most])
        return LinearProgrammeSolution(
            {block: answer.x[at] for block, at in columns.items()},
            {
                rows.name: -answer.ineqlin.marginals[end - len(rows.right) : end]
                for rows, end in zip(self._at_most, ends, strict=True)
            },
        )


def _rows(name: str, right, coefficients) -> _Rows:
    right = np.asarray(right, float)

    def matrix(a):
        a = np.asarray(a, float)
        return a if a.ndim == 2 else np.broadcast_to(a, right.shape)[:, None]

    return _Rows(name, right, {block: matrix(a) for block, a in coefficients.items()})


def _assemble(groups: list[_Rows], columns: dict[str, slice], size: int):
    """Return the matrix and the right-hand side of all rows; None for both where there are none."""
    if not groups:
        return None, None
    matrix = np.zeros((sum(len(rows.right) for rows in groups), size))
    start = 0
    for rows in groups:
        end = start + len(rows.right)
        for block, a in rows.coefficients.items():
            matrix[start:end, columns[block]] = a
        start = end
    return matrix, np.concatenate([rows.right for rows in groups])
