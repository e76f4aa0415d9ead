"""Executions on free bodies approach the prediction as contacts harden and time steps shrink.

    python benchmarks/execution.py [--quick]

Both bundled plans, 1 s a phase, under the torques of `tests/data`. In the first study the time constant of the contacts
is three time steps throughout, in the second the time step stays at 50 us while the contacts soften. Reported: the
largest distance of the centre of mass from its predicted place over the whole plan, and that at the end.
"""

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from layered_scenes import layered
from measure import RESULTS, save

import wholearm_jax as wa
from wholearm_jax.execution import ContactCompliance, execute
from wholearm_jax.plotting import LINK_COLOURS as COLOURS

DATA = Path(__file__).parents[1] / "tests" / "data"
SCENES = ("heptagon", "hexagon")
STEPS = (8e-4, 4e-4, 2e-4, 1e-4, 5e-5, 2.5e-5)  # [s]; the contacts are three steps soft
FINE, CONSTANTS = 5e-5, (1.5e-4, 3e-4, 6e-4, 1.2e-3, 2.4e-3, 4.8e-3)  # [s]
STUDIES = {"timestep": "time step, $t_c$ three steps [ms]", "time_constant": "contacts' time constant $t_c$ [ms]"}


def measure_one(prediction, timestep: float, softness: ContactCompliance) -> dict:
    """One execution: errors in metres and radians."""
    done = execute(prediction, timestep=timestep, softness=softness)
    times, expected = done.expected.time, done.expected.z
    off = [np.interp(times, done.course.time, done.course.z[:, k]) - expected[:, k] for k in range(2)]
    return {
        "ending": done.ending.value,
        "worst": float(np.hypot(*off).max()),
        "end_position": done.position_error,
        "end_angle": abs(done.angle_error),
    }


def study(prediction, *, quick: bool) -> dict[str, list[dict]]:
    """Both studies of one plan."""
    steps, constants = (STEPS[1:4], CONSTANTS[2:5]) if quick else (STEPS, CONSTANTS)
    fine = 2e-4 if quick else FINE
    return {
        "timestep": [{"at": h, **measure_one(prediction, h, ContactCompliance())} for h in steps],
        "time_constant": [
            {"at": t, **measure_one(prediction, fine, ContactCompliance(time_constant=t / fine))} for t in constants
        ],
    }


def draw(found: dict) -> plt.Figure:
    """Deviations against time step and time constant, with a line of first order."""
    figure, axes = plt.subplots(1, 2, figsize=(8.4, 3.6), sharey=True, layout="constrained")
    for ax, (name, label) in zip(axes, STUDIES.items(), strict=True):
        for colour, (scene, studies) in zip(COLOURS, found.items(), strict=False):
            at = [1e3 * row["at"] for row in studies[name]]
            for key, style, what in (("worst", "o-", "largest over the plan"), ("end_position", "s--", "at the end")):
                values = [1e3 * row[key] if row["ending"] != "diverged" else np.nan for row in studies[name]]
                ax.loglog(at, values, style, color=colour, ms=4, lw=1.3, label=f"{scene}, {what}")
        line = np.array([min(at), max(at)])
        middle = 1e3 * next(iter(found.values()))[name][len(at) // 2]["worst"]
        ax.loglog(line, 1.6 * middle * line / at[len(at) // 2], color="#999999", lw=0.8, label="first order")
        ax.set_xticks(at, [f"{value:g}" for value in at])
        ax.set_xticks([], minor=True)
        ax.set_xlabel(label)
        ax.spines[["top", "right"]].set_visible(False)
    axes[0].axhline(0.5, color="#222222", lw=0.8, ls=":")
    axes[1].axhline(0.5, color="#222222", lw=0.8, ls=":", label="0.5 mm")
    axes[0].set_ylabel("distance from the prediction [mm]")
    axes[1].legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def main() -> None:
    wa.configure()
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="fewer and coarser executions; nothing is written")
    quick = parser.parse_args().quick
    found = {}
    for scene in SCENES:
        prediction = wa.simulate(layered(scene), wa.read_torque(DATA / f"{scene}_torque.csv"))
        found[scene] = study(prediction, quick=quick)
        for name, rows in found[scene].items():
            print(f"{scene}: {name} [s], worst [mm], end [mm], end [rad]")
            for row in rows:
                errors = f"{1e3 * row['worst']:8.4f} {1e3 * row['end_position']:8.4f} {row['end_angle']:9.2e}"
                print(f"  {row['at']:8.2e} {errors}  {row['ending']}")
    if not quick:
        save("execution", found)
        draw(found).savefig(RESULTS / "execution.svg", bbox_inches="tight")


if __name__ == "__main__":
    main()
