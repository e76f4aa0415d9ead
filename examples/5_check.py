"""Check one schedule against polygons that differ from the drawing, and say which number matters most."""

import numpy as np

import wholearm_jax as wa
from wholearm_jax.ensembles import make_ensemble, summarise

wa.configure()
scene = wa.load("heptagon")
torque = wa.optimise(scene, knots=21).torque
ensemble = make_ensemble(scene, {"vertices": 0.0005, "friction": "20%"}, seed=1)
result = wa.check(ensemble, torque, count=256)

holds = np.asarray(result.status) == wa.Status.OK
print(f"{holds.mean():.0%} of {holds.size} scenes hold")
print(f"margin: median {np.median(result.margin):.3f} N, lowest {np.min(result.margin):.3f} N")
print("statuses:", {wa.Status(int(k)).label: int(n) for k, n in zip(*np.unique(result.status, return_counts=True))})
for line in summarise(scene, [result], count=256).lines:
    print(line)
