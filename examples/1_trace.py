"""Describe a scene in Python, trace its contact paths and see why each one ends."""

import wholearm_jax as wa

wa.configure()  # 64 bits and compiler settings, before JAX computes anything

finger = {"length": 0.13, "inertia": 2e-3, "viscous": 0.02, "dry": 0.01, "torque_limit": 1.0}
vertices = [[0.04, -0.005], [0.03, 0.033], [-0.028, 0.035], [-0.043, -0.009], [-0.018, -0.033], [0.03, -0.038]]
scene = wa.parse(
    {
        "title": "hexagon",
        "gravity": 9.81,
        "hand": {"finger1": {"joint": [0.05, 0.0], **finger}, "finger2": {"joint": [-0.05, 0.0], **finger}},
        "object": {"vertices": vertices, "mass": 0.2, "friction": 0.1},
        "start": {"x": -0.019, "y": 0.039, "phi": 1.899, "theta1": 2.07, "theta2": 1.749},
        "phase": [
            {
                "name": "slide right",
                "contacts": ["palm:v2", "palm:v3", "finger1:v5", "finger2:v1"],
                "toward": "x+",
                "duration": 1.0,
            }
        ],
    }
)
(traced,) = wa.trace(scene)
print(wa.Status(int(traced.dynamics.status)).label)
print("from", traced.begin[:3], "to", traced.end[:3])  # x, y [m] and phi [rad] of the object
print(f"path length {float(traced.dynamics.length):.3f} object radii")
