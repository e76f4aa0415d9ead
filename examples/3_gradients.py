"""Differentiate the margin with respect to every number of a scene and to the torques; step along the gradient."""

import equinox as eqx

import wholearm_jax as wa
from wholearm_jax.phases.gradients import torque_gradient

wa.configure()
scene = wa.load("heptagon")
torque = wa.quasistatic(scene)

slope = eqx.filter_grad(wa.margin)(scene, torque)  # a scene that holds the derivatives; compiles once, some 20 s
print("d margin / d friction, by link [N]:", slope.object.friction)
print("d margin / d vertex [N/m]:")
print(slope.object.vertices[: int(scene.object.count)])

margin, torque_slope = torque_gradient(scene, torque)  # with respect to torques alone: forward or reverse mode
print(f"margin {float(margin):.4f} N")
rate = 1e-3 / float((torque_slope**2).sum())
better = wa.torque_schedule(torque.times, torque.values + rate * torque_slope)
print(f"after a small step along the gradient {float(torque_gradient(scene, better)[0]):.4f} N")
