r"""What the gradient of a phase's margin costs, and how exact it is.

    python benchmarks/gradients.py [--quick]

The margin of one phase (move, then score) and its derivatives with respect to the torques at `n` knots, `2 n` numbers:

    forward   `jax.jacfwd` through the solve, all directions at once
    reverse   `jax.value_and_grad` back over the steps that the solve took, each computed once more
    direct    `jax.value_and_grad` through a solve that keeps every step (`adjoint=Adjoint.BOTH`)

Times are those of value and gradient together, as multiples of the margin alone, warm and in turn; compile times are
fresh ones. The schedule is a straight line however many knots describe it, so that the motion is always the same.
Errors are against central differences, extrapolated twice (Richardson) at a tolerance of 1e-13; their own error is what
two step sizes differ by.
"""

import argparse
import time
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import measure
import numpy as np
from layered_scenes import layered

import wholearm_jax as wa
from wholearm_jax.margin import minimum_margin
from wholearm_jax.model import TorqueSchedule, pad_schedule, restrict_to_phase
from wholearm_jax.simulation import simulate_motion

HERE = Path(__file__).parent
KNOTS = (4, 8, 16, 32, 64, 128)
ADJOINTS = {"forward": "forward", "reverse": "reverse", "direct": "both"}
TOLERANCES = tuple(10.0**-k for k in range(4, 13))
CHECKED = 8  # knots of the schedule whose gradients are checked
STEPS = (3e-3, 1e-3)  # largest steps of the differences [N m]
WEAKER = 0.97  # share of the torques there: at the whole slide two contacts are least in turn, within those steps
SHOWN = {"forward": ("#0072B2", "o"), "reverse": ("#D55E00", "^"), "direct": ("#009E73", "s")}


def given(phase: int, knots: int) -> TorqueSchedule:
    """The phase's straight-line schedule, from its own start, at a number of knots."""
    line = wa.read_torque(HERE / "data" / "heptagon_ramps.csv")
    times, values = np.asarray(line.times), np.asarray(line.values)
    rows = np.flatnonzero((times >= phase) & (times <= phase + 1))[-2:] if phase else np.array([0, 1])
    share = np.linspace(0.0, 1.0, knots)[:, None]
    return TorqueSchedule(
        jnp.asarray(share[:, 0]), jnp.asarray(values[rows[0]] * (1 - share) + values[rows[1]] * share)
    )


def margin(values, times, dynamics, duration, options: wa.IntegratorOptions):
    """The margin of one phase."""
    phase_schedule = restrict_to_phase(pad_schedule(TorqueSchedule(times, values)), jnp.zeros(()), duration)
    return minimum_margin(
        dynamics,
        phase_schedule,
        duration,
        simulate_motion(dynamics, phase_schedule, duration, options=options),
        options,
    ).margin


def programs(times, values, dynamics) -> dict[str, tuple]:
    """For the value alone and each mode: a compiled program of (values, tolerance), and the seconds it took to make."""
    duration = jnp.ones(())

    def function(adjoint):
        return lambda v, tolerance: margin(
            v, times, dynamics, duration, wa.IntegratorOptions(tolerance=tolerance, adjoint=adjoint)
        )

    def forward(v, tolerance):
        value = function("forward")
        slope, there = jax.jacfwd(lambda v: (value(v, tolerance),) * 2, has_aux=True)(v)
        return there, slope

    whole = {"value": function("none"), "forward": forward}
    whole |= {name: jax.value_and_grad(function(ADJOINTS[name])) for name in ("reverse", "direct")}
    made = {}
    for name, call in whole.items():
        begun = time.perf_counter()
        compiled = jax.jit(call).lower(values, jnp.asarray(1e-10)).compile()
        made[name] = compiled, time.perf_counter() - begun
    return made


def costs(dynamics, phase: int, counts, repeats: int) -> list[dict]:
    """Run and compile times over the number of knots."""
    rows = []
    for knots in counts:
        torque = given(phase, knots)
        made = programs(torque.times, torque.values, dynamics)
        at = (torque.values, jnp.asarray(1e-10))
        times = measure.compare({name: partial(call, *at) for name, (call, _) in made.items()}, repeats=repeats)
        row = {"knots": knots, "seconds": times, "compile": {name: seconds for name, (_, seconds) in made.items()}}
        rows.append(row | {"multiple": {name: times[name] / times["value"] for name in ADJOINTS}})
    return rows


def richardson(function, largest: float) -> float:
    """Central differences at three steps, extrapolated twice."""
    first, second, third = ((function(h) - function(-h)) / (2 * h) for h in (largest, largest / 2, largest / 4))
    return (16 * (4 * third - second) / 3 - (4 * second - first) / 3) / 15


def differences(call, values) -> tuple[np.ndarray, float]:
    """The gradient by differences, and the largest disagreement of two step sizes against its largest entry."""
    tolerance, found = jnp.asarray(1e-13), []
    for largest in STEPS:
        slope = np.zeros(values.shape)
        for at in np.ndindex(values.shape):
            slope[at] = richardson(lambda h, at=at: float(call(values.at[at].add(h), tolerance)), largest)
        found.append(slope)
    return found[1], float(np.abs(found[0] - found[1]).max() / np.abs(found[1]).max())


def accuracy(dynamics, phase: int, tolerances, repeats: int) -> dict:
    """Gradient errors and times over tolerances."""
    torque = given(phase, CHECKED)
    torque = TorqueSchedule(torque.times, WEAKER * torque.values)
    made = {name: call for name, (call, _) in programs(torque.times, torque.values, dynamics).items()}
    true, doubt = differences(made["value"], torque.values)
    rows = []
    for tolerance in tolerances:
        at = (torque.values, jnp.asarray(tolerance))
        times = measure.compare({name: partial(made[name], *at) for name in ADJOINTS}, repeats=repeats)
        for name, seconds in times.items():
            wrong = float(np.abs(np.asarray(made[name](*at)[1]) - true).max() / np.abs(true).max())
            rows.append({"mode": name, "tolerance": tolerance, "error": wrong, "seconds": seconds})
    return {"doubt": doubt, "rows": rows}


def draw(found: dict, path: Path) -> None:
    """Cost over knots, and error against time."""
    plt.rcParams |= {"font.size": 8, "axes.spines.top": False, "axes.spines.right": False, "svg.fonttype": "none"}
    figure, axes = plt.subplots(2, len(found), figsize=(7.2, 5.4), sharey="row", layout="constrained", squeeze=False)
    for (name, result), (above, below) in zip(found.items(), axes.T, strict=True):
        rows = result["costs"]
        for mode, (colour, marker) in SHOWN.items():
            look = {"color": colour, "marker": marker, "ms": 4, "lw": 1.2}
            above.loglog([r["knots"] for r in rows], [r["multiple"][mode] for r in rows], label=mode, **look)
            mine = [r for r in result["accuracy"]["rows"] if r["mode"] == mode]
            below.loglog([r["error"] for r in mine], [1e3 * r["seconds"] for r in mine], **look)
        above.axhline(3, color="0.6", lw=0.8, ls="--")
        above.axhline(5, color="0.6", lw=0.8, ls=":")
        below.axvline(result["accuracy"]["doubt"], color="0.6", lw=0.8, ls=":")
        below.invert_xaxis()
        above.set(title=name, xlabel="torque knots", xticks=KNOTS, xticklabels=KNOTS)
        above.minorticks_off()
        below.set_xlabel("largest relative error of the gradient")
    axes[0, 0].set_ylabel("time of value and gradient\nover that of the value alone")
    axes[1, 0].set_ylabel("time of value and gradient [ms]")
    axes[0, 0].legend(frameon=False)
    figure.savefig(path)
    plt.close(figure)


def tabulate(found: dict) -> None:
    """Multiples and compile times."""
    for name, result in found.items():
        print(f"\n{name}: value [ms]; value and gradient over value; compile times [s]")
        print(
            "  knots   value" + "".join(f"{m:>9}" for m in ADJOINTS) + "".join(f"{m:>10}" for m in ("value", *ADJOINTS))
        )
        for row in result["costs"]:
            cells = f"{row['knots']:7d}{1e3 * row['seconds']['value']:8.2f}"
            cells += "".join(f"{row['multiple'][m]:9.2f}" for m in ADJOINTS)
            print(cells + "".join(f"{row['compile'][m]:10.1f}" for m in ("value", *ADJOINTS)))
        print(f"  differences agree with one another to {result['accuracy']['doubt']:.0e}")
        for row in result["accuracy"]["rows"]:
            cells = f"error {row['error']:.1e}, {1e3 * row['seconds']:.2f} ms"
            print(f"  {row['mode']:8s} tolerance {row['tolerance']:.0e}: {cells}")


def main() -> None:
    """Measure, save, draw, print."""
    wa.configure()
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one phase, fewer knots and tolerances; saves nothing")
    quick = parser.parse_args().quick
    jax.config.update("jax_enable_compilation_cache", False)  # compile times are to be fresh
    scene = layered("heptagon")
    traced, found = wa.trace(scene), {}
    for phase in (1,) if quick else (0, 1):
        dynamics = traced[phase].dynamics
        found[scene.phases[phase].name] = {
            "costs": costs(dynamics, phase, KNOTS[::2] if quick else KNOTS, 3 if quick else 7),
            "accuracy": accuracy(dynamics, phase, TOLERANCES[::3] if quick else TOLERANCES, 3 if quick else 7),
        }
    tabulate(found)
    if not quick:
        draw(found, measure.save("gradients", found).with_suffix(".svg"))


if __name__ == "__main__":
    main()
