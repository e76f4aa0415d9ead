"""Tables along a path: the curve of joint angles by its length, and the equations of motion in that measure."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from wholearm_jax.dynamics import PathDynamics, evaluate, locate_panel
from wholearm_jax.margin import cone_facets

NODES = 300  # of a path, those of each segment evenly spaced
STANDING_STILL = 1e-3  # how fast the joints move along a path, over the fastest, where they count as standing still


class PathTable(NamedTuple):
    """A path at its nodes. `s` [rad] is the length of the curve of joint angles from the start."""

    segment: Int[np.ndarray, "nodes"]
    parameter: Float[np.ndarray, "nodes"]  # of the path dynamics, in the segment's own unit
    unit: Float[np.ndarray, "nodes"]  # d parameter / ds
    s: Float[np.ndarray, "nodes"]
    theta: Float[np.ndarray, "nodes 2"]  # joint angles [rad]
    tangent: Float[np.ndarray, "nodes 2"]  # of unit length


class PathTerms(NamedTuple):
    """Acceleration of `s` and slacks of forces, linear in `(1, v^2, v, tau1, tau2)` for forward travel."""

    acceleration: Float[np.ndarray, "nodes 5"]  # [rad/s^2]
    slack: Float[np.ndarray, "nodes facets 5"]  # [N]

    def at(self, nodes: Int[np.ndarray, "places"]) -> "PathTerms":
        """Take the terms of some nodes."""
        return PathTerms(self.acceleration[nodes], self.slack[nodes])


def tabulate_path(dynamics: PathDynamics, nodes: int = NODES) -> PathTable:
    """Tabulate a path over the length of its curve of joint angles.

    Raises:
        ValueError: Where both joints stand still: their angles do not say where the object is.
    """
    count = int(dynamics.count)
    breakpoints = np.asarray(dynamics.breakpoints)[: count + 1]
    length = np.diff(breakpoints)
    each = np.maximum(2, np.round(nodes * length / length.sum()).astype(int))
    inset = 1e-9 * length  # nodes on both sides of a kink stand apart
    parts = [np.linspace(breakpoints[k] + inset[k], breakpoints[k + 1] - inset[k], each[k]) for k in range(count)]
    segment, parameter = np.repeat(np.arange(count), each), np.concatenate(parts)
    z, x = jax.device_get(_geometry(dynamics, jnp.asarray(segment), jnp.asarray(parameter)))
    rate = np.hypot(*x[:, 3:].T)
    if not rate.min() > STANDING_STILL * rate.max():
        first, second = np.degrees(z[rate.argmin(), 3:])
        raise ValueError(
            f"both joints stand still where theta1 is {first:.1f} deg and theta2 {second:.1f} deg, so that their angles"
            " do not say where the object is: no law can follow its path"
        )
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(z[:, 3:], axis=0).T))])
    return PathTable(segment, parameter, 1 / rate, s, z[:, 3:], x[:, 3:] / rate[:, None])


def path_terms(dynamics: PathDynamics, table: PathTable) -> PathTerms:
    """Evaluate the equations of motion at the nodes of a table; `dynamics` may be those of another friction or mass."""
    acceleration, slack = jax.device_get(_terms(dynamics, jnp.asarray(table.segment), jnp.asarray(table.parameter)))
    # From the path parameter p to s: with u = dp/ds, p' = u v and p'' = u a + u' v^2.
    u = table.unit[:, None]
    bend = _derivative(table, table.unit)
    acceleration = acceleration * np.array([1.0, 0.0, 0.0, 1.0, 1.0]) / u + np.stack(
        [0 * bend, acceleration[:, 1] * u[:, 0] - bend / u[:, 0], acceleration[:, 2], 0 * bend, 0 * bend], axis=1
    )
    speeds = np.stack(
        [np.ones_like(table.s), table.unit**2, table.unit, np.ones_like(table.s), np.ones_like(table.s)], 1
    )
    return PathTerms(acceleration, slack * speeds[:, None, :])


def terms_of_other_shape(dynamics: PathDynamics, table: PathTable) -> PathTerms:
    """Evaluate the equations of motion of an object of another shape where its path is nearest to a table's nodes.

    Its joint angles follow another curve, of which lengths are taken for those of the table.
    """
    own = tabulate_path(dynamics)
    apart = table.theta[:, None, :] - own.theta[None]
    return path_terms(dynamics, own).at((apart**2).sum(2).argmin(1))


def _derivative(table: PathTable, values) -> Float[np.ndarray, "nodes"]:
    """Differentiate by `s` within each segment."""
    found = np.empty_like(values)
    for k in np.unique(table.segment):
        rows = table.segment == k
        found[rows] = np.gradient(values[rows], table.s[rows], edge_order=2 if rows.sum() > 2 else 1)
    return found


@jax.jit
def _geometry(dynamics: PathDynamics, segment, parameter):
    def at(segment, p):
        panel, xi = locate_panel(dynamics, segment, p)
        return evaluate(dynamics.configuration, panel, xi), evaluate(dynamics.velocity, panel, xi)

    return jax.vmap(at)(segment, parameter)


@jax.jit
def _terms(dynamics: PathDynamics, segment, parameter):
    def at(segment, p):
        panel, xi = locate_panel(dynamics, segment, p)
        return evaluate(dynamics.acceleration, panel, xi), cone_facets(dynamics, evaluate(dynamics.force, panel, xi))

    return jax.vmap(at)(segment, parameter)


def with_facets(slack: Float[np.ndarray, "nodes facets 5"], count: int) -> Float[np.ndarray, "nodes count 5"]:
    """Repeat the last facet until there are `count`, as formations of fewer contacts have fewer."""
    return np.take(slack, np.arange(count), axis=1, mode="clip")
