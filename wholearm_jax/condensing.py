r"""Condense: how the states at the knots follow the torques and durations, as far as the intervals are linear.

Of the variables `p` of `shooting` only torques and log durations, `u`, are free. In the order of time each state
follows from those before it by one equation, that an interval joins or what an impact leaves of the speed. With the
derivatives `A` of these equations with respect to states and `B` with respect to `u`, and their defects `d`,

    x = F u + a,    F = -A^-1 B,    a = -A^-1 d

and `A` is triangular. A linear system in `p` and the price of every equation becomes one in `u`, a third of its size.

Source: H. G. Bock and K. J. Plitt, A multiple shooting algorithm for direct solution of optimal control problems, IFAC
World Congress 1984. Derivation: section 9 of `docs/derivation.md`.
"""

import functools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float, Int, Shaped

from wholearm_jax.linearisation import Linear, blocks, columns, gather, scattered, sizes

SPREAD = 1e-8  # price of the square of any change: what no room depends on stays where it is


class Order(NamedTuple):
    """By which equation (of `Linear.defect`) each state follows, which states are `given` and do not, which follow but
    must not change (`goals`), and which equations are of torques alone (`seams`)."""

    rows: Int[np.ndarray, "states"]
    given: Bool[np.ndarray, "states"]
    goals: Int[np.ndarray, "goals"]
    seams: slice


@functools.cache
def order(phases: int, knots: int) -> Order:
    """The same for all problems of a size."""
    joints = 2 * phases * (knots - 1)
    rows, given = np.zeros((phases, knots, 2), int), np.zeros((phases, knots, 2), bool)
    rows[:, 1:] = np.arange(joints).reshape(phases, knots - 1, 2)
    rows[1:, 0, 1] = joints + np.arange(phases - 1)
    given[:, 0, 0] = given[0, 0] = True
    ends = np.arange(rows.size).reshape(rows.shape)[:, -1]
    return Order(rows.ravel(), given.ravel(), np.append(ends[:, 0], ends[-1, 1]), slice(joints + phases - 1, None))


class Following(NamedTuple):
    """`x = matrix u + apart`, and `A`, a triangle. States that are given follow from nothing: `x = 0`."""

    matrix: Float[Array, "states u"]
    apart: Float[Array, "states"]
    triangle: Float[Array, "states states"]


def free(linear: Linear, values: Shaped[Array, "*rows p"]) -> Shaped[Array, "*rows u"]:
    """Of numbers that belong to all variables, those of torques and durations."""
    states = order(*sizes(linear)).rows.size
    return jnp.concatenate([values[..., :states], values[..., 2 * states :]], axis=-1)


def of_states(linear: Linear, values: Shaped[Array, "*rows p"]) -> Shaped[Array, "*rows states"]:
    """Of numbers that belong to all variables, those of states."""
    states = order(*sizes(linear)).rows.size
    return values[..., states : 2 * states]


def together(linear: Linear, u: Float[Array, "u"], x: Float[Array, "states"]) -> Float[Array, "p"]:
    """The changes of all variables from those of the free ones and of the states; what stays does."""
    return jnp.where(linear.still, 0.0, jnp.concatenate([u[: x.size], x, u[x.size :]]))


def following(linear: Linear) -> Following:
    """How states follow torques and durations, other than those that stay."""
    at = order(*sizes(linear))
    across, given = linear.across[at.rows], at.given[:, None]
    triangle = jnp.where(given, jnp.eye(at.rows.size), of_states(linear, across))
    by_free = jnp.where(given | free(linear, linear.still), 0.0, free(linear, across))
    apart = jnp.where(at.given, 0.0, linear.defect[at.rows])
    solved = -solve_triangular(triangle, jnp.column_stack([by_free, apart]), lower=True)
    return Following(solved[:, :-1], solved[:, -1], triangle)


def newton_step(linear: Linear, stiff, aim, damping) -> tuple[Float[Array, "p"], Float[Array, ""], Float[Array, "e"]]:
    """The steps of `p` and of the margin's level `m`, and the prices `y` of the equations that `p` must keep:

        (J^T S J + damping) p - J^T S b m + E^T y = J^T aim
        b^T S b m - b^T S J p = 1 - b^T aim,    E p = -defect

    with the derivatives `J` of all rooms and `E` of the equations, `S = diag(stiff)`, and 1 in `b` for rooms that the
    margin lowers. `damping` is a price of the step's size: it keeps steps small along ways that the loss hardly sees.
    """
    at, follow, price = order(*sizes(linear)), following(linear), damping + SPREAD
    bears, bends = linear.bears, blocks(linear, stiff)
    matrix = follow.matrix.at[at.goals].set(0.0)  # those are kept where they are

    def reduced(values: Float[Array, "p"]):
        return free(linear, values) + of_states(linear, values) @ matrix

    def bent(way: Float[Array, "p"]):
        return scattered(linear, jnp.einsum("pkij,pkj->pki", bends, way[columns(linear)])) + price * way

    pull, lean, still = gather(linear, aim), gather(linear, stiff * bears), free(linear, linear.still)
    apart = together(linear, jnp.zeros(still.size), follow.apart)
    curvature = jnp.where(still[:, None] | still, jnp.eye(still.size), _curvature(linear, bends, matrix, price))
    lower = reduced(lean)[None]
    keep = jnp.concatenate([follow.matrix[at.goals], jnp.where(still, 0.0, free(linear, linear.across[at.seams]))])
    defect = jnp.concatenate([follow.apart[at.goals], linear.defect[at.seams]])
    weight, none = (stiff * bears).sum(), jnp.zeros((defect.size, 1))
    system = jnp.block(
        [
            [curvature, -lower.T, keep.T],
            [-lower, weight[None, None], none.T],
            [keep, none, jnp.zeros((defect.size, defect.size))],
        ]
    )
    right = [reduced(pull - bent(apart)), (1 - (bears * aim).sum() + lean @ apart)[None], -defect]
    u, level, kept = jnp.split(jnp.linalg.solve(system, jnp.concatenate(right)), [still.size, still.size + 1])
    way, level = together(linear, u, follow.matrix @ u + follow.apart), level[0]
    push = of_states(linear, pull - bent(way) + level * lean)
    held, seams = jnp.split(kept, [at.goals.size])
    joins = solve_triangular(follow.triangle, push.at[at.goals].set(-held), trans=1, lower=True)
    # Each equation but the seams' is that of one state.
    prices = jnp.zeros(linear.defect.size).at[at.seams].set(seams).at[at.rows[~at.given]].set(joins[~at.given])
    return way, level, prices


def _curvature(linear: Linear, bends, matrix, price) -> Float[Array, "u u"]:
    """`Z^T (J^T S J + price) Z`, with all variables `Z u` as the states follow; `bends` are the blocks of the middle.

    An interval depends on one state, two torques beside each other and a duration. One half is made, and then added to
    what mirrors it.
    """
    (size, n), at = matrix.shape, columns(linear)
    states, others = at[..., :2] - size, at[..., 2:] - [0, 0, 0, 0, size]  # places among `x` and `u`
    moved = matrix[states]
    half = (price / 2 * matrix).at[states].add(jnp.einsum("pkij,pkju->pkiu", bends[..., :2, :2] / 2, moved))
    half = half.at[states[..., None], others[..., None, :]].add(bends[..., :2, 2:])
    alone = jnp.zeros((n, n)).at[others[..., None], others[..., None, :]].add(bends[..., 2:, 2:] / 2)
    whole = matrix.T @ half + alone + price / 2 * jnp.eye(n)
    return whole + whole.T
