"""The shortest time with a margin against TOPP-RA: do two methods that share no code agree, and which is faster?

    python benchmarks/shortest_times.py [--quick]

TOPP-RA (H. Pham and Q.-C. Pham, 2018; the package `toppra`) finds the fastest motion along a path by reachable sets. It
knows constraints that are linear in acceleration and squared speed; contact forces above the margin and torque limits
are such once the torque that moves nothing is eliminated (Fourier and Motzkin). Viscous friction is left out, which it
cannot take. For each phase of the bundled plans, at shares of the largest margin of all durations: both times, with as
many intervals, and how long each method takes, warm; TOPP-RA's rows are given to it. Prints and writes the ratios.
"""

import argparse
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import toppra
from jaxtyping import Float
from measure import compare, save
from toppra.algorithm import TOPPRA
from toppra.constraint import LinearConstraint

import wholearm_jax as wa
from wholearm_jax.core import as_device_array
from wholearm_jax.dynamics import PathDynamics, evaluate, locate_panel
from wholearm_jax.margin import PROGRAMME_INTERVALS, largest_margin, rest_to_rest, shortest_duration
from wholearm_jax.margin.contact_forces import cone_facets
from wholearm_jax.margin.path_programme import discretise
from wholearm_jax.model import Arrival
from wholearm_jax.optimisation.quasistatic_plan import rolling_count

SCENES = ("heptagon", "hexagon", "tipping", "box")
SHARES = (0.3, 0.6, 0.9)  # of the largest margin


class Rows(LinearConstraint):
    """Rows `a u + b x + c >= 0` of each interval's acceleration and the squared speed where it begins."""

    def __init__(self, rows: Float[np.ndarray, "nodes rows 3"]):
        super().__init__()
        self.identical = True
        self.rows = -rows / np.abs(rows).max(2, keepdims=True).clip(1e-12)

    def compute_constraint_params(self, path, gridpoints, *_):
        a, b, c = np.moveaxis(self.rows, 2, 0)
        many, bounds = np.eye(a.shape[1]), np.tile([0.0, 1e6], (len(gridpoints), 1))
        return a, b, c, many, np.zeros(a.shape[1]), None, bounds


def linear_rows(dynamics: PathDynamics, margin: float, segment, s) -> Float[np.ndarray, "places rows 3"]:
    """Rows `(of u, of x, constant) >= 0` at places: forces above the margin and torques within limits."""

    @jax.jit
    @partial(jax.vmap, in_axes=(0, 0))
    def coefficients(segment, s):
        panel, xi = locate_panel(dynamics, segment, s)
        return evaluate(dynamics.acceleration, panel, xi), cone_facets(dynamics, evaluate(dynamics.force, panel, xi))

    acceleration, force = (np.asarray(each) for each in coefficients(segment, s))
    limit = np.asarray(dynamics.torque_limit)
    bounds = np.zeros((len(s), 4, 5))
    bounds[:, :, 0] = [*limit, *limit]
    bounds[:, :, 3:] = np.vstack([np.eye(2), -np.eye(2)])
    force = force.copy()
    force[:, :, 0] -= margin
    rows = np.concatenate([force, bounds], axis=1)
    # Torques are those of the acceleration along what pulls, and any across it.
    pull = acceleration[:, 3:]
    size = np.linalg.norm(pull, axis=1, keepdims=True)
    by_u = np.einsum("prt,pt->pr", rows[:, :, 3:], pull / size**2)
    by_w = np.einsum("prt,pt->pr", rows[:, :, 3:], np.stack([-pull[:, 1], pull[:, 0]], axis=1) / size)
    known = np.stack(
        [by_u, rows[:, :, 1] - by_u * acceleration[:, 1:2], rows[:, :, 0] - by_u * acceleration[:, :1]], axis=2
    )
    # Each row that bounds the torque across from below, with each that does from above.
    first, second = np.triu_indices(rows.shape[1], 1)
    one, other = by_w[:, first], by_w[:, second]
    opposed = one * other < 0
    share = np.where(opposed, np.abs(one) + np.abs(other), 1.0)
    weights = np.where(opposed, np.abs(other), 0.0) / share, np.where(opposed, np.abs(one), 0.0) / share
    pairs = weights[0][..., None] * known[:, first] + weights[1][..., None] * known[:, second]
    return np.concatenate([pairs, np.where(by_w[..., None] == 0, known, 0.0)], axis=1)


def reachable_sets(dynamics: PathDynamics, margin: float):
    """Return TOPP-RA's problem, to be solved, its grid, and its unit of time [s]."""
    programme = discretise(dynamics, jnp.asarray(jnp.inf), rest_to_rest(), PROGRAMME_INTERVALS)
    nodes, segment = np.asarray(programme.node_s), np.asarray(programme.segment)[:PROGRAMME_INTERVALS]
    # In the middle of each interval, and where a segment begins and ends; the squared speed there is `x + 2 d u`.
    changes = np.diff(segment) != 0
    begins, ends, always = np.append(True, changes), np.append(changes, True), np.full(len(segment), True)
    width = np.diff(nodes)
    parts = []
    for share, wanted in ((0.0, begins), (0.5, always), (1.0, ends)):
        rows = linear_rows(dynamics, margin, segment, nodes[:-1] + share * width)
        rows[:, :, 0] += 2 * share * width[:, None] * rows[:, :, 1]
        parts.append(np.where(wanted[:, None, None], rows, 0.0))
    rows = np.concatenate(parts, axis=1)
    rows = rows[:, np.any(rows != 0, axis=(0, 2))]
    rows = np.concatenate([rows, np.zeros_like(rows[:1])])
    # In units of the path's length and of the programme's time: TOPP-RA's solver takes numbers near one alone.
    length, unit = nodes[-1] - nodes[0], float(programme.time_unit)
    rows, nodes = rows * [length / unit**2, (length / unit) ** 2, 1.0], (nodes - nodes[0]) / length
    path = toppra.SplineInterpolator(nodes[[0, -1]], nodes[[0, -1], None])
    return TOPPRA([Rows(rows)], path, gridpoints=nodes, solver_wrapper="seidel"), nodes, unit


def shortest(problem: TOPPRA, nodes, unit: float) -> float:
    """Solve TOPP-RA's problem and return the time [s]; NaN where its solver fails."""
    speed = problem.compute_parameterization(0.0, 0.0)[1]
    return np.nan if speed is None else unit * float((2 * np.diff(nodes) / (speed[1:] + speed[:-1])).sum())


def measure(name: str, shares: tuple[float, ...]) -> list[dict]:
    """Compare both methods on each phase of a bundled plan."""
    scene = wa.load(name)
    scene = eqx.tree_at(lambda s: s.hand.viscous, scene, jnp.zeros(2))
    rows = []
    for phase, path in zip(scene.phases, wa.trace(scene), strict=True):
        if phase.arrive is Arrival.HOLD:
            continue
        dynamics, speeds, rolling = path.dynamics, rest_to_rest(), rolling_count(phase)
        top = float(largest_margin(dynamics, as_device_array(np.inf), speeds, rolling).margin)
        for share in shares:
            margin = as_device_array(share * top)

            def ours(margin=margin, dynamics=dynamics, speeds=speeds, rolling=rolling):
                return jax.block_until_ready(shortest_duration(dynamics, margin, speeds, rolling))

            problem = reachable_sets(dynamics, share * top)
            times = compare({"ours": ours, "toppra": lambda problem=problem: shortest(*problem)})
            found = {"ours": float(ours().duration), "toppra": shortest(*problem)}
            rows.append({"scene": name, "phase": phase.name, "share": share, "durations": found, "seconds": times})
            ratio, speed = found["ours"] / found["toppra"], times["toppra"] / times["ours"]
            print(
                f"{name}, {phase.name}, {share:.1f} of {top:.3f} N: {found['ours']:.5f} s, {ratio - 1:+.1e} of"
                f" TOPP-RA's; {1e3 * times['ours']:.2f} ms, TOPP-RA {speed:.2f} times as long",
                flush=True,
            )
    return rows


def main() -> None:
    wa.configure()
    toppra.setup_logging("ERROR")
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="one scene, one margin; nothing is written")
    quick = parser.parse_args().quick
    rows = [row for name in SCENES[: 1 if quick else None] for row in measure(name, SHARES[: 1 if quick else None])]
    ratios = np.array([row["durations"]["ours"] / row["durations"]["toppra"] for row in rows])
    speeds = np.array([row["seconds"]["toppra"] / row["seconds"]["ours"] for row in rows])
    print(
        f"{len(rows)} motions: times of {ratios.min():.6f} to {ratios.max():.6f} of TOPP-RA's;"
        f" TOPP-RA takes {np.median(speeds):.2f} times as long in the median, {speeds.min():.2f} at least"
    )
    if not quick:
        save("shortest_times", {"rows": rows})


if __name__ == "__main__":
    main()
