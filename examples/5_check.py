"""Check one schedule against polygons that differ from the drawing, and say which number matters most."""

import jax
import numpy as np

import wholearm_jax as wa
from wholearm_jax.ensembles import make_ensemble, most_influential, rank_correlations, summarise

wa.configure()
scene = wa.load("heptagon")
torque = wa.quasistatic(scene)
ensemble = make_ensemble(scene, {"vertices": 0.0005, "friction": "20%"}, seed=1)
result = wa.check(ensemble, torque, count=256, arrival=0.05)

summary = summarise(scene, [result], count=256)
print("\n".join(summary.lines))  # the fraction that holds, margins by quantile, and where the others fail

offsets = np.asarray(jax.lax.map(ensemble.draw_offsets, summary.numbers))
correlation = rank_correlations(summary.margins, offsets)
for k in most_influential(ensemble.parameters, correlation, 3):
    print(f"{ensemble.parameters[k]}: rank correlation with the margin {correlation[k]:+.2f}")
