r"""Coulomb's friction between free bodies, solved for at every time step beside MuJoCo's normal forces.

MuJoCo's own friction minimises over a convex cone, which is Coulomb's law with one change: a contact that slides is
also lifted. Where the slip of a contact changes by `dv_t` in an impact, it leaves at up to `mu dv_t`, however hard it
is. (Anitescu, "Optimization-based simulation of nonsmooth rigid multibody dynamics", Math. Program. 105, 2006.) Plans
that go from one formation into the next without a stop lose contacts by that which Coulomb's law keeps. Here MuJoCo's
contacts have no friction of their own; its forces act as external ones. Let `J_t z_dot` be the slips of the contacts
that touch, `G = J_t M^-1 J_t'`, `h` the time step and `v_t` the slips after it. Then

    c_t <- clip(c_t - v_t / (h sum_j |G_ij|), -mu c_n, mu c_n)

is repeated, MuJoCo answering each time with `c_n` and the accelerations, until no force changes: each contact sticks,
`v_t = 0`, or has `|c_t| = mu c_n` against its slip. Contacts that all stick converge whatever their number, because
`G` over its rows' sums has no eigenvalue beyond 1.
"""

# MuJoCo's names come from a compiled module, which type checkers cannot see into.
# pyright: reportAttributeAccessIssue=false

import mujoco
import numpy as np
from jaxtyping import Float, Int

from wholearm_jax.execution.acting_pairs import choose_pairs
from wholearm_jax.execution.mujoco_model import MujocoModel

EXACT, ROUNDS = 1e-6, 100  # when to stop: share of the largest friction by which forces still change; rounds at most


def advance(
    bodies: MujocoModel, data, torque, before: Float[np.ndarray, "pairs 2"], push: float | Float[np.ndarray, "5"] = 0.0
) -> tuple[Float[np.ndarray, "pairs 2"], float]:
    """One time step under `torque`: the forces `(c_n, c_t)` [N] of all pairs on the object, and how wrong they are.

    `push` is a generalised force [N; N m] on all coordinates beside them; friction is looked for from `before`, that of
    the step before. The second is the largest speed [m/s] by which a contact slips in this step against Coulomb's law:
    by `EXACT` of what friction can do in a step, more where `ROUNDS` were not enough (at rest, where the friction of
    several contacts is not determined), and much where no forces agree with that law, as there need not be any if
    friction is large.
    """
    if has_given_up(data):
        return np.full_like(before, np.nan), np.inf
    choose_pairs(bodies.model, bodies.acting, data.qpos)
    mujoco.mj_step1(bodies.model, data)
    data.ctrl[:] = torque
    pair, address, rows = _touching(bodies, data)
    friction, wrong = _settled(bodies, data, pair, address, rows, before[pair, 1], push)
    data.qfrc_applied[:] = friction @ rows + push
    mujoco.mj_step2(bodies.model, data)
    if has_given_up(data):  # it has begun anew, and its contacts are others
        return np.full_like(before, np.nan), np.inf
    forces = np.zeros_like(before)
    np.add.at(forces, pair, np.stack([data.efc_force[address], friction], axis=1))
    return forces, wrong


def has_given_up(data) -> bool:
    """Whether the motion became unstable, at this step or before."""
    return bool(data.warning.number.any())  # once an array: a loop over warnings takes as long as a step


def _settled(bodies: MujocoModel, data, pair, address, rows, ct, push) -> tuple[Float[np.ndarray, "touching"], float]:
    """Friction forces that agree with Coulomb's law, and by how much slips do not [m/s]."""
    if not len(pair):
        return ct, 0.0
    step, mu = bodies.model.opt.timestep, bodies.friction[pair]
    most_mobile = step * np.abs((rows * bodies.mobility) @ rows.T).sum(1)
    mujoco.mj_fwdActuation(bodies.model, data)
    wrong = np.inf
    for _ in range(ROUNDS):
        data.qfrc_applied[:] = ct @ rows + push
        mujoco.mj_fwdAcceleration(bodies.model, data)
        mujoco.mj_fwdConstraint(bodies.model, data)
        most = mu * data.efc_force[address]
        slip = rows @ (data.qvel + step * data.qacc)
        wanted = np.minimum(np.maximum(ct - slip / most_mobile, -most), most)
        change, ct = np.abs(wanted - ct), wanted
        wrong = (most_mobile * change).max()
        if change.max() <= EXACT * most.max():
            break
    return ct, float(wrong)


def _touching(
    bodies: MujocoModel, data
) -> tuple[Int[np.ndarray, "touching"], Int[np.ndarray, "touching"], Float[np.ndarray, "touching 5"]]:
    """Contacts that touch: their rows of `names`, where MuJoCo keeps their normal forces, and `J_t`.

    `c_t` is positive along the normal that points into the object, turned by -90 degrees.
    """
    contact = data.contact
    touching = np.flatnonzero(contact.efc_address >= 0)
    first, second = contact.geom[touching].T
    pair = bodies.pair[first, second]
    on_object = pair < len(bodies.names)  # links meet without friction
    if not on_object.all():
        touching, pair = touching[on_object], pair[on_object]
    normal = contact.frame[touching, :2] * bodies.toward[pair, None]
    tangent_x, tangent_y = normal[:, 1], -normal[:, 0]
    x, y = contact.pos[touching, :2].T
    rows = np.zeros((len(touching), 5))
    rows[:, 0], rows[:, 1] = tangent_x, tangent_y
    rows[:, 2] = tangent_y * (x - data.qpos[0]) - tangent_x * (y - data.qpos[1])
    for finger, (joint_x, joint_y) in enumerate(bodies.acting.hand.joint):
        turning = tangent_x * (y - joint_y) - tangent_y * (x - joint_x)
        rows[:, 3 + finger] = np.where(bodies.link[pair] == finger + 1, turning, 0.0)
    return pair, contact.efc_address[touching], rows
