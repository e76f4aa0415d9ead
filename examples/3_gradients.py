"""Differentiate the margin with respect to every number of a scene and to the torques; step along the gradient."""

import equinox as eqx

import wholearm_jax as wa

wa.configure()
scene = wa.load("heptagon")
even = wa.quasistatic(scene)
torque = wa.torque_schedule(even.times, 1.2 * even.values)  # a fifth more than balances the object: it moves


def margin(inputs):
    """Return the margin of a scene and a schedule."""
    return wa.margin(*inputs)


# A scene and a schedule that hold the derivatives; compiles once, some 20 s.
value, (slope, torque_slope) = eqx.filter_value_and_grad(margin)((scene, torque))
print("d margin / d friction, by link [N]:", slope.object.friction)
print("d margin / d vertex [N/m]:")
print(slope.object.vertices[: int(scene.object.count)])

print(f"margin {float(value):.4f} N")
rate = 0.01 / float((torque_slope.values**2).sum())
better = wa.torque_schedule(torque.times, torque.values + rate * torque_slope.values)
print(f"after a small step along the gradient {float(wa.margin(scene, better)):.4f} N")
