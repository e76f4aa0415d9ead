r"""Direct collocation of one phase with CasADi and IPOPT: what `wholearm_jax.optimise` is compared with.

    python benchmarks/collocation.py [--duration SECONDS]

The same problem on the same tabulated path: from rest at the path's start to rest at its end in a fixed duration `T`,
torques linear between evenly spaced knots and within their limits, the least contact force as large as it can be. Time
is a share `u` of `T`, place a share `p` of the path's length `L`, and `w = dp/du`:

    maximise m   subject to   dp/du = w,   dw/du = (T^2/L) (A0 + A3 tau1 + A4 tau2) + T A2 w + L A1 w^2,
                              F0 + F1 (L w/T)^2 + F2 (L w/T) + F3 tau1 + F4 tau2 >= m,   |tau| <= limit,   w >= 0

with `A` and `F` the coefficients of `wholearm_jax.dynamics.path_dynamics.PathDynamics`. States are cubics on each
interval that satisfy the
equation of motion at Radau's three points; forces count at these points and at the start. Each smooth piece of the
path enters as one Chebyshev series for every coefficient, refitted from the table to 1e-10, so that IPOPT sees smooth
functions and exact second derivatives.

Where a slip reverses, `A` and `F` jump at a known place but at an unknown time. The interval in which the motion
passes it is divided there and its time is a variable: no smoothing, and no loss of order. Which interval that is
follows from the first guess, and moves on while the optimum lies at the interval's end (`_climbed`).
"""

import argparse
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import casadi as ca
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from layered_scenes import layered_file
from scipy.special import beta, betainc

import wholearm_jax as wa
from wholearm_jax.dynamics import PathDynamics
from wholearm_jax.margin import best_quasistatic_torque_batch
from wholearm_jax.model import Arrival, pad_schedule
from wholearm_jax.phases import simulate_phase
from wholearm_jax.simulation import IntegratorOptions

KNOTS, DEGREE = 31, 3
FINE = 120  # collocation intervals of the best that is known
FIT = 1e-10  # relative error of the series that stand for the table
BELLS = tuple((p, q) for p in (1, 2, 4, 8) for q in (1, 2, 4, 8))  # motions with speed ~ u^p (1 - u)^q
MINIMUM_JERK = (2, 2)
MOVES, WIDELY = 12, 20  # intervals of reversals tried, and where none is to be missed
SETTINGS = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False, "ipopt.max_iter": 1000, "ipopt.tol": 1e-8}
CONVERGED = ("Solve_Succeeded", "Solved_To_Acceptable_Level")


class Piece(NamedTuple):
    """A smooth piece of a path: from `low` to `high` in shares of its length, speeds scaled by `speed_ratio` on entry.

    `series[k, j]` is Chebyshev coefficient `k` of function `j`: `A0 ... A4`, then `F0 ... F4` of each contact.
    """

    low: float
    high: float
    speed_ratio: float
    series: np.ndarray


class PathSeries(NamedTuple):
    """What the transcription needs of a `wholearm_jax` table."""

    segments: tuple[Piece, ...]
    length: float
    limit: np.ndarray


class Course(NamedTuple):
    """A motion over one phase, sampled: shares `u`, `p`, `w`; torques at the knots in limits, and a least force [N]."""

    u: np.ndarray
    p: np.ndarray
    w: np.ndarray
    tau: np.ndarray
    least: float


@dataclass(frozen=True)
class Collocated:
    """What IPOPT made of a phase.

    `course.plan_margin` [N] is the least force at the collocation points, `ipopt` its status. `margin` [N] and
    `assessment` are
    those of the honest simulation of `torque` (knots x 2, N m); `missed` is the distance to the path's end that it
    leaves and `speed` the speed, in path lengths and in these a duration. It took `solves` solves, `iterations` in all,
    in `seconds` seconds (the best of them alone in `best_solve`) after `build` seconds of building. Of the
    `initial_guesses`
    tried one after the other only `spent` counts all, in seconds.
    """

    torque: np.ndarray
    course: Course
    ipopt: str
    margin: float
    assessment: str
    missed: float
    speed: float
    iterations: int
    solves: int
    build: float
    solve: float
    best_solve: float
    guesses: int = 1
    spent: float = 0.0

    @property
    def succeeded(self) -> bool:
        """Whether IPOPT converged and the simulation arrives with every contact compressive."""
        return self.ipopt in CONVERGED and self.assessment == "ok"

    @property
    def nearly(self) -> bool:
        """Whether it would succeed if arriving within a thousandth of the path, at 5 % of the mean speed, were enough.

        The package itself asks for a millionth of the path and 0.35 % (`wholearm_jax.phases.assessment`).
        """
        return self.ipopt in CONVERGED and self.margin > 0 and self.missed < 1e-3 and self.speed < 0.05


def collocate(dynamics: PathDynamics, duration: float, *, knots: int = KNOTS) -> Collocated:
    """Maximise a phase's margin by collocation, one interval between knots, from up to three first guesses.

    The minimum-jerk motion comes first, then the bell motion that can be squeezed hardest, then the even one; each
    with the best squeeze at each instant. The first that succeeds is returned, else the best. The programme is written
    out in scalars: IPOPT is then about four times faster, although building takes twenty times longer.
    """
    phase = Phase(read(dynamics), duration, knots, 1)
    tried: list[Collocated] = []
    for bell in dict.fromkeys((MINIMUM_JERK, _hardest(dynamics, duration), (1, 1))):
        solves = _climbed(phase, _course(dynamics, phase, bell), {"expand": True})
        tried.append(_collected(dynamics, phase, solves))
        if tried[-1].succeeded:
            break
    best = max(tried, key=lambda one: (one.succeeded, one.ipopt in CONVERGED, one.margin))
    return replace(best, guesses=len(tried), spent=sum(one.build + one.solve for one in tried))


def best_known(dynamics: PathDynamics, duration: float, coarse: Collocated, *, enough: float = np.inf) -> Collocated:
    """The largest margin that collocation finds with the same knots, whatever it costs, or one of `enough` newtons.

    Each interval between knots is divided, into `FINE` or more in all, so that forces are held at many times and the
    simulated margin is close to the programme's. Reversals are searched widely, from several starts and with both of
    IPOPT's strategies for its barrier, since these lead to different optima.
    """
    knots = len(coarse.torque)
    phase = Phase(read(dynamics), duration, knots, -(-FINE // (knots - 1)))
    jerk, hardest = (_course(dynamics, phase, bell) for bell in (MINIMUM_JERK, _hardest(dynamics, duration)))
    starts = ((jerk, "monotone"), (jerk, "adaptive"), (coarse.course, "monotone"), (hardest, "monotone"))
    found: list[Collocated] = []
    for start, strategy in starts:
        options = {"ipopt.mu_strategy": strategy, "ipopt.max_iter": 300}
        found.append(_collected(dynamics, phase, _explored(phase, start, options)))
        if found[-1].succeeded and found[-1].margin >= enough:
            break
    return max(found, key=lambda one: (one.succeeded, one.margin))


# --- the path as smooth functions -------------------------------------------------------------------------------------


def read(dynamics: PathDynamics) -> PathSeries:
    """One Chebyshev series a piece, of the degree that reproduces the table's polynomials to `FIT`."""
    count = int(dynamics.count)
    breaks = np.asarray(dynamics.breakpoints)[: count + 1]
    shares = (breaks - breaks[0]) / (breaks[-1] - breaks[0])
    segments = [
        Piece(shares[k], shares[k + 1], float(dynamics.speed_ratio[k]), _series(dynamics, k)) for k in range(count)
    ]
    return PathSeries(tuple(segments), float(dynamics.length), np.asarray(dynamics.torque_limit))


def _series(dynamics: PathDynamics, segment: int) -> np.ndarray:
    first, panels = int(dynamics.first[segment]), int(dynamics.panels[segment])
    rows = slice(first, first + panels)
    force = np.asarray(dynamics.force[rows])
    tables = np.concatenate([np.asarray(dynamics.acceleration[rows]), force.reshape(*force.shape[:2], -1)], axis=2)
    for degree in range(6, 120, 3):
        series = np.polynomial.chebyshev.chebinterpolate(lambda x: _evaluate(tables, x), degree)
        check = np.linspace(-1, 1, 401)
        exact = _evaluate(tables, check)
        error = np.abs(np.polynomial.chebyshev.chebval(check, series).T - exact).max(0)
        if np.all(error <= FIT * np.maximum(np.abs(exact).max(0), 1e-3 * np.abs(exact).max())):
            break
    return series


def _evaluate(tables: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The piece's polynomials at `x` in [-1, 1] over the whole piece."""
    share = (x + 1) / 2 * len(tables)
    panel = np.clip(share.astype(int), 0, len(tables) - 1)
    xi = 2 * (share - panel) - 1
    value = tables[panel, -1]
    for row in range(tables.shape[1] - 2, -1, -1):
        value = tables[panel, row] + xi[:, None] * value
    return value


# --- the nonlinear programme ------------------------------------------------------------------------------------------


class Phase(NamedTuple):
    """What is to be solved: `duration` [s], `knots` torques a joint, `refine` collocation intervals between two."""

    path: PathSeries
    duration: float
    knots: int
    refine: int

    @property
    def intervals(self) -> int:
        return (self.knots - 1) * self.refine


class Part(NamedTuple):
    """A stretch of time with its own cubic: in interval `row`, on `segment`, from `begin` to `end` in intervals.

    `begin` and `end` are numbers, or variables where a piece of the path ends within the interval.
    """

    row: int
    segment: int
    begin: ca.MX | float
    end: ca.MX | float


class Programme(NamedTuple):
    """IPOPT's solver for one phase, bounds of its variables and constraints, and how its variables are laid out.

    Variables are torques, splits, states and the least force, in this order (`_pack`, `_unpack`);
    `fused_matmul(splits)` are
    the shares `u` of the states.
    """

    solver: ca.Function
    bounds: dict[str, np.ndarray]
    times: ca.Function
    knots: int
    splits: int


def _programme(phase: Phase, rows: tuple[int, ...], options: dict[str, Any]) -> Programme:
    """The transcription of a phase whose motion leaves the path's piece `k` in interval `rows[k]`."""
    tau, splits, least = ca.MX.sym("tau", 2, phase.knots), ca.MX.sym("splits", len(rows)), ca.MX.sym("m")
    parts = _parts(phase, rows, splits)
    states = ca.MX.sym("states", 2, DEGREE * len(parts))
    equal, positive, times, first, before = [], [], [], 0, ca.MX.zeros(2, 1)
    for number in range(len(phase.path.segments)):
        own = [part for part in parts if part.segment == number]
        last = first + DEGREE * len(own)
        block = _block(phase, own, before, states[:, first:last], tau)
        equal.append(ca.vec(block.defects))
        positive += [ca.vec(block.forces) - least, block.onward]
        times.append(block.times)
        first, before = last, states[:, last - 1]
    problem = {
        "x": ca.vertcat(ca.vec(tau), splits, ca.vec(states), least),
        "f": -least,
        "g": ca.vertcat(*equal, *positive),
    }
    counts = [sum(rows.numel() for rows in group) for group in (equal, positive)]
    low, high = _limits(phase, parts, len(rows))
    return Programme(
        solver=ca.nlpsol("solver", "ipopt", problem, SETTINGS | options),
        bounds={"lbx": low, "ubx": high, "lbg": np.zeros(sum(counts)), "ubg": np.repeat([0.0, np.inf], counts)},
        times=ca.Function("times", [splits], [ca.horzcat(*times)]),
        knots=phase.knots,
        splits=len(rows),
    )


def _parts(phase: Phase, rows: tuple[int, ...], splits: ca.MX) -> list[Part]:
    """The parts of a phase whose motion leaves piece `k` in interval `rows[k]`, at the share `splits[k]` of it."""
    parts = []
    for row in range(phase.intervals):
        begin: ca.MX | float = 0.0
        for segment in range(sum(r < row for r in rows), sum(r <= row for r in rows) + 1):
            end = splits[segment] if segment < len(rows) and rows[segment] == row else 1.0
            parts.append(Part(row, segment, begin, end))
            begin = end
    return parts


class Block(NamedTuple):
    """One piece's equations: collocation `defects`, `forces` [N], shares `fused_matmul`, what is positive to go
    `onward`."""

    defects: ca.MX
    forces: ca.MX
    times: ca.MX
    onward: ca.MX


def _block(phase: Phase, parts: list[Part], before: ca.MX, states: ca.MX, tau: ca.MX) -> Block:
    """The equations of the parts on one piece, which is entered in the state `before` (as the last piece counts speed).

    Forces count at every collocation point and where the piece is entered, since they jump there.
    """
    segment = phase.path.segments[parts[0].segment]
    points = np.array(ca.collocation_points(DEGREE, "radau"))
    slopes = ca.DM(ca.collocation_coeff(points.tolist())[0])
    before = before * ca.DM([1.0, segment.speed_ratio])
    torques, times, widths, rates = [_torque(phase, tau, parts[0].row, parts[0].begin)], [], [], []
    for k, part in enumerate(parts):
        own, width = states[:, DEGREE * k : DEGREE * (k + 1)], part.end - part.begin
        start = states[:, DEGREE * k - 1] if k else before
        rates.append(ca.mtimes(ca.horzcat(start, own), slopes))
        for place in points:
            share = part.begin + place * width
            torques.append(_torque(phase, tau, part.row, share))
            times.append((part.row + share) / phase.intervals)
            widths.append(width / phase.intervals)
    pull, forces = _motion(phase, segment).map(len(torques))(ca.horzcat(before, states), ca.horzcat(*torques))
    field = ca.vertcat(states[1, :], pull[1:])
    width = ca.horzcat(*widths)
    # At rest the object must start forward; a divided interval must not have a negative part.
    entry = pull[0] if parts[0].segment == 0 else ca.MX(1.0) * (parts[0].end - parts[0].begin)
    return Block(ca.horzcat(*rates) - ca.repmat(width, 2, 1) * field, forces, ca.horzcat(*times), entry)


def _motion(phase: Phase, segment: Piece) -> ca.Function:
    """`dw/du` and the contact forces [N] as a function of the state `(p, w)` and the torques in limits."""
    state, tau = ca.SX.sym("state", 2), ca.SX.sym("tau", 2)
    motion, force = _coefficients(segment, state[0])
    speed = state[1] * phase.path.length / phase.duration
    terms = ca.vertcat(1.0, speed**2, speed, tau * phase.path.limit)
    pull = phase.duration**2 / phase.path.length * ca.dot(motion, terms)
    return ca.Function("motion", [state, tau], [pull, ca.mtimes(force, terms)])


def _coefficients(segment: Piece, share: ca.SX) -> tuple[ca.SX, ca.SX]:
    """`A` (5) and `F` (contacts x 5) at a share of the path."""
    x = (2 * share - segment.low - segment.high) / (segment.high - segment.low)
    terms = [ca.SX(1), x]
    while len(terms) < len(segment.series):
        terms.append(2 * x * terms[-1] - terms[-2])
    values = ca.mtimes(ca.DM(segment.series.T), ca.vertcat(*terms))
    return values[:5], ca.reshape(values[5:], 5, -1).T


def _torque(phase: Phase, tau: ca.MX, row: int, share) -> ca.MX:
    """Torques at a share of interval `row`, `refine` of which lie between two knots."""
    knot, within = divmod(row, phase.refine)
    weight = (within + share) / phase.refine
    return tau[:, knot] * (1 - weight) + tau[:, knot + 1] * weight


def _limits(phase: Phase, parts: list[Part], splits: int) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of the variables: torques, splits in [0, 1], states within their piece, its end where the next begins."""
    segments = phase.path.segments
    states = np.zeros((2, DEGREE * len(parts), 2))  # lower and upper bounds of p and w
    states[0, :, 0] = np.repeat([segments[part.segment].low for part in parts], DEGREE)
    states[1, :, 0] = np.repeat([segments[part.segment].high for part in parts], DEGREE)
    states[1, :, 1] = np.inf
    for k, part in enumerate(parts):
        if k + 1 == len(parts) or parts[k + 1].segment > part.segment:
            states[0, DEGREE * (k + 1) - 1, 0] = segments[part.segment].high
    states[1, -1, 1] = 0.0
    one = np.ones(2 * phase.knots)
    return (
        np.concatenate([-one, np.zeros(splits), states[0].ravel(), [-np.inf]]),
        np.concatenate([one, np.ones(splits), states[1].ravel(), [np.inf]]),
    )


# --- first guesses and the search for the intervals of reversals ------------------------------------------------------


def _bell(u: np.ndarray, p: int, q: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Place, speed and acceleration of the motion from 0 to 1 with speed ~ `u^p (1 - u)^q`."""
    inner = np.clip(u, 1e-12, 1 - 1e-12)
    speed = inner**p * (1 - inner) ** q / beta(p + 1, q + 1)
    return betainc(p + 1, q + 1, u), speed, speed * (p / inner - q / (1 - inner))


def _squeezed(
    dynamics: PathDynamics, duration: float, bell: tuple[int, int], times: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The best squeeze on a bell motion at shares `fused_matmul`: torques [N m] and the least forces [N]."""
    place, speed, pull = _bell(times, *bell)
    length = float(dynamics.length)
    s = float(dynamics.breakpoints[0]) + length * place
    held = _holds(dynamics, s, speed * length / duration, pull * length / duration**2)
    return np.asarray(held.torque), np.asarray(held.margin)


_holds = jax.jit(best_quasistatic_torque_batch)


def _hardest(dynamics: PathDynamics, duration: float) -> tuple[int, int]:
    """The bell motion whose best squeeze has the largest least force."""
    times = np.linspace(0, 1, 241)
    return max(BELLS, key=lambda bell: _squeezed(dynamics, duration, bell, times)[1].min())


def _course(dynamics: PathDynamics, phase: Phase, bell: tuple[int, int]) -> Course:
    u = np.linspace(0, 1, 1501)
    tau, margin = _squeezed(dynamics, phase.duration, bell, np.linspace(0, 1, phase.knots))
    place, speed, _ = _bell(u, *bell)
    # A motion that no torque within limits can follow begins at the limits.
    tau = np.clip(np.nan_to_num(tau / phase.path.limit), -0.95, 0.95)
    return Course(u, place, speed, tau, max(float(margin.min()), 0.0))


def _passed(phase: Phase, course: Course) -> tuple[tuple[int, ...], np.ndarray]:
    """The intervals in which a course passes the pieces' ends, and where in them."""
    ends = [segment.high for segment in phase.path.segments[:-1]]
    at = np.interp(ends, course.p, course.u) * phase.intervals
    rows = np.clip(at.astype(int), 0, phase.intervals - 1)
    return tuple(int(row) for row in rows), np.clip(at - rows, 0.02, 0.98)


class Solve(NamedTuple):
    """One run of IPOPT: its status, where the reversals' intervals were divided, the course reached, the cost."""

    status: str
    rows: tuple[int, ...]
    splits: np.ndarray
    course: Course
    iterations: int
    build: float
    solve: float

    @property
    def rank(self) -> tuple[bool, float]:
        return self.status in CONVERGED, self.course.least


def _once(phase: Phase, course: Course, rows: tuple[int, ...], splits: np.ndarray, options: dict[str, Any]) -> Solve:
    """Build the programme and solve it from a course."""
    begun = time.perf_counter()
    programme = _programme(phase, rows, options)
    built = time.perf_counter()
    found = programme.solver(x0=_pack(programme, course, splits), **programme.bounds)
    done = time.perf_counter()
    stats = programme.solver.stats()
    reached, splits = _unpack(programme, np.asarray(found["x"]).ravel())
    return Solve(stats["return_status"], rows, splits, reached, stats["iter_count"], built - begun, done - built)


def _climbed(phase: Phase, course: Course, options: dict[str, Any]) -> list[Solve]:
    """Solve from a course; while a reversal lies at its interval's end move it on, further as long as that gains."""
    done, stride = [_once(phase, course, *_passed(phase, course), options)], 1
    while len(done) < MOVES:
        best = max(done, key=lambda one: one.rank)
        step = np.where(best.splits < 1e-3, -stride, np.where(best.splits > 1 - 1e-3, stride, 0))
        ahead = _beside(phase, best, step)
        if ahead is not None and ahead[0] not in [one.rows for one in done]:
            done.append(_once(phase, best.course, *ahead, options))
            stride = 2 * stride if done[-1].rank > best.rank else 1
        elif stride > 1:
            stride = 1
        else:
            break
    return done


def _explored(phase: Phase, course: Course, options: dict[str, Any]) -> list[Solve]:
    """Solve from a course, and again with each reversal one or two intervals aside for as long as that gains."""
    done = [_once(phase, course, *_passed(phase, course), options)]
    best, waiting = done[0], []
    while len(done) < WIDELY:
        if best is done[-1]:
            steps = (step * one for step in (1, -1, 2, -2) for one in np.eye(len(best.rows), dtype=int))
            waiting = [beside for beside in (_beside(phase, best, step) for step in steps) if beside]
        waiting = [beside for beside in waiting if beside[0] not in [one.rows for one in done]]
        if not waiting:
            break
        done.append(_once(phase, best.course, *waiting.pop(0), options))
        best = max(done, key=lambda one: one.rank)
    return done


def _beside(phase: Phase, solve: Solve, step: np.ndarray) -> tuple[tuple[int, ...], np.ndarray] | None:
    """The intervals of a solve's reversals moved by `step`, and where to divide them; None where that cannot be."""
    if not np.any(step):
        return None
    moved = np.clip(np.array(solve.rows, int) + step, 0, phase.intervals - 1)
    if np.any(np.diff(moved) < 0):
        return None
    return tuple(moved.tolist()), np.where(step < 0, 0.98, np.where(step > 0, 0.02, solve.splits))


def _collected(dynamics: PathDynamics, phase: Phase, solves: list[Solve]) -> Collocated:
    """The best of several solves, simulated."""
    best = max(solves, key=lambda one: one.rank)
    torque = best.course.tau * phase.path.limit
    schedule = pad_schedule(wa.torque_schedule(np.linspace(0, phase.duration, phase.knots), torque))
    outcome = simulate_phase(
        dynamics, schedule, jnp.zeros(()), jnp.asarray(phase.duration), IntegratorOptions(), Arrival.AT_REST
    )
    last = int(outcome.motion.count)
    return Collocated(
        torque=torque,
        course=best.course,
        ipopt=best.status,
        margin=float(outcome.margin_result.margin),
        assessment=wa.Status(int(outcome.assessment.status)).label,
        missed=(float(dynamics.breakpoints[-1]) - float(outcome.motion.s[last])) / phase.path.length,
        speed=float(outcome.motion.w[last]) / phase.path.length,
        solves=len(solves),
        best_solve=best.solve,
        **{name: sum(getattr(one, name) for one in solves) for name in ("iterations", "build", "solve")},
    )


def _pack(programme: Programme, course: Course, splits: np.ndarray) -> np.ndarray:
    times = np.asarray(programme.times(splits)).ravel()
    states = np.stack([np.interp(times, course.u, course.p), np.interp(times, course.u, course.w)], axis=1)
    x = np.concatenate([course.tau.ravel(), splits, states.ravel(), [course.least]])
    return np.clip(x, programme.bounds["lbx"], programme.bounds["ubx"])


def _unpack(programme: Programme, x: np.ndarray) -> tuple[Course, np.ndarray]:
    torques = 2 * programme.knots
    splits = x[torques : torques + programme.splits]
    p, w = x[torques + programme.splits : -1].reshape(-1, 2).T
    u = np.append(0.0, np.asarray(programme.times(splits)).ravel())
    return Course(u, np.append(0.0, p), np.append(0.0, w), x[:torques].reshape(-1, 2), float(x[-1])), splits


def main() -> None:
    wa.configure()
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--duration", type=float, default=1.0, help="of every phase [s]")
    parser.add_argument("--knots", type=int, default=KNOTS, help="torques a joint")
    parser.add_argument("--best", action="store_true", help="the best that is known with finer intervals, slowly")
    parser.add_argument(
        "scenes",
        nargs="*",
        default=[layered_file("heptagon"), layered_file("hexagon")],
        help="bundled scenes or files",
    )
    chosen = parser.parse_args()
    print("scene        phase          IPOPT  simulated  bound [N]  status          missed  iter  build  solve [s]")
    for name in chosen.scenes:
        scene = wa.load(name)
        scene = eqx.tree_at(lambda s: [p.duration for p in s.phases], scene, [chosen.duration] * len(scene.phases))
        traced = wa.trace(scene)
        for phase, at, top in zip(scene.phases, traced, wa.bounds(scene, traced=traced), strict=True):
            one = collocate(at.dynamics, chosen.duration, knots=chosen.knots)
            if chosen.best:
                one = best_known(at.dynamics, chosen.duration, one)
            forces = f"{one.course.least:7.4f} {one.margin:10.4f} {float(top.value):10.4f}"
            cost = f"{one.iterations:5d} {one.build:6.2f} {one.solve:6.2f}"
            failed = "" if one.ipopt in CONVERGED else f"  {one.ipopt}"
            name = Path(name).stem.removesuffix("_layered")[-12:]
            print(
                f"{name:12s} {phase.name:12s} {forces}  {one.assessment:14s} {one.missed:7.0e} {cost}{failed}",
                flush=True,
            )


if __name__ == "__main__":
    main()
