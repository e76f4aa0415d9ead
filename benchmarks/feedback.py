"""Open loop beside closed loop: how many executions of perturbed objects succeed, on the bundled plans.

    python benchmarks/feedback.py [--count 20] [--scenes heptagon hexagon] [--quick]

Two sets: friction of each link within 20 %, and that together with mass within 10 %, vertices within 0.5 mm and the
start within 1 mm. Both loops see the same objects; success is within 0.5 mm and 0.01 rad of each object's own path
end, the last contacts closed. The closed loop samples at 1 kHz, 1 ms late, with encoders of 4096
counts and 1 % of torque noise. The hexagon's flip begins at a limit of its motors, with which no law holds either set
(it is executed all the same), so that it is here with stronger ones, too. Results of scenes that are not run stay.
"""

import argparse
import time

import equinox as eqx
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from measure import RESULTS, kept, save

import wholearm_jax as wa
from wholearm_jax.ensembles import wilson_interval
from wholearm_jax.execution import Amounts, Hardware, run_trials
from wholearm_jax.plotting import LINK_COLOURS as COLOURS

SCENES = ("heptagon", "hexagon", "hexagon, 2 N m", "tipping", "box", "flight", "passage")
SETS = {
    "friction": Amounts(friction=0.2),
    "friction, mass, vertices, start": Amounts(friction=0.2, mass=0.1, geometry=5e-4, start=1e-3),
}
MASS = 0.1  # half width of the mass that laws are designed for


def load(name: str) -> wa.Scene:
    """Load a bundled scene, `NAME` or `NAME, TORQUE_LIMIT N m`."""
    name, *limit = name.removesuffix(" N m").split(", ")
    scene = wa.load(name)
    if limit:
        scene = eqx.tree_at(lambda s: s.hand.torque_limit, scene, jnp.full(2, float(limit[0])))
    return scene


def measure_one(name: str, count: int, workers: int | None) -> dict:
    """Both loops on one plan."""
    scene = load(name)
    optimum = wa.optimise(scene)
    begun = time.perf_counter()
    controller = wa.feedback(scene, optimum.torque, mass=MASS)
    found = {"design_seconds": time.perf_counter() - begun, "margins": [phase.margin for phase in controller.phases]}
    for label, amounts in SETS.items():
        found[label] = {}
        for loop, more in (("open", {}), ("closed", {"controller": controller, "hardware": Hardware()})):
            trials = run_trials(optimum.result, count, amounts, workers=workers, **more)
            found[label][loop] = {
                "executions": count,
                "successes": trials.own_successes,
                "nominal_successes": trials.successes,
                "interval_95": list(wilson_interval(trials.own_successes, count)),
                "median_position_error": float(np.nanmedian([run.own_position_error for run in trials.runs])),
                "endings": [run.own_ending.value for run in trials.runs],
            }
            print(f"{name}, {label}, {loop} loop: {trials.message}", flush=True)
    return found


def draw(found: dict) -> plt.Figure:
    """Success rates of both loops with their intervals."""
    figure, axes = plt.subplots(1, len(SETS), figsize=(8.4, 3.2), sharey=True, layout="constrained")
    for ax, label in zip(axes, SETS, strict=True):
        for k, loop in enumerate(("open", "closed")):
            rows = [plan[label][loop] for plan in found.values()]
            rate = np.array([row["successes"] / row["executions"] for row in rows])
            low, high = np.array([row["interval_95"] for row in rows]).T
            at, error = np.arange(len(rows)) + 0.36 * (k - 0.5), np.maximum(np.stack([rate - low, high - rate]), 0)
            ax.bar(at, 100 * rate, 0.34, yerr=100 * error, color=COLOURS[k], label=f"{loop} loop", capsize=2)
        ax.set_xticks(range(len(found)), list(found), rotation=25, ha="right", fontsize=8)
        ax.set_title(label, fontsize=9)
        ax.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("executions that succeed [%]")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False, fontsize=8)
    return figure


def main() -> None:
    wa.configure()
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=20, help="executions of each plan, set and loop")
    parser.add_argument("--scenes", nargs="+", default=SCENES)
    parser.add_argument("--workers", type=int, help="processes (default: one for each processor)")
    parser.add_argument("--quick", action="store_true", help="one execution each; nothing is written")
    options = parser.parse_args()
    count = 1 if options.quick else options.count
    found = {name: measure_one(name, count, options.workers) for name in options.scenes}
    if not options.quick:
        found = kept("feedback") | found
        found = {name: found[name] for name in SCENES if name in found}
        save("feedback", found)
        draw(found).savefig(RESULTS / "feedback.svg", bbox_inches="tight")


if __name__ == "__main__":
    main()
