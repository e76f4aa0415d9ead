"""The margin's gradient with respect to torques: in either mode that of differences, in the cheaper one by itself."""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import layered, steadiest_difference

import wholearm_jax as wa
from wholearm_jax.files.scene_toml import to_dict
from wholearm_jax.phases.compressive_margin import plan_margin
from wholearm_jax.phases.gradients import MAX_FORWARD_DIRECTIONS, choose_mode, torque_gradient
from wholearm_jax.phases.plan_simulation import simulate_phases
from wholearm_jax.simulation import Adjoint

DATA = Path(__file__).parents[1] / "data"


def thinned(torque, rows):
    """A schedule read off at evenly spaced times."""
    times = np.linspace(0.0, 2.0, rows)
    return wa.torque_schedule(
        times, np.stack([np.interp(times, torque.times, torque.values[:, k]) for k in range(2)], axis=1)
    )


@pytest.mark.parametrize(
    ("rows", "expected"), [(MAX_FORWARD_DIRECTIONS, Adjoint.FORWARD), (MAX_FORWARD_DIRECTIONS + 1, Adjoint.REVERSE)]
)
def test_both_modes_agree_with_differences(rows, expected):
    scene = layered("heptagon")
    schedule, traced = thinned(wa.read_torque(DATA / "heptagon_torque.csv"), rows), wa.trace(scene)
    assert choose_mode(schedule) is expected
    margin, slope = torque_gradient(scene, schedule, traced=traced)
    assert float(margin) == pytest.approx(wa.simulate(scene, schedule, traced=traced).margin, rel=1e-9)
    way = np.random.default_rng(1).normal(size=(rows, 2)) * 0.005

    def along(h):
        bent = wa.torque_schedule(schedule.times, schedule.values + h * jnp.asarray(way))
        return wa.simulate(scene, bent, traced=traced, tolerance=1e-12).margin

    exact = float((slope * way).sum())
    assert abs(exact) > 1e-4
    assert exact == pytest.approx(steadiest_difference(along), rel=1e-7)


def test_who_arrives_early_in_a_batch_keeps_its_gradient():
    """What a batch computes for members that have finished must not turn their derivatives into NaN."""
    data = to_dict(layered("heptagon"))
    scene = wa.parse(data | {"phase": [data["phase"][0] | {"arrive": "caught", "duration": 4.0}]})
    traced, options = wa.trace(scene), wa.IntegratorOptions(adjoint=Adjoint.BOTH)
    times = jnp.linspace(0.0, 4.0, 5)
    pushes = jnp.asarray([[0.6, -0.2], [1.0, 0.5], [0.55, -0.22]])

    def margin(push):
        return plan_margin(
            scene, simulate_phases(scene, wa.TorqueSchedule(times, jnp.tile(push, (5, 1))), traced, options)
        )

    gradients = eqx.filter_jit(jax.vmap(jax.grad(margin)))
    alike = jnp.stack([gradients(jnp.tile(push, (3, 1)))[0] for push in pushes])  # who are alike finish together
    assert np.abs(gradients(pushes) / alike - 1).max() < 1e-9
