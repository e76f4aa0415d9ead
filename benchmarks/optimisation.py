"""Optimisers side by side: the package's descent, direct collocation with IPOPT, and the paper's search by 10 %.

    python benchmarks/optimisation.py [--quick] [--knots N] [--references]

The same plans for all: both bundled ones at 1.0, 0.3 and 0.15 s a phase, and a dozen on random polygons
(`random_plans`) at 1.0 and 0.3 s; the search chooses its own durations. Every margin is that of the package's own
simulation of the torques found, and a plan fails unless that simulation's status is `ok`. Times are warm: `optimise`
and `search_by_steps` run twice and the second run counts, tracing included. `optimise` descends on a plan's phases
side by side
on all processors, IPOPT solves them one after the other: `processor` seconds, of both processors together, stand beside
the others. Of the collocation only IPOPT's own time counts: for all solves from the guess that led to the result, and
for the best of these solves alone; what building its programmes took stands beside it. The reference is the largest
margin that collocation finds at any cost (`collocation.best_known`), with finer intervals and from several starts.
References take long, but not each time: they are kept in `results/references.json` for as long as a phase's bound stays
the same, and `--references` finds those that are missing and does nothing else.
"""

import argparse
import json
import statistics
import time
from dataclasses import asdict, dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import measure
import numpy as np
from collocation import CONVERGED, Collocated, best_known, collocate
from layered_scenes import layered
from matplotlib import pyplot as plt
from random_plans import random_plans

import wholearm_jax as wa
from wholearm_jax.optimisation import DEFAULT_KNOTS

BUNDLED, RANDOM = (1.0, 0.3, 0.15), (1.0, 0.3)  # durations of a phase [s]
PLANS, SEED = 12, 0
NEAR = 0.99  # share of the reference that counts as equal


@dataclass(frozen=True)
class PhaseRow:
    """One phase: margins [N] and statuses of every contender.

    `claimed` is the least force at the collocation points, `nearly` says whether the collocation's motion fails only
    because it arrives inexactly.
    """

    phase: str
    bound: float
    optimise: float
    optimise_status: str
    collocation: float
    collocation_status: str
    claimed: float
    nearly: bool
    missed: float
    ipopt: str
    iterations: int
    guesses: int
    search: float
    search_status: str
    reference: float | None = None

    @property
    def best(self) -> float:
        """The largest margin that a simulation confirms [N]."""
        held = self.collocation if self.collocation_status == "ok" else -np.inf
        return max(held, self.reference or -np.inf)


@dataclass(frozen=True)
class Case:
    """One plan at one duration [s] of each phase: seconds by contender, simulations of the search, phases."""

    plan: str
    duration: float
    optimise_seconds: float
    optimise_processor: float
    ipopt_seconds: float
    best_solve_seconds: float
    build_seconds: float
    search_seconds: float
    simulations: int
    phases: tuple[PhaseRow, ...]


def main() -> None:
    wa.configure()
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="bundled plans and four random ones, 1.0 s; saves nothing")
    parser.add_argument(
        "--knots", type=int, default=DEFAULT_KNOTS, help="torques a joint and phase, for both optimisers"
    )
    parser.add_argument("--references", action="store_true", help="only find the references that are missing")
    chosen = parser.parse_args()
    if chosen.references:
        return find_references(chosen.knots)
    cases = []
    for plan, scene, durations in _plans(chosen.quick):
        wa.search_by_steps(scene)
        searched = wa.search_by_steps(scene)
        for duration in durations:
            cases.append(_case(plan, _lasting(scene, duration), chosen.knots, searched))
            _print(cases[-1])
    summary = _summary(cases)
    print(json.dumps(summary, indent=1))
    if not chosen.quick:
        name = "optimisation" if chosen.knots == DEFAULT_KNOTS else f"optimisation_{chosen.knots}_knots"
        rows = [asdict(case) for case in cases]
        measure.save(name, {"knots": chosen.knots, "summary": summary, "cases": rows})
        draw(cases, measure.RESULTS / f"{name}.svg")


def _plans(quick: bool):
    """Name, scene and durations of every plan."""
    for name in ("heptagon", "hexagon"):
        yield name, layered(name), BUNDLED[:1] if quick else BUNDLED
    for number, scene in enumerate(random_plans(4 if quick else PLANS, SEED)):
        yield f"random {number}", scene, RANDOM[:1] if quick else RANDOM


# --- the contenders ---------------------------------------------------------------------------------------------------


def _lasting(scene: wa.Scene, duration: float) -> wa.Scene:
    """The plan with one duration [s] for every phase."""
    lengths = [jnp.asarray(duration)] * len(scene.phases)
    return eqx.tree_at(lambda s: [phase.duration for phase in s.phases], scene, lengths)


def _optimised(scene: wa.Scene, knots: int):
    """`optimise`, warm: what it found, its seconds, and those of all processors together."""
    wa.optimise(scene, knots=knots)
    begun, busy = time.perf_counter(), time.process_time()
    found = wa.optimise(scene, knots=knots)
    jax.block_until_ready(found.torque)
    return found, time.perf_counter() - begun, time.process_time() - busy


def _case(plan: str, scene: wa.Scene, knots: int, searched) -> Case:
    """Run both optimisers on one plan."""
    descended, taken, busy = _optimised(scene, knots)
    duration = float(scene.phases[0].duration)
    collocated = [collocate(at.dynamics, duration, knots=knots) for at in wa.trace(scene)]
    stored = _references()
    known = [
        _recalled(stored, _key(plan, duration, phase.name, knots), float(top.value))
        for phase, top in zip(scene.phases, descended.bounds, strict=True)
    ]
    contenders = (descended.result.phases, descended.bounds, collocated, searched.result.phases, known)
    return Case(
        plan=plan,
        duration=duration,
        optimise_seconds=taken,
        optimise_processor=busy,
        ipopt_seconds=sum(one.solve for one in collocated),
        best_solve_seconds=sum(one.best_solve for one in collocated),
        build_seconds=sum(one.build for one in collocated),
        search_seconds=searched.seconds,
        simulations=searched.simulations,
        phases=tuple(_row(*each) for each in zip(*contenders, strict=True)),
    )


def _row(descended, bound, collocated: Collocated, searched, reference: float | None) -> PhaseRow:
    return PhaseRow(
        phase=descended.name,
        bound=float(bound.value),
        optimise=descended.margin,
        optimise_status=descended.status.label,
        collocation=collocated.margin,
        collocation_status=collocated.assessment if collocated.ipopt in CONVERGED else collocated.ipopt,
        claimed=collocated.course.least,
        nearly=collocated.nearly,
        missed=collocated.missed,
        ipopt=collocated.ipopt,
        iterations=collocated.iterations,
        guesses=collocated.guesses,
        search=searched.margin,
        search_status=searched.status.label,
        reference=reference,
    )


# --- references -------------------------------------------------------------------------------------------------------

ENOUGH = 0.998  # share of the bound at which nothing better is looked for
REFERENCES = measure.RESULTS / "references.json"


def find_references(knots: int) -> None:
    """Find and keep the references that are missing, one after the other."""
    for plan, scene, durations in _plans(False):
        traced = wa.trace(scene)
        for duration in durations:
            tops = wa.bounds(_lasting(scene, duration), traced=traced)
            for phase, at, top in zip(scene.phases, traced, tops, strict=True):
                key, bound, stored = _key(plan, duration, phase.name, knots), float(top.value), _references()
                if _recalled(stored, key, bound) is not None:
                    continue
                coarse = collocate(at.dynamics, duration, knots=knots)
                found = best_known(at.dynamics, duration, coarse, enough=ENOUGH * bound)
                stored[key] = {"bound": bound, "margin": found.margin if found.succeeded else None}
                REFERENCES.parent.mkdir(exist_ok=True)
                REFERENCES.write_text(json.dumps(stored, indent=1) + "\n")
                print(f"{key}: {found.margin:.4f} {found.assessment} of {bound:.4f}", flush=True)


def _key(plan: str, duration: float, phase: str, knots: int) -> str:
    return f"{plan}, {duration:g} s, {phase}, {knots} knots"


def _references() -> dict[str, dict[str, float | None]]:
    return json.loads(REFERENCES.read_text()) if REFERENCES.exists() else {}


def _recalled(stored, key: str, bound: float) -> float | None:
    """A reference [N], unless there is none or it belongs to another path."""
    one = stored.get(key)
    same = one is not None and abs(one["bound"] - bound) <= 1e-6 * abs(bound)
    return one["margin"] if same else None


# --- what is reported -------------------------------------------------------------------------------------------------


def _print(case: Case) -> None:
    times = f"{case.optimise_seconds:.2f} s against {case.ipopt_seconds:.2f} s (+ {case.build_seconds:.1f} s building)"
    print(f"{case.plan}, {case.duration} s a phase: {times}; search {case.search_seconds:.2f} s")
    for row in case.phases:
        reference = "" if row.reference is None else f", best known {row.reference:.4f}"
        print(
            f"    {row.phase:12s} bound {row.bound:.4f}{reference}: optimise {row.optimise:.4f} {row.optimise_status}, "
            f"collocation {row.collocation:.4f} {row.collocation_status} (claims {row.claimed:.4f}), "
            f"search {row.search:.4f} {row.search_status}",
            flush=True,
        )


def _summary(cases: list[Case]) -> dict:
    """Counts of failures, shares of the bound and of the reference, and ratios of times."""
    rows = [row for case in cases for row in case.phases]
    held = [row for row in rows if row.optimise_status == "ok"]
    against = [row.optimise / row.best for row in held if row.best > 0]
    searched = _searched(cases)
    at_one = [row for case in cases if case.duration == 1.0 for row in case.phases if row.optimise_status == "ok"]
    return {
        "phases": len(rows),
        "failed": {
            "optimise": len(rows) - len(held),
            "collocation": sum(row.collocation_status != "ok" for row in rows),
            "collocation, arrival within 1e-3 allowed": sum(not row.nearly for row in rows),
            "IPOPT itself": sum(row.ipopt not in CONVERGED for row in rows),
        },
        "phases searched": len(searched),
        "failed in the search": sum(row.search_status != "ok" for row in searched),
        "optimise / best known": _spread(against),
        f"phases below {NEAR} of the best known": sum(share < NEAR for share in against),
        "optimise / bound": _spread([row.optimise / row.bound for row in held]),
        "optimise / bound at 1.0 s": _spread([row.optimise / row.bound for row in at_one]),
        "collocation / bound": _spread([r.collocation / r.bound for r in rows if r.collocation_status == "ok"]),
        "search / bound": _spread([r.search / r.bound for r in searched if r.search_status == "ok"]),
        "seconds of optimise / IPOPT's best solves": _spread(
            [case.optimise_seconds / case.best_solve_seconds for case in cases]
        ),
        "seconds of optimise / IPOPT": _spread([case.optimise_seconds / case.ipopt_seconds for case in cases]),
        "processor seconds of optimise / IPOPT": _spread(
            [case.optimise_processor / case.ipopt_seconds for case in cases]
        ),
        "seconds of optimise / IPOPT and building": _spread(
            [case.optimise_seconds / (case.ipopt_seconds + case.build_seconds) for case in cases]
        ),
        "seconds of search / optimise": _spread([case.search_seconds / case.optimise_seconds for case in cases]),
    }


def _searched(cases: list[Case]) -> list[PhaseRow]:
    """The phases of one case a plan, the first: the search chooses its own durations, and runs once."""
    once = {case.plan: case for case in reversed(cases)}
    return [row for case in once.values() for row in case.phases]


def _spread(values: list[float]) -> dict[str, float] | None:
    if not values:
        return None
    return {"least": min(values), "median": statistics.median(values), "largest": max(values)}


COLOURS = {"optimise": "#0072B2", "collocation": "#D55E00", "best known": "#222222", "search": "#009E73"}
STYLES = {"optimise": "-", "collocation": "--", "best known": ":", "search": "-."}


def draw(cases: list[Case], path) -> None:
    """Left: phases that hold with at most a given loss against the bound; right: plans done within a given time."""
    rows = [row for case in cases for row in case.phases]
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 3.8), sharey=True, layout="constrained")
    losses = {
        "optimise": [1 - r.optimise / r.bound if r.optimise_status == "ok" else np.inf for r in rows],
        "collocation": [1 - r.collocation / r.bound if r.collocation_status == "ok" else np.inf for r in rows],
        "search": [1 - r.search / r.bound if r.search_status == "ok" else np.inf for r in _searched(cases)],
    }
    if any(row.reference for row in rows):
        losses["best known"] = [1 - r.best / r.bound if r.best > 0 else np.inf for r in rows]
    for name, values in losses.items():
        _steps(left, np.maximum(values, LEAST_LOSS), (LEAST_LOSS, 1.0), COLOURS[name], STYLES[name], name)
    left.set_xlabel("margin lost against the bound, 1 - margin / bound")
    left.set_ylabel("share of phases or plans [%]")
    times = {
        "optimise": ("optimise", [case.optimise_seconds for case in cases]),
        "collocation": ("collocation", [case.ipopt_seconds for case in cases]),
        "collocation, with building": ("best known", [case.ipopt_seconds + case.build_seconds for case in cases]),
        "search": ("search", [case.search_seconds for case in cases]),
    }
    every = np.concatenate([values for _, values in times.values()])
    for label, (name, values) in times.items():
        colour = COLOURS["collocation"] if label.startswith("coll") else COLOURS[name]
        _steps(right, values, (every.min() / 1.5, every.max() * 1.5), colour, STYLES[name], label)
    right.set_xlabel("wall time of a plan, warm [s]")
    lines = {line.get_label(): line for ax in (left, right) for line in ax.lines}
    figure.legend(lines.values(), lines.keys(), loc="outside upper center", ncols=len(lines), frameon=False, fontsize=8)
    figure.savefig(path)
    plt.close(figure)


LEAST_LOSS = 1e-4  # losses below this are drawn there


def _steps(ax, values, limits: tuple[float, float], colour: str, style, label: str) -> None:
    """The share of values up to each value, as a staircase over a logarithmic axis."""
    values = np.sort(values)
    shown = values[np.isfinite(values)]
    share = 100 * np.arange(1, len(shown) + 1) / len(values)
    x = np.concatenate([[limits[0]], shown, [limits[1]]])
    y = np.concatenate([[0.0], share, share[-1:] if len(share) else [0.0]])
    ax.step(x, y, where="post", color=colour, linestyle=style, lw=1.8, label=label)
    ax.set_xscale("log")
    ax.set_xlim(*limits)
    ax.set_ylim(0, 103)
    ax.grid(True, which="major", color="#DDDDDD", lw=0.6)
    ax.spines[["top", "right"]].set_visible(False)


if __name__ == "__main__":
    main()
