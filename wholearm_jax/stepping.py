"""Steps: how a motion is integrated, and the controllers that choose its steps."""

from collections.abc import Callable
from dataclasses import replace

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float

ADJOINTS = {
    "none": dfx.DirectAdjoint(),
    "both": dfx.DirectAdjoint(),  # forward and reverse mode
    "forward": dfx.ForwardMode(),
    "reverse": dfx.RecursiveCheckpointAdjoint(),
}


class Integration(eqx.Module):
    """How to integrate: diffrax solver, error `tolerance` a step (relative, of the wire's scale), limits, adjoint.

    `steps` says that the torque schedule has steps inside the phase. `adjoint` says what the solve will be
    differentiated by: `"none"`, `"forward"`, `"reverse"` or `"both"`. For all but the first the steps are found
    once by the adaptive controller and taken again as they are. Differentiating saved steps through rejected ones in
    reverse mode gives wrong derivatives (seen with diffrax 0.7.2), and forward mode through the controller erratic ones
    (off by up to 3 % at any tolerance). All but a `tolerance`
    that is an array is static: each choice is a program of its own. The package's own programs get theirs as data.
    """

    solver: dfx.AbstractSolver = eqx.field(static=True, default=dfx.Dopri8())
    tolerance: float | Float[Array, ""] = 1e-10
    max_steps: int = eqx.field(static=True, default=256)
    stages: int = eqx.field(static=True, default=8)
    steps: bool = eqx.field(static=True, default=False)
    adjoint: str = eqx.field(static=True, default="none")


def tolerance_as_data(how: Integration, dtype) -> Integration:
    """The same integration, with a tolerance that is an array: all tolerances share a program."""
    return replace(how, tolerance=jnp.asarray(how.tolerance, dtype))


def adaptive(how: Integration, way, knots) -> dfx.AbstractStepSizeController:
    """Steps by their error that end on the torque's knots; `way` is what is left of the piece."""
    errors = dfx.PIDController(rtol=how.tolerance, atol=how.tolerance)
    errors = _FirstStep(controller=errors, way=way, rtol=how.tolerance, atol=how.tolerance, norm=errors.norm)
    return dfx.ClipStepSizeController(errors, step_ts=knots, jump_ts=knots if how.steps else None)


def repeated(how: Integration, ends, knots, begin, final) -> dfx.AbstractStepSizeController:
    """Steps that were found from `begin` to `final`, taken again; those that end on a knot move with it."""
    ends = _continued(ends, begin, final)
    # Where the torque may step a step ends before the knot (diffrax has told the time behind it), and the next begins
    # behind it.
    knot = knots[jnp.argmin(jnp.abs(ends[:, None] - stop_gradient(knots)), axis=1)]
    fixed = stop_gradient(knot)
    on_knot = jnp.abs(ends - fixed) < 1e-13
    before, behind = (jnp.nextafter(fixed, way) if how.steps else ends for way in (-jnp.inf, jnp.inf))
    begins = jnp.where(on_knot, behind + (knot - fixed), ends)
    ends = jnp.where(on_knot, before + (knot - fixed), ends)
    return _Repeat(ends, begins, how.steps)


class _FirstStep(dfx.AbstractAdaptiveStepSizeController):
    """A controller whose first step is a 32nd of the phase, or half of the way to the piece's end at its speed.

    diffrax would check a first step passed to `diffeqsolve` by a host callback, and programs that call back to the
    host are not kept in JAX's compilation cache.
    """

    controller: dfx.PIDController
    way: Float[Array, ""]
    rtol: float | Array
    atol: float | Array
    norm: Callable

    def wrap(self, direction):
        inner = self.controller.wrap(direction)
        return _FirstStep(controller=inner, way=self.way, rtol=self.rtol, atol=self.atol, norm=self.norm)

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        speed = stop_gradient(y0[1])
        half = jnp.where(speed > 0, self.way / jnp.where(speed > 0, 2 * speed, 1.0), 1.0)
        first = jnp.clip(half, jnp.finfo(half.dtype).eps, 1 / 32)
        return self.controller.init(terms, t0, t1, y0, first, args, func, error_order)

    def adapt_step_size(self, *at):
        return self.controller.adapt_step_size(*at)


class _Repeat(dfx.AbstractStepSizeController):
    """Takes given steps and rejects none: step `i` ends at `ends[i]`, the next begins at `begins[i]`.

    With `jumps` the field may jump between steps: what the last stage of one found serves no longer for the next.
    """

    ends: Float[Array, "steps"]
    begins: Float[Array, "steps"]
    jumps: bool = eqx.field(static=True)

    def wrap(self, direction):
        return self

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        return self.ends[0], jnp.asarray(1, int)

    def adapt_step_size(self, t0, t1, y0, y1, args, y_error, error_order, state):
        following = self.ends[jnp.minimum(state, self.ends.shape[0] - 1)]
        jumped = jnp.asarray(True) if self.jumps else False  # diffrax takes a constant `True` for its initial `False`
        return True, self.begins[state - 1], following, jumped, state + 1, dfx.RESULTS.successful


def _continued(ends, begin, final):
    """Times of steps, with one as long as the last one after it and then `final` instead of infinite ones.

    A batch goes on until its last member has finished: the others take steps that do not count, but that must be
    harmless. One straight to the end of time would overflow, and what overflows has no derivative, not even zero.
    """
    taken = jnp.isfinite(ends).sum()
    last, before = ends[taken - 1], jnp.where(taken > 1, ends[taken - 2], begin)
    one_more = (jnp.arange(ends.shape[0]) == taken) & (taken > 0)
    return jnp.where(jnp.isfinite(ends), ends, jnp.where(one_more, jnp.minimum(2 * last - before, final), final))
