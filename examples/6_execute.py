"""Execute a plan on free bodies in MuJoCo, which knows of no contact formation, and compare it with the prediction."""

import wholearm_jax as wa
from wholearm_jax.execution import execute

wa.configure()
scene = wa.load("hexagon")
optimum = wa.optimise(scene, knots=21)
execution = execute(optimum.result)
print(execution.message)
print(f"position error {1e3 * execution.position_error:.4f} mm, angle error {execution.angle_error:.1e} rad")
for event in execution.events:
    times = [f"{time:.3f} s" if time is not None else "never" for time in (event.predicted, event.executed)]
    print(f"{event.contact:14} {'made' if event.made else 'opened'}: predicted {times[0]}, executed {times[1]}")
