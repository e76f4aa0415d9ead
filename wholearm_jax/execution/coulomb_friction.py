r"""Coulomb's friction between free bodies, solved for at every time step beside MuJoCo's normal forces.

MuJoCo's own friction minimises over a convex cone, which is Coulomb's law with one change: a contact that slides is
also lifted. Where the slip of a contact changes by `dv_t` in an impact, it leaves at up to `mu dv_t`, however hard it
is. (Anitescu, "Optimization-based simulation of nonsmooth rigid multibody dynamics", Math. Program. 105, 2006.) Plans
that go from one formation into the next without a stop lose contacts by that which Coulomb's law keeps. Here MuJoCo's
contacts have no friction of their own; its forces act as external ones. Let `J_t z_dot` be the slips of the contacts
that touch, `G = J_t M^-1 J_t'`, `h` the time step and `v_t` the slips after it. Then

    c_t <- clip(c_t - v_t / (h sum_j |G_ij|), -mu c_n, mu c_n)

leaves forces as they are where each contact sticks, `v_t = 0`, or has `|c_t| = mu c_n` against its slip. It is
repeated, MuJoCo answering each time with `c_n` and the accelerations, until no force changes. Contacts that all stick
converge whatever their number, because `G` over its rows' sums has no eigenvalue beyond 1; but slowly. So for each
active set, which contacts press, stick or slide in which direction, the forces are once those that fit it: a linear
system (`_active_set_forces`). One or two active sets are enough in nearly all steps.
"""

# MuJoCo's names come from a compiled module, which type checkers cannot see into.
# pyright: reportAttributeAccessIssue=false

from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from wholearm_jax.execution.acting_pairs import choose_pairs
from wholearm_jax.execution.mujoco_model import MujocoModel

EXACT, ROUNDS = 1e-6, 100  # when to stop: share of the largest friction by which forces still change; rounds at most


class Touching(NamedTuple):
    """The contacts that touch at a step."""

    pair: Int[np.ndarray, "touching"]  # rows of the model's `names`
    address: Int[np.ndarray, "touching"]  # where MuJoCo keeps their normal forces
    slip: Float[np.ndarray, "touching 5"]  # `J_t`
    friction: Float[np.ndarray, "touching"]  # coefficients
    mobility: Float[np.ndarray, "touching"]  # `h sum_j |G_ij|`


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
    touching = _touching(bodies, data)
    friction, wrong = _settled(bodies, data, touching, before[touching.pair, 1], push)
    data.qfrc_applied[:] = friction @ touching.slip + push
    mujoco.mj_step2(bodies.model, data)
    if has_given_up(data):  # it has begun anew, and its contacts are others
        return np.full_like(before, np.nan), np.inf
    forces = np.zeros(before.shape)
    np.add.at(forces[:, 0], touching.pair, data.efc_force[touching.address])
    np.add.at(forces[:, 1], touching.pair, friction)
    return forces, wrong


def has_given_up(data) -> bool:
    """Whether the motion became unstable, at this step or before."""
    return bool(data.warning.number.any())  # once an array: a loop over warnings takes as long as a step


def _settled(
    bodies: MujocoModel, data, touching: Touching, ct: Float[np.ndarray, "touching"], push
) -> tuple[Float[np.ndarray, "touching"], float]:
    """Friction forces that agree with Coulomb's law, and by how much slips do not [m/s]."""
    if not len(ct):
        return ct, 0.0
    step, wrong, tried = bodies.model.opt.timestep, np.inf, set()
    mujoco.mj_fwdActuation(bodies.model, data)
    for _ in range(ROUNDS):
        data.qfrc_applied[:] = ct @ touching.slip + push
        mujoco.mj_fwdAcceleration(bodies.model, data)
        mujoco.mj_fwdConstraint(bodies.model, data)
        most = touching.friction * data.efc_force[touching.address]
        speed = touching.slip @ (data.qvel + step * data.qacc)
        projected = np.minimum(np.maximum(ct - speed / touching.mobility, -most), most)
        change = np.abs(projected - ct)
        wrong = (touching.mobility * change).max()
        if change.max() <= EXACT * most.max():
            return projected, float(wrong)
        yields, slides = _yielding(data), np.where(np.abs(projected) < most, 0.0, np.sign(projected))
        active_set = (yields.tobytes(), slides.tobytes())
        ct = projected if active_set in tried else _active_set_forces(slides, yields, bodies, data, touching, ct)
        tried.add(active_set)
    return ct, float(wrong)


def _yielding(data) -> Bool[np.ndarray, "constraints"]:
    """Which of MuJoCo's constraints have forces that follow the accelerations: neither off nor at their limits."""
    limit = data.efc_frictionloss  # of joints with dry friction; 0 of contacts and of ranges
    return np.where(limit > 0, np.abs(data.efc_force) < limit, data.efc_force > 0)


def _active_set_forces(
    slides: Float[np.ndarray, "touching"],
    yields: Bool[np.ndarray, "constraints"],
    bodies: MujocoModel,
    data,
    touching: Touching,
    ct: Float[np.ndarray, "touching"],
) -> Float[np.ndarray, "touching"]:
    """Friction forces if contacts stick (0) or slide with a force in a direction, and what yields now does.

    With `J`, `D` and `a_ref` of MuJoCo's constraints that yield, `f = D (a_ref - J a)`, accelerations `a` follow from

        M a = F + J' f + J_t' c_t,    c_t = slides mu f    or    J_t (v + h a) = -c (c_t - c_t now)

    where `c` is `EXACT` squared of how mobile the contact is, so that friction is determined where several contacts
    stick.
    """
    sticks, all_a_ref, address = slides == 0, data.efc_aref, touching.address
    jacobian, stiffness = data.efc_J.reshape(-1, 5)[: len(yields)], yields * data.efc_D
    normal, a_ref, stiff = jacobian[address], all_a_ref[address], stiffness[address]
    # All forces but those of constraints that yield and of contacts that slide, which follow the accelerations.
    force = data.qfrc_smooth - (ct * ~sticks) @ touching.slip
    force += (~yields * data.efc_force + stiffness * all_a_ref) @ jacobian
    sliding = touching.slip * (slides * touching.friction * stiff)[:, None]
    # Unknown are accelerations and, where contacts stick, changes of friction; elsewhere these are 0.
    sticking = touching.slip * sticks[:, None]
    system = np.diag(np.concatenate([1 / bodies.mobility, np.where(sticks, EXACT**2 * touching.mobility, 1.0)]))
    system[:5, :5] += (jacobian.T * stiffness) @ jacobian + sliding.T @ normal
    system[:5, 5:], system[5:, :5] = -sticking.T, bodies.model.opt.timestep * sticking
    solution = np.linalg.solve(system, np.concatenate([force + a_ref @ sliding, -sticking @ data.qvel]))
    most = touching.friction * np.maximum(stiff * (a_ref - normal @ solution[:5]), 0.0)
    held = np.minimum(np.maximum(ct + solution[5:], -most), most)
    return np.where(sticks, held, slides * most)


def _touching(bodies: MujocoModel, data) -> Touching:
    """Find the contacts that touch.

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
    height = (normal * contact.pos[touching, :2]).sum(1)  # along the normal
    rows = np.empty((len(touching), 5))
    rows[:, 0], rows[:, 1] = normal[:, 1], -normal[:, 0]
    rows[:, 2] = normal @ data.qpos[:2] - height
    rows[:, 3:] = (height[:, None] - normal @ bodies.joint.T) * bodies.turns[pair]
    mobility = bodies.model.opt.timestep * np.abs((rows * bodies.mobility) @ rows.T).sum(1)
    return Touching(pair, contact.efc_address[touching], rows, bodies.friction[pair], mobility)
