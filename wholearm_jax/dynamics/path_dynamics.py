"""The dynamics along a path as tables: a polynomial on each panel for every function of `s`.

The path acceleration `a = dv/dt` and the contact forces are linear in `(1, v^2, v, tau1, tau2)`; for forward travel
their coefficients are functions of `s` alone. Derivation: section 4 of `docs/derivation.md`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.core import as_device_array, take_row
from wholearm_jax.dynamics.polynomials import evaluate_polynomial, evaluate_polynomial_dot
from wholearm_jax.tracing import Resolution

TERMS = 5  # 1, v^2, v, tau1, tau2


class PathDynamics(eqx.Module):
    """Path-parameterised dynamics of one formation in SI units, for forward travel.

    Segments are numbered as those of the `ContactPath`. Polynomials are in the panel coordinate `xi` in [-1, 1], lowest
    power first. Rows of forces are the constraints' `c_n`, or `c_t` where `tangential`. The reverse
    acceleration is that at rest with the friction of travel backward, times the squared ratio of the determinants with
    and without friction: the same sign, and smooth where friction would wedge the object on its way back.
    """

    # segments and their panels
    breakpoints: Float[Array, "segments_1"]  # `s` of the start, the kinks and the end
    count: Int[Array, ""]  # number of segments
    speed_ratio: Float[Array, "segments"]  # ds/dt after entering a segment against that before
    first: Int[Array, "segments"]  # first panel of each segment
    panels: Int[Array, "segments"]  # number of panels of each segment

    # functions of `s`
    acceleration: Float[Array, "panels powers 5"]  # ds^2/dt^2 [1/s^2], terms (1, v^2, v, tau1, tau2)
    reverse_acceleration: Float[Array, "panels powers 3"]  # scaled, terms (1, tau1, tau2)
    force: Float[Array, "panels powers rows 5"]  # [N], terms as those of `acceleration`
    configuration: Float[Array, "panels powers 5"]  # z [m, rad]
    velocity: Float[Array, "panels powers 5"]  # dz/ds

    # friction
    friction_ratio: Float[Array, "segments rows"]  # c_t / c_n of sliding contacts (eq. 3)
    tangential: Bool[Array, "rows"]  # whether a row is the tangential one of a rolling contact
    rolling_friction: Float[Array, "rows"]  # friction coefficient in tangential rows, else 0

    # transitions and limits
    impact_map: Float[Array, "5 5"]  # from `z_dot` before an impact to (ds/dt, impulses [N s]) after it
    contact_inertia: Float[Array, "rows rows"]  # impulses for a speed of one gap (column) at the path's start [kg]
    torque_limit: Float[Array, "2"]  # [N m]
    ends_at_obstacle: Bool[Array, ""]  # whether links meet, or a joint's range ends, at the path's end

    # quality
    error: Float[Array, ""]  # largest interpolation error, relative to each function's size
    condition: Float[Array, ""]  # largest condition number of the equations of motion
    status: Int[Array, ""]  # a `Status`

    @property
    def length(self) -> Float[Array, "*lanes"]:
        """The path's extent in `s`."""
        return self.breakpoints[..., -1] - self.breakpoints[..., 0]

    def range(self) -> tuple[float, float]:
        """Return where the path begins in `s`, and its extent, as numbers."""
        breakpoints = np.asarray(self.breakpoints)
        return float(breakpoints[0]), float(breakpoints[-1] - breakpoints[0])


def locate_panel(
    dynamics: PathDynamics, segment: int | Int[Array, ""], s: float | Float[Array, ""]
) -> tuple[Int[Array, ""], Float[Array, ""]]:
    """Find the panel of a segment nearest to `s`, and the panel coordinate `xi` of `s`.

    Outside the segment the end panel extrapolates, by at most one panel width: rejected steps, and intervals of an
    optimisation that has not converged, evaluate there.
    """
    low, high, panels = (
        take_row(dynamics.breakpoints, segment),
        take_row(dynamics.breakpoints, segment + 1),
        take_row(dynamics.panels, segment),
    )
    width = jnp.where(high > low, high - low, 1.0)
    position = (s - low) / width * panels
    panel = jnp.clip(jnp.floor(jax.lax.stop_gradient(position)), 0, jnp.maximum(panels - 1, 0))
    return take_row(dynamics.first, segment) + panel.astype(int), jnp.clip(2 * (position - panel) - 1, -3.0, 3.0)


def evaluate(
    coefficients: Float[Array, "panels powers *shape"], panel: Int[Array, ""], xi: Float[Array, ""]
) -> Float[Array, "*shape"]:
    """Evaluate a function of a `PathDynamics` at the place given by `locate_panel`."""
    return evaluate_polynomial(take_row(coefficients, panel), xi)


def evaluate_dot(
    coefficients: Float[Array, "panels powers *rows terms"], panel: Int[Array, ""], xi, terms: Float[Array, "terms"]
) -> Float[Array, "*rows"]:
    """Evaluate a function of a `PathDynamics` times `terms` at the place given by `locate_panel`."""
    return evaluate_polynomial_dot(take_row(coefficients, panel), xi, terms)


def placeholder_dynamics(resolution: Resolution, contacts: int = 4) -> PathDynamics:
    """Make path dynamics of the right shapes without content, for ahead-of-time compilation."""
    segments, panels, nodes, _ = resolution
    zero, whole, one = as_device_array(0.0), as_device_array(0), as_device_array(1)
    fields = {name: np.zeros((panels, nodes, n)) for name, n in (("acceleration", 5), ("reverse_acceleration", 3))}
    fields |= {name: np.zeros((panels, nodes, 5)) for name in ("configuration", "velocity")}
    fields |= {"force": np.zeros((panels, nodes, contacts, TERMS)), "friction_ratio": np.zeros((segments, contacts))}
    fields |= {"breakpoints": np.arange(segments + 1.0), "speed_ratio": np.ones(segments), "torque_limit": np.ones(2)}
    fields |= {"tangential": np.zeros(contacts, bool), "rolling_friction": np.zeros(contacts)}
    fields |= {
        "impact_map": np.zeros((5, 5)),
        "contact_inertia": np.eye(contacts),
        "first": np.zeros(segments, int),
        "panels": np.ones(segments, int),
    }
    fields |= {"ends_at_obstacle": np.asarray(False)}
    arrays = {name: as_device_array(value) for name, value in fields.items()}
    return PathDynamics(count=one, error=zero, condition=zero, status=whole, **arrays)
