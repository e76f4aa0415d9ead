"""Does a law hold? Perturbed objects, executed open loop and in closed loop, and what the model says of them.

    python benchmarks/feedback.py [--count 20] [--open-count 20] [--scenes heptagon hexagon] [--quick]

Two sets: friction of each link within 20 %, and that together with mass within 10 %, vertices within 0.5 mm and the
start within 1 mm; for each a law is designed. Both loops see the same objects, the open one fewer of them if wanted;
success is within 0.5 mm and 0.01 rad of each object's own path end, the last contacts closed. The closed loop samples
at 1 kHz, 1 ms late, with encoders of 4096 counts and 1 % of torque noise. The hexagon's flip begins at a limit of its
motors, with which no law holds either set (it is executed all the same), so that it is here with stronger ones, too.

Beside each execution stands what `check` predicts of that object: whether it arrives with every contact kept, and the
least force. Each law's certificate, the margin that it is designed with, stands beside the least margin of objects that
are drawn from its set, those at the corners of friction and mass among them. And how many objects a second `check`
does under the law, over how many open loop. Results of scenes that are not run stay.
"""

import argparse
import itertools
import time

import equinox as eqx
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from measure import RESULTS, kept, save

import wholearm_jax as wa
from wholearm_jax.core import Status
from wholearm_jax.ensembles import make_ensemble, wilson_interval
from wholearm_jax.execution import Amounts, ExecutionOutcome, Hardware, TrialsResult, run_trials
from wholearm_jax.plotting import LINK_COLOURS as COLOURS

SCENES = ("heptagon", "hexagon", "hexagon, 2 N m", "tipping", "box", "flight", "passage")
SETS = {
    "friction": Amounts(friction=0.2),
    "friction, mass, vertices, start": Amounts(friction=0.2, mass=0.1, geometry=5e-4, start=1e-3),
}
DRAWN = 48  # objects of each law's set, beside the corners
CHECKED, TURNS = 256, 5  # objects that are checked at once, both ways in turn


def load(name: str) -> wa.Scene:
    """Load a bundled scene, `NAME` or `NAME, TORQUE_LIMIT N m`."""
    name, *limit = name.removesuffix(" N m").split(", ")
    scene = wa.load(name)
    if limit:
        scene = eqx.tree_at(lambda s: s.hand.torque_limit, scene, jnp.full(2, float(limit[0])))
    return scene


def measure_one(name: str, counts: dict[str, int], workers: int | None) -> dict:
    """Both sets and both loops on one plan."""
    scene = load(name)
    optimum = wa.optimise(scene)
    forces = np.concatenate([course.cn.ravel() for course in wa.trajectory(optimum.result)])
    found = {"mean_force": float(np.mean(forces[forces > 0]))}
    for label, amounts in SETS.items():
        begun = time.perf_counter()
        controller = wa.feedback(
            scene, optimum.torque, friction=amounts.friction, mass=amounts.mass, shape=amounts.geometry or None
        )
        row = {"design_seconds": time.perf_counter() - begun, "margins": [law.margin for law in controller.phases]}
        for loop, law in (("open", None), ("closed", controller)):
            settings = {"workers": workers, "controller": law, "hardware": Hardware()}
            trials = run_trials(optimum.result, counts[loop], amounts, **settings)
            row[loop] = summary(trials, predicted([run.scene for run in trials.runs], optimum.torque, law))
            print(f"{name}, {label}, {loop} loop: {trials.message}; {row[loop]['agree']} as predicted", flush=True)
        row["sampled_margin"] = sampled_margin(scene, controller, amounts)
        row["relative_rate"] = relative_rate(scene, optimum.torque, controller)
        found[label] = row
    return found


def predicted(scenes: list[wa.Scene], torque: wa.TorqueSchedule, law: wa.Controller | None):
    """What the model says of objects: status and margin of each, under the law or else open loop."""
    return wa.check(scenes, torque) if law is None else wa.check(scenes, controller=law)


def summary(trials: TrialsResult, model) -> dict:
    """What became of executions, beside the model's prediction."""
    count, runs = len(trials.runs), trials.runs
    holds = [run.own_ending is ExecutionOutcome.OK and run.least_force > 0 for run in runs]
    foreseen = np.asarray(model.status) == Status.OK
    return {
        "executions": count,
        "successes": trials.own_successes,
        "without_own_end": sum(run.own_target is None for run in runs),
        "nominal_successes": trials.successes,
        "interval_95": list(wilson_interval(trials.own_successes, count)),
        "median_position_error": float(np.nanmedian([run.own_position_error for run in runs])),
        "endings": [run.own_ending.value for run in runs],
        "least_forces": [run.least_force if np.isfinite(run.least_force) else None for run in runs],
        "predicted": [Status(int(status)).name.lower() for status in model.status],
        "predicted_margins": [float(margin) if np.isfinite(margin) else None for margin in model.margin],
        "agree": int(np.sum(np.array(holds) == foreseen)),
    }


def sampled_margin(scene: wa.Scene, controller: wa.Controller, amounts: Amounts) -> float:
    """Return the least margin under a law of objects from its set: drawn ones, and those at the corners."""
    friction, mass = f"{100 * amounts.friction!r}%", f"{100 * amounts.mass!r}%"
    ensemble = make_ensemble(scene, {"friction": friction, "mass": mass, "vertices": amounts.geometry}, seed=1)
    scenes = [ensemble.draw(k) for k in range(DRAWN)]
    for signs in itertools.product((-1, 1), repeat=4):
        slip = scene.object.friction * (1 + amounts.friction * np.array(signs[:3]))
        mass = scene.object.mass * (1 + amounts.mass * signs[3])
        scenes.append(eqx.tree_at(lambda s: (s.object.friction, s.object.mass), scene, (slip, mass)))
    margins = np.asarray(wa.check(scenes, controller=controller).margin)
    return float(np.nanmin(margins))


def relative_rate(scene: wa.Scene, torque: wa.TorqueSchedule, controller: wa.Controller) -> float:
    """Return how many objects `check` does under a law in the time of one open loop, warm."""
    ensemble = make_ensemble(scene, {"friction": "1%"})
    scenes = [ensemble.draw(k) for k in range(CHECKED)]
    seconds = np.zeros((1 + TURNS, 2))
    for row in seconds:
        begun = time.perf_counter()
        wa.check(scenes, torque)
        between = time.perf_counter()
        wa.check(scenes, controller=controller)
        row[:] = between - begun, time.perf_counter() - between
    return float(np.median(seconds[1:, 0] / seconds[1:, 1]))


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
    parser.add_argument("--count", type=int, default=20, help="executions of each plan and set")
    parser.add_argument("--open-count", type=int, help="those in open loop, if fewer")
    parser.add_argument("--scenes", nargs="+", default=SCENES)
    parser.add_argument("--workers", type=int, help="processes (default: one for each processor)")
    parser.add_argument("--quick", action="store_true", help="one execution each; nothing is written")
    options = parser.parse_args()
    count = 1 if options.quick else options.count
    counts = {"closed": count, "open": min(count, options.open_count or count)}
    found = {}
    for name in options.scenes:
        found[name] = measure_one(name, counts, options.workers)
        if not options.quick:  # as they come, for it takes long
            results = kept("feedback") | found
            save("feedback", {name: results[name] for name in SCENES if name in results})
    for name, row in found.items():
        for label in SETS:
            one = row[label]
            print(
                f"{name}, {label}: certificate {min(one['margins']):.3f} N, sampled {one['sampled_margin']:.3f} N,"
                f" checked at {one['relative_rate']:.2f} of open loop's rate"
            )
    if not options.quick:
        draw(kept("feedback")).savefig(RESULTS / "feedback.svg", bbox_inches="tight")


if __name__ == "__main__":
    main()
