"""Strong stability: against a linear programme for each mode, and against free bodies that are pushed."""

import itertools

import numpy as np
import pytest
from scipy.optimize import linprog

import wholearm_jax as wa
from wholearm_jax.execution.executions import rollout
from wholearm_jax.execution.mujoco_model import build_mujoco_model
from wholearm_jax.execution.pushes import push
from wholearm_jax.margin import contact_statics, moving_mode, must_stay

WEAK, STRONG = np.array([0.453, -0.972]), np.array([0.132, -0.275])  # [N m]; the box stands by friction under either


@pytest.fixture(scope="module")
def box():
    """The bundled box where finger 2's tip takes over: its statics, and the configuration."""
    scene = wa.load("box")
    start = np.asarray(wa.trace(scene)[1].begin)
    return scene, start, contact_statics(scene, scene.phases[1].formation, start)


def may_move(statics, torque) -> bool:
    """Whether some motion agrees with Coulomb's law: forces and accelerations of every mode by a linear programme."""
    n = len(statics.names)
    normal, tangent, joints = np.split(statics.wrench, [n, 2 * n], axis=1)
    # Unknown are accelerations, c_n, c_t and d.
    newton = np.hstack([np.diag(statics.mass), -normal, -tangent, -joints])
    load = statics.load @ np.append(1.0, torque)
    unit = np.eye(5 + 2 * n + 2)
    for contacts in itertools.product(("open", "stick", "+", "-"), repeat=n):
        for turning in itertools.product((0, 1, -1), repeat=2):
            equal, below, speed = [*newton], [], np.zeros(len(unit))
            for k, mode in enumerate(contacts):
                parting, slip = (np.append(row[:, k], np.zeros(2 * n + 2)) for row in (normal, tangent))
                c_n, c_t = unit[5 + k], unit[5 + n + k]
                sign = {"+": 1.0, "-": -1.0}.get(mode, 0.0)
                if mode == "open":
                    equal += [c_n, c_t]
                    below, speed = [*below, -parting], speed + parting
                    continue
                equal += [parting, slip if mode == "stick" else c_t + sign * statics.friction[k] * c_n]
                below += [-sign * slip, c_t - statics.friction[k] * c_n, -c_t - statics.friction[k] * c_n]
                speed = speed + sign * slip
            least, most = [-np.inf] * 5 + [0.0] * n + [-np.inf] * n, [np.inf] * (5 + 2 * n)
            least, most = [*least, *-statics.dry], [*most, *statics.dry]
            for k, sign in enumerate(turning):
                if sign:
                    below, speed = [*below, -sign * unit[3 + k]], speed + sign * unit[3 + k]
                    least[5 + 2 * n + k] = most[5 + 2 * n + k] = -sign * statics.dry[k]
                else:
                    equal.append(unit[3 + k])
            right = np.append(load, np.zeros(len(equal) - 5))
            box = list(zip(least, most, strict=True))
            found = linprog(-speed, np.array(below), np.zeros(len(below)), np.array(equal), right, box)
            if found.status == 3 or (found.status == 0 and -found.fun > 1e-5):
                return True
    return False


def test_it_is_that_of_a_linear_programme_for_each_mode(box):
    _, _, statics = box
    torques = np.vstack([WEAK, STRONG, WEAK + np.random.default_rng(3).uniform(-0.03, 0.03, (4, 2))])
    expected = [not may_move(statics, torque) for torque in torques]
    assert must_stay(statics, torques).tolist() == expected
    assert len(set(expected)) == 2


def test_what_may_move_is_named(box):
    _, _, statics = box
    assert moving_mode(statics, WEAK[None]) == ("palm:v2 slides", "finger1:v3 slides")
    assert moving_mode(statics, STRONG[None]) == ()
    assert moving_mode(statics, np.stack([STRONG, WEAK])) == moving_mode(statics, WEAK[None])


@pytest.mark.parametrize(("torque", "stays"), [(WEAK, False), (STRONG, True)])
def test_free_bodies_stay_where_they_must(box, torque, stays):
    """Contacts that take up their forces, and a push that moves the object by micrometres where it must stay."""
    scene, start, statics = box
    assert statics.margin_under(torque).margin > 2.0  # friction can hold it either way
    step = 1e-4
    z = rollout(
        build_mujoco_model(scene, step),
        start,
        np.tile(torque, (1000, 1)),
        [push(0.05, duration=1e-3, x=-3e-4, phi=-1e-5)],
    )[0]
    moved = np.hypot(*(z[:, :2] - start[:2]).T).max()
    assert moved < 5e-5 if stays else moved > 1e-3
