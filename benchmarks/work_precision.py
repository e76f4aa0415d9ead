r"""Run time against true error: the package, Newton in the vector field, the un-reduced equations, a bare loop.

    python benchmarks/work_precision.py [--quick]

The heptagon's two phases, each under piecewise-linear torques (31 knots, as `optimise` finds them) and under a straight
line in time, the smoothest that a schedule can hold. A run's error is the largest over its own steps, over `z`,
`z_dot` and `c_n`, against the largest size of the places, the angles, their rates and each contact's force. The
reference is SciPy's DOP853 at 1e-13 on all five coordinates, which shares nothing with the package. Both end before the
object comes to rest, and times within `MIN_SEPARATION` of a slip reversal, where forces jump, do not count.

Every time is that of one phase, warm, taken in turn. The package is timed as `simulate_motion` alone, called from
Python and, as a
share of `MANY` phases that follow one another, within a program; as simulating and scoring (`run`); and with tracing
and tabulating the path included. Newton's method, too, is timed called from Python and within a program. All of JAX's
programs, of both sides, are called as the package calls its own (`CachedJit`) and compiled as `wholearm_jax.configure`
says, and again in a second process as XLA does by itself (`PLAIN_TYPES`). For each error level the ratio is between the
fastest runs that are at least as good.
"""

import argparse
import itertools
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import measure
import newton_in_field
import numba_loop
import numpy as np
from layered_scenes import layered

import wholearm_jax as wa
from wholearm_jax.core import CachedJit, Status
from wholearm_jax.dynamics import PathDynamics
from wholearm_jax.files import scene_toml as scene_file
from wholearm_jax.model import (
    Arrival,
    PhaseSchedule,
    TorqueSchedule,
    pad_schedule,
    restrict_to_phase,
    rigid_body,
    scaled_mechanics,
)
from wholearm_jax.phases import TracedPhase, sample_phase, simulate_phase, trace_phase
from wholearm_jax.simulation import IntegratorOptions, Motion, simulate_motion

HERE = Path(__file__).parent
PLAIN = (
    "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1024 "
    "--xla_cpu_use_fusion_emitters=true --xla_backend_optimization_level=3"
)
"""XLA's own choices, which `configure` then leaves."""

MANY, FEW = 64, 8  # phases of one program that share the cost of its call: the package's, and Newton's, which is small
APART = 1e-4  # shares of the phase around a slip reversal that do not count
STOP = {"knots": 0.999}  # the share up to which runs that come to rest are compared
LEVELS = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11)
BETWEEN = "trajectory between steps"  # errors only
SOLVERS = {"Bosh3": dfx.Bosh3(), "Dopri5": dfx.Dopri5(), "Tsit5": dfx.Tsit5(), "Dopri8": dfx.Dopri8()}
DIRECT = {name: SOLVERS[name] for name in ("Tsit5", "Dopri8")}
TOLERANCES = tuple(10.0**-k for k in range(3, 14))
SCIPY = tuple(10.0**-k for k in range(4, 13))
SHOWN = {
    "package": ("the package: move", "#0072B2", "o"),
    "package, within a program": ("move, within a program", "#56B4E9", "*"),
    "package, run": ("simulate and score", "#E69F00", "s"),
    "package, trace and run": ("trace, simulate and score", "#009E73", "D"),
    "plain": ("move, XLA by itself", "#000000", "v"),
    "Newton in the field": ("Newton in the vector field", "#D55E00", "^"),
    "Newton, within a program": ("Newton, within a program", "#8C3B00", "<"),
    "un-reduced DOP853": ("SciPy, un-reduced", "#CC79A7", "P"),
    "bare loop": ("bare loop (numba)", "#999999", "x"),
}


# --- problems and their references ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Problem:
    """A phase under a torque schedule, and its reference."""

    name: str
    scene: wa.Scene
    phase: int
    traced: TracedPhase
    schedule: TorqueSchedule
    start: jax.Array
    duration: jax.Array
    phase_schedule: PhaseSchedule
    stop: float
    follow: Callable | None = None
    reference: Any = None
    scale: tuple[np.ndarray, ...] = ()


def problems(*, referred: bool) -> list[Problem]:
    """The four; without their references (minutes of work) where only times are wanted."""
    scene = layered("heptagon")
    traced = wa.trace(scene)
    kinds = ("knots", "ramps")
    return [_problem(scene, traced, p, kind, referred) for p, kind in itertools.product((0, 1), kinds)]


def _problem(scene, traced, phase, kind, referred) -> Problem:
    given = wa.read_torque(HERE / "data" / f"heptagon_{kind}.csv")
    start, duration = jnp.asarray(float(phase)), jnp.asarray(float(scene.phases[phase].duration))
    schedule = pad_schedule(given)
    outcome = simulate_phase(
        traced[phase].dynamics, schedule, start, duration, IntegratorOptions(tolerance=1e-13), Arrival.MOVING
    )
    assert not bool(outcome.motion.at_rest[0]), "the references do not wait"
    end = float(outcome.motion.phase_time[int(outcome.motion.count)])
    stop = min(STOP.get(kind, 1.0), end)

    name = f"{scene.phases[phase].name}, {'31 knots' if kind == 'knots' else 'a straight line'}"
    phase_schedule = jax.jit(restrict_to_phase)(schedule, start, duration)
    at = (name, scene, phase, traced[phase], schedule, start, duration, phase_schedule, stop)
    if not referred:
        return Problem(*at)

    sys.path.insert(0, str(HERE.parent))  # the un-reduced simulation is one of the tests' oracles
    from tests.reference.unreduced import Model

    data = scene_file.to_dict(scene)
    model = Model(data, data["phase"][phase]["contacts"])
    z = np.asarray(traced[phase].path.start * system_of(scene, phase).configuration_unit)
    follow = partial(_follow, model, z, data["phase"][phase]["toward"], given, float(start))
    reference = follow(min(end + 1e-6, 1.0) if kind != "knots" else stop + 1e-6, 1e-13)
    rows = [reference.at(t) for t in np.linspace(0.0, stop * float(duration), 400)]
    z, z_dot, cn = (np.abs(np.array(column)).max(0) for column in zip(*rows, strict=True))
    scale = (*(np.repeat([a[:2].max(), a[2:].max()], [2, 3]) for a in (z, z_dot)), cn)
    return Problem(*at, follow, reference, scale)


def _follow(model, z, toward, given: TorqueSchedule, start: float, end: float, tolerance: float):
    """The un-reduced motion from rest at `z`; times are those since the phase's start."""
    times, values = np.asarray(given.times) - start, np.asarray(given.values)
    first = np.flatnonzero(times <= 0)[-1]
    return model.simulate(z, toward, times[first:], values[first:], end, rtol=tolerance, atol=tolerance)


def system_of(scene: wa.Scene, phase: int):
    """A phase's mechanics in the object's units."""
    return scaled_mechanics(rigid_body(scene.object), scene.hand, scene.gravity, scene.phases[phase].formation)


def error(problem: Problem, shares, z, z_dot, cn) -> float:
    """The largest error of a run at its steps; NaN without a reference."""
    if problem.reference is None:
        return float("nan")
    duration = float(problem.duration)
    keep = (shares > 0) & (shares <= problem.stop)
    for moment, _ in problem.reference.reversals:
        keep &= np.abs(shares - moment / duration) > APART
    if not keep.any():
        return float("inf")
    true = [np.array(c) for c in zip(*(problem.reference.at(t) for t in shares[keep] * duration), strict=True)]
    each = [np.abs(a[keep] - b) / s for a, b, s in zip((z, z_dot, cn), true, problem.scale, strict=True)]
    return float(max(np.nanmax(e) for e in each))


# --- contenders: each returns its error, its steps and calls to time -------------------------------------------------


@dataclass(frozen=True)
class Call:
    """What is timed, and how many phases it does."""

    do: Callable[[], Any]
    phases: int = 1


@CachedJit
def _move(dynamics: PathDynamics, phase_schedule: PhaseSchedule, duration, options: wa.IntegratorOptions) -> Motion:
    return simulate_motion(dynamics, phase_schedule, duration, options=options)


@CachedJit
def _moves(dynamics: PathDynamics, phase_schedule: PhaseSchedule, durations, options: wa.IntegratorOptions) -> Motion:
    """One phase after the other."""
    return jax.lax.map(lambda duration: simulate_motion(dynamics, phase_schedule, duration, options=options), durations)


@CachedJit
def _at_steps(dynamics: PathDynamics, schedule, start, duration, motion: Motion):
    """`z`, `z_dot`, `c_n` at the motion's steps."""
    there = sample_phase(dynamics, schedule, start, duration, motion, motion.phase_time)
    return there.z, there.z_dot, there.cn


def package(problem: Problem, solver: str, tolerance: float):
    """The package; tracing and tabulating once, and again for every run."""
    dynamics = problem.traced.dynamics
    limit = 256
    while True:
        options = wa.IntegratorOptions(tolerance=jnp.asarray(tolerance), solver=SOLVERS[solver], max_steps=limit)
        motion = _move(dynamics, problem.phase_schedule, problem.duration, options)
        if int(motion.status) != Status.MAX_STEPS or limit >= 16384:
            break
        limit *= 4
    here = (problem.schedule, problem.start, problem.duration)
    count = int(motion.count)
    rows = (np.asarray(a)[: count + 1] for a in (motion.phase_time, *_at_steps(dynamics, *here, motion)))
    scene, phase = problem.scene, problem.scene.phases[problem.phase]
    solid, rough = (
        jax.jit(rigid_body)(scene.object),
        problem.traced.path.start * problem.traced.path.start.dtype.type(1),
    )
    rough = rough * system_of(scene, problem.phase).configuration_unit

    def again():
        traced = trace_phase(solid, scene.hand, scene.gravity, phase.formation, rough, phase.target)
        return simulate_phase(traced.dynamics, *here, options, Arrival.MOVING)

    durations = _durations(problem, MANY)
    calls = {
        "package": Call(lambda: _move(dynamics, problem.phase_schedule, problem.duration, options)),
        "package, within a program": Call(lambda: _moves(dynamics, problem.phase_schedule, durations, options), MANY),
        "package, run": Call(lambda: simulate_phase(dynamics, *here, options, Arrival.MOVING)),
        "package, trace and run": Call(again),
    }
    return error(problem, *rows), count, calls


def _durations(problem: Problem, count: int):
    """Of as many phases, which differ by less than counts, so that none can be left out."""
    return problem.duration * (1 + 1e-12 * jnp.arange(count))


def between(problem: Problem, tolerance: float) -> dict[str, float]:
    """The error of the sampled trajectory between the steps of the default solver."""
    options = wa.IntegratorOptions(tolerance=jnp.asarray(tolerance))
    motion = _move(problem.traced.dynamics, problem.phase_schedule, problem.duration, options)
    # Beyond the path's end, which a coarse run reaches a little early, the object rests.
    last = min(problem.stop, float(motion.phase_time[int(motion.count)]))
    shares = jnp.linspace(0.0, last * (1 - 1e-12), 401)
    here = (problem.traced.dynamics, problem.schedule, problem.start, problem.duration, motion)
    there = sample_phase(*here, shares)
    wrong = error(problem, *(np.asarray(a) for a in (shares, there.z, there.z_dot, there.cn)))
    return {"tolerance": tolerance, "error": wrong}


def direct(problem: Problem, solver: str, tolerance: float):
    """Newton's method in the vector field."""
    mechanics = jax.jit(lambda: system_of(problem.scene, problem.phase))()
    way = newton_in_field.direct(mechanics, problem.traced.path, problem.traced.dynamics)
    rest, limit = (DIRECT[solver], jnp.asarray(tolerance)), 256
    while True:
        path = newton_in_field.move(way, problem.phase_schedule, problem.duration, *rest, limit)
        if int(path.count.max()) < limit or limit >= 16384:
            break
        limit *= 4
    found = newton_in_field.states(way, problem.phase_schedule, problem.duration, path)
    live = np.arange(limit) < np.asarray(path.count)[:, None]
    rows = (np.asarray(a)[live] for a in (path.steps[..., 0], *found))
    durations = _durations(problem, FEW)
    calls = {
        "Newton in the field": Call(
            lambda: newton_in_field.move(way, problem.phase_schedule, problem.duration, *rest, limit)
        ),
        "Newton, within a program": Call(
            lambda: newton_in_field.moves(way, problem.phase_schedule, durations, *rest, limit), FEW
        ),
    }
    return error(problem, *rows), int(path.count.sum()), calls


def unreduced(problem: Problem, tolerance: float) -> dict:
    """SciPy on the un-reduced equations; it takes seconds, so it runs once, error and time alike."""
    begun = time.perf_counter()
    followed = problem.follow(problem.stop * float(problem.duration), tolerance)
    seconds = time.perf_counter() - begun
    times = np.unique(np.concatenate([s[2].ts for s in followed.segments]))
    states = (np.array(c) for c in zip(*(followed.at(t) for t in times), strict=True))
    wrong = error(problem, times / float(problem.duration), *states)
    row = {"solver": "DOP853", "tolerance": tolerance, "error": wrong, "steps": len(times) - 1}
    return row | {"seconds": seconds}


def bare(problem: Problem, solver: str, tolerance: float):
    """The hand-written loop over the package's own table."""
    given, method = (
        numba_loop.arrays(problem.traced.dynamics, problem.phase_schedule),
        numba_loop.tableau(SOLVERS[solver]),
    )
    found = numba_loop.move(given, float(problem.duration), method, tolerance)
    share, s, w = found.nodes[: found.count + 1].T
    there = _states(problem, jnp.asarray(share), jnp.asarray(s), jnp.asarray(w))
    nodes = np.empty((16385, 3))
    call = Call(lambda: numba_loop.loop(given, float(problem.duration), method, tolerance, nodes))
    return error(problem, share, *(np.asarray(a) for a in there)), found.count, {"bare loop": call}


def _states(problem: Problem, share, s, w):
    """`z`, `z_dot`, `c_n` of a bare loop's nodes, from the table."""
    rows = share.shape[0]
    count = jnp.asarray(rows - 1)
    dynamics, phase_schedule = problem.traced.dynamics, problem.phase_schedule
    segment = jnp.minimum((s[1:, None] > dynamics.breakpoints[None, 1:-1]).sum(1), dynamics.count - 1)
    row = jnp.clip(
        (((share[1:] + share[:-1]) / 2)[:, None] >= phase_schedule.phase_time).sum(1) - 1,
        phase_schedule.first,
        phase_schedule.last,
    )
    motion = Motion(share, s, w, w[:-1], segment, row, jnp.zeros(rows - 1, bool), count, jnp.asarray(0))
    return _at_steps(dynamics, problem.schedule, problem.start, problem.duration, motion)


# --- runs -------------------------------------------------------------------------------------------------------------


def in_turn(problem: Problem, solver: str, tolerance: float, repeats: int) -> dict[str, dict]:
    """One row for each contender that knows the solver, all timed in turn."""
    contenders = (package, bare, direct) if solver in DIRECT else (package, bare)
    rows, calls = {}, {}
    for contender in contenders:
        wrong, steps, own = contender(problem, solver, tolerance)
        calls |= own
        rows |= {name: {"solver": solver, "tolerance": tolerance, "error": wrong, "steps": steps} for name in own}
    times = measure.compare({name: call.do for name, call in calls.items()}, repeats=repeats)
    return {name: row | {"seconds": times[name] / calls[name].phases} for name, row in rows.items()}


def everything(quick: bool, referred: bool) -> dict[str, dict[str, list[dict]]]:
    """All contenders on all problems."""
    solvers, tolerances = (("Dopri8",), TOLERANCES[1::3]) if quick else (tuple(SOLVERS), TOLERANCES)
    # Low orders at fine tolerances take thousands of steps and lead nowhere.
    settings = [(s, t) for s, t in itertools.product(solvers, tolerances) if s != "Bosh3" or t > 1e-9]
    found = {}
    for problem in problems(referred=referred):
        rows: dict[str, list[dict]] = {}
        for setting in settings:
            for name, row in in_turn(problem, *setting, 3 if quick else 7).items():
                rows.setdefault(name, []).append(row)
        if referred:
            rows[BETWEEN] = [between(problem, t) for t in (1e-6, 1e-8, 1e-10, 1e-12)]
            rows["un-reduced DOP853"] = [unreduced(problem, t) for t in (SCIPY[::3] if quick else SCIPY)]
        found[problem.name] = rows
        print(f"{problem.name}: done", file=sys.stderr, flush=True)
    return found


def fastest(rows: list[dict], level: float) -> float | None:
    """The least time of the runs that are at least as good as a level."""
    return min((r["seconds"] for r in rows if r["error"] <= level), default=None)


def ratios(found: dict, against: str) -> dict[str, dict[str, list[float | None]]]:
    """For each problem and contender: its time over that of `against`, at each of `LEVELS`."""
    return {
        problem: {
            name: [_ratio(rows[name], rows[against], e) for e in LEVELS]
            for name in rows
            if name != BETWEEN and name != against
        }
        for problem, rows in found.items()
    }


def _ratio(rows: list[dict], against: list[dict], level: float) -> float | None:
    ours, theirs = fastest(rows, level), fastest(against, level)
    return ours / theirs if ours and theirs else None


# --- output -----------------------------------------------------------------------------------------------------------


def draw(found: dict, plain: dict, path: Path) -> None:
    """Time against error, a panel for each problem."""
    plt.rcParams |= {"font.size": 8, "axes.spines.top": False, "axes.spines.right": False, "svg.fonttype": "none"}
    figure, axes = plt.subplots(2, 2, figsize=(7.2, 5.8), sharex=True, sharey=True, layout="constrained")
    for ax, (problem, rows) in zip(axes.flat, found.items(), strict=True):
        for name, (label, colour, marker) in SHOWN.items():
            front = _front(plain[problem]["package"] if name == "plain" else rows[name])
            if front:
                ax.loglog(*zip(*front, strict=True), marker=marker, color=colour, ms=3.5, lw=1.2, label=label)
        ax.set_title(problem, loc="left")
        ax.grid(True, which="major", lw=0.3)
    for ax in axes[1]:
        ax.set_xlabel("largest relative error of $z$, $\\dot z$, $c_n$")
    for ax in axes[:, 0]:
        ax.set_ylabel("time of one phase [s]")
    axes[0, 0].invert_xaxis()
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False)
    figure.savefig(path)
    plt.close(figure)


def _front(rows: list[dict]) -> list[tuple[float, float]]:
    """Runs that no faster run beats, from coarse to fine."""
    points = sorted((r["seconds"], r["error"]) for r in rows)
    front = []
    for seconds, wrong in points:
        if not front or wrong < front[-1][0]:
            front.append((wrong, seconds))
    return front


def tabulate(dynamics: dict, against: str) -> None:
    """The ratios."""
    for problem, rows in dynamics.items():
        print(f"\n{problem}: time over that of '{against}'" + "".join(f"{e:8.0e}" for e in LEVELS))
        for name, values in rows.items():
            print(f"  {name:40s}" + "".join("       -" if v is None else f"{v:8.3g}" for v in values))


def _in_process(*arguments: str, flags: str = "") -> dict:
    """`everything` in a process with its own settings of XLA; small systems are solved on one thread."""
    own = {"XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {flags}".strip(), "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, __file__, *arguments]
    done = subprocess.run(command, env=os.environ | own, stdout=subprocess.PIPE, check=True, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    """Measure, save, draw, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer solvers and tolerances; saves nothing")
    parser.add_argument("--print", choices=("all", "times"), help="measure here and print rows as JSON")
    given = parser.parse_args()
    if given.print:
        wa.configure()
        print(json.dumps(everything(given.quick, given.print == "all")))
        return
    quick = ["--quick"] if given.quick else []
    found, plain = _in_process("--print=all", *quick), _in_process("--print=times", *quick, flags=PLAIN)
    for problem, rows in plain.items():
        for name, timed in rows.items():
            for row, known in zip(timed, found[problem][name], strict=True):
                row["error"] = known["error"]
        rows["un-reduced DOP853"] = found[problem]["un-reduced DOP853"]
    tables = {"configured": ratios(found, "package"), "XLA's own choices": ratios(plain, "package")}
    within = ratios(found, "package, within a program")
    runs = {"configured": found, "XLA's own choices": plain}
    kept = {"levels": LEVELS, "flags": PLAIN, "ratios": tables, "within a program": within, "runs": runs}
    if not given.quick:
        draw(found, plain, measure.save("work_precision", kept).with_suffix(".svg"))
    for name, dynamics in tables.items():
        print(f"\n{name.upper()}")
        tabulate(dynamics, "package")
    print("\nCONFIGURED, WITHIN A PROGRAM")
    shown = ("bare loop", "Newton, within a program")
    chosen = {problem: {name: rows[name] for name in shown} for problem, rows in within.items()}
    tabulate(chosen, "package, within a program")


if __name__ == "__main__":
    main()
