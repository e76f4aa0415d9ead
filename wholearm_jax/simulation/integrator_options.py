"""Options of the integrator: solver, tolerance, limits, and what derivatives are for."""

import enum
from dataclasses import replace
from typing import Literal

import diffrax as dfx
import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from wholearm_jax.core import as_strong_array
from wholearm_jax.model import round_up

LoopKind = Literal["lax", "bounded"]


class Adjoint(enum.Enum):
    """What a motion will be differentiated by.

    Steps are chosen first, by their errors, and then differentiated as they are. Through rejected steps reverse mode
    gives wrong derivatives (seen with diffrax 0.7.2), and through the choice of steps forward mode erratic ones.
    """

    NONE = "none"
    FORWARD = "forward"  # forward mode
    REVERSE = "reverse"  # reverse mode that keeps one state a step and computes each step again on the way back
    BOTH = "both"  # either mode; keeps the states at every stage of every step

    @property
    def loop_kind(self) -> LoopKind:
        """Equinox's kind of loop that passes this mode."""
        return "bounded" if self in (Adjoint.REVERSE, Adjoint.BOTH) else "lax"


class IntegratorOptions(eqx.Module):
    """Options of the integrator.

    All but a tolerance that is an array are static: each choice compiles a program of its own.
    """

    solver: dfx.AbstractSolver = eqx.field(static=True, default=dfx.Dopri8())
    tolerance: float | Float[Array | np.ndarray, ""] = 1e-10  # error of a step, relative and in `s` absolute
    max_steps: int = eqx.field(static=True, default=256)  # of a phase
    max_stages: int = eqx.field(static=True, default=8)  # smooth stages of a phase
    has_jumps: bool = eqx.field(static=True, default=False)  # whether the torque jumps inside the phase
    adjoint: Adjoint = eqx.field(static=True, default=Adjoint.NONE, converter=Adjoint)  # or its value, a word


def options_with_steps(max_steps: int, **others) -> IntegratorOptions:
    """Return options with capacity for so many steps a phase, and for as many smooth stages as go with them."""
    return IntegratorOptions(max_steps=max_steps, max_stages=max(8, max_steps // 32), **others)


def tolerance_as_data(options: IntegratorOptions, dtype) -> IntegratorOptions:
    """Return the options with a tolerance that is an array: all tolerances share a program."""
    tolerance = as_strong_array(options.tolerance, dtype)
    return options if tolerance is options.tolerance else replace(options, tolerance=tolerance)


def with_step_capacity(options: IntegratorOptions, rows: int) -> IntegratorOptions:
    """Return the options with capacity for two steps at each of so many rows of a schedule."""
    return replace(options, max_steps=round_up(2 * max(rows, 1), options.max_steps))


def differentiable_solver(options: IntegratorOptions) -> dfx.AbstractSolver:
    """Return the solver with a loop over its stages that can be differentiated as the options say."""
    return solver_with_loop(options.solver, options.adjoint.loop_kind)


def solver_with_loop(solver: dfx.AbstractSolver, kind: LoopKind) -> dfx.AbstractSolver:
    """Return the solver with a loop of this kind over its stages."""
    return eqx.tree_at(lambda s: s.scan_kind, solver, kind, is_leaf=lambda x: x is None)
