"""Linear programmes by blocks: the matrices of scipy's solver, written out, and known optima."""

import numpy as np
import pytest
from scipy.optimize import linprog

from wholearm_jax.core import LinearProgramme


def test_blocks_make_the_programme_that_is_written_out_as_matrices():
    rng = np.random.default_rng(4)
    a, b, c, e = rng.normal(size=(5, 3)), rng.normal(size=(5, 2)), rng.normal(size=(4, 2)), rng.normal(size=(1, 3))
    programme = LinearProgramme()
    programme.add_variables("x", -np.ones(3), np.ones(3))
    programme.add_variables("y", -2.0 * np.ones(2), 2.0)
    programme.add_variables("level", -np.inf, np.inf)
    programme.at_most("both", np.ones(5), x=a, y=b, level=1.0)
    programme.at_least("second", -np.ones(4), y=c, level=np.arange(4.0))
    programme.equal("first", [0.1], x=e)
    answer = linprog(
        [0.0] * 5 + [-1.0],
        A_ub=np.block([[a, b, np.ones((5, 1))], [np.zeros((4, 3)), -c, -np.arange(4.0)[:, None]]]),
        b_ub=np.ones(9),
        A_eq=np.hstack([e, np.zeros((1, 3))]),
        b_eq=[0.1],
        bounds=[(-1, 1)] * 3 + [(-2, 2)] * 2 + [(None, None)],
    )
    solution = programme.maximise("level")
    np.testing.assert_allclose(np.concatenate([*solution.values.values()]), answer.x, atol=1e-9)
    np.testing.assert_allclose(solution.multipliers["both"], -answer.ineqlin.marginals[:5], atol=1e-9)
    np.testing.assert_allclose(solution.multipliers["second"], -answer.ineqlin.marginals[5:], atol=1e-9)


def test_bounds_that_are_changed_hold_in_the_next_solution():
    programme = LinearProgramme()
    programme.add_variables("x", 0.0, 2.0)
    programme.add_variables("y", 0.0, np.inf)
    programme.at_most("sum", [3.0], x=1.0, y=1.0)
    assert programme.maximise("y").values["y"] == pytest.approx(3.0)
    programme.set_bounds("x", 1.5, 2.0)
    solution = programme.maximise("y")
    assert solution.values["y"] == pytest.approx(1.5)
    assert solution.multipliers["sum"] == pytest.approx(1.0)
    assert programme.minimise("y").values["y"] == pytest.approx(0.0)


def test_rows_that_contradict_one_another_have_no_solution():
    programme = LinearProgramme()
    programme.add_variables("x", 0.0, 1.0)
    programme.at_least("high", [2.0], x=1.0)
    assert programme.maximise("x") is None


def test_a_block_of_no_rows_and_programmes_without_inequalities():
    programme = LinearProgramme()
    programme.add_variables("x", np.zeros(2), 1.0)
    programme.equal("sum", [0.5], x=np.ones((1, 2)))
    assert programme.maximise("x").values["x"].sum() == pytest.approx(0.5)
    programme.at_most("none", np.zeros(0), x=np.zeros((0, 2)))
    assert programme.maximise("x").multipliers["none"].size == 0
