"""Find the torques with the largest margin and plot the plan."""

import sys
from pathlib import Path

import wholearm_jax as wa
from wholearm_jax.plotting import plot_forces, plot_result, plot_strip

wa.configure()
folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out")
folder.mkdir(parents=True, exist_ok=True)

scene = wa.load("heptagon")
optimum = wa.optimise(scene, knots=21)
print(optimum.result.message)
for phase, fraction in zip(optimum.result.phases, optimum.bound_fraction, strict=True):
    print(f"{phase.name}: {phase.margin:.3f} N, {fraction:.1%} of the upper bound")

wa.write_torque(optimum.torque, folder / "torque.csv")
plot_strip(optimum.result).flat[0].figure.savefig(folder / "plan.png")
plot_result(optimum.result)[0].figure.savefig(folder / "result.png")
plot_forces(optimum.result).figure.savefig(folder / "forces.png")  # every plot takes axes of your own, too
