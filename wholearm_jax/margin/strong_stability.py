r"""Strong stability: whether an object at rest must stay at rest, or may as well begin to move.

That some contact forces balance an object does not mean that it stays. With Coulomb's friction, other forces may agree
with Newton's law, too, with which it moves: the object is then *weakly* stable, and a disturbance decides. It is
*strongly* stable where nothing but rest agrees. Each contact may stick, slide either way or open, and each joint stand
or turn either way. Each of these *modes* is a square linear system for accelerations `a` and forces,

    M a = g + E tau + d + G_n^T c_n + G_t^T c_t
    open: c_n = c_t = 0;    sticks: G_n a = G_t a = 0;    slides: G_n a = 0, c_t = -+ mu c_n
    joint stands: a = 0;    turns: d = -+ D

and agrees with Coulomb's law where its solution has the signs that the mode says.

Source of the terms: J. S. Pang and J. C. Trinkle, Stability characterizations of rigid body contact problems with
Coulomb friction, ZAMM 80 (2000).
"""

import functools
import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from wholearm_jax.margin.statics import Statics

OPENS, STICKS, SLIDE_BACK, SLIDE_AHEAD = 0, 1, -1, 2  # a contact that slides ahead does so along its tangent
STANDS = 0  # of a joint, which else turns by its sign
COMPLIANCE = 1e-9  # acceleration by which contacts yield to a unit of force, so that redundant ones have forces as well
MODE_ROUNDING = 1e-7  # of accelerations and forces, over the largest in a mode


class ModeSolutions(NamedTuple):
    """Accelerations and forces of each mode, linear in `(1, tau1, tau2)`."""

    contacts: Int[np.ndarray, "modes contacts"]
    joints: Int[np.ndarray, "modes 2"]
    acceleration: Float[np.ndarray, "modes 5 3"]
    force: Float[np.ndarray, "modes forces 3"]  # c_n, c_t, d


def moving_mode(statics: Statics, torques: Float[np.ndarray, "torques 2"]) -> tuple[str, ...]:
    """Return what contacts do where an object at rest may as well move under one of some torques.

    Args:
        statics: the balance of forces at rest.
        torques: of both joints [N m].

    Returns:
        One entry a contact, "palm:v2 slides" or "finger1:v3 opens", those that stick left out; none if it must stay.
    """
    modes = _solve_modes(statics)
    for torque in torques:
        agrees, a = _agreement(statics, modes, torque)
        if agrees.any():
            fastest = np.flatnonzero(agrees)[np.argmax(np.abs(a[agrees]).max(1))]
            does = {OPENS: "opens", SLIDE_BACK: "slides", SLIDE_AHEAD: "slides"}
            pairs = zip(statics.names, modes.contacts[fastest].tolist(), strict=True)
            return tuple(f"{name.removesuffix(' rolling')} {does[mode]}" for name, mode in pairs if mode != STICKS)
    return ()


def must_stay(statics: Statics, torques: Float[np.ndarray, "torques 2"]) -> Bool[np.ndarray, "torques"]:
    """Return whether an object at rest must stay under each of some torques [N m]."""
    modes = _solve_modes(statics)
    return np.array([not _agreement(statics, modes, torque)[0].any() for torque in torques], bool)


@functools.cache
def _modes(count: int) -> tuple[Int[np.ndarray, "modes contacts"], Int[np.ndarray, "modes 2"]]:
    """Return all modes of so many contacts and two joints."""
    each = itertools.product((OPENS, STICKS, SLIDE_BACK, SLIDE_AHEAD), repeat=count)
    pairs = list(itertools.product(each, itertools.product((STANDS, -1, 1), repeat=2)))
    return np.array([contacts for contacts, _ in pairs]), np.array([joints for _, joints in pairs])


def _solve_modes(statics: Statics) -> ModeSolutions:
    contacts, joints = _modes(len(statics.names))
    count, (modes, n) = 5 + statics.wrench.shape[1], contacts.shape
    normal, tangent = statics.wrench[:, :n].T, statics.wrench[:, n : 2 * n].T
    system, right = np.zeros((modes, count, count)), np.zeros((modes, count, 3))
    # Newton and Euler.
    system[:, :5, :5], system[:, :5, 5:] = np.diag(statics.mass), -statics.wrench
    right[:, :5] = statics.load
    # Two rows a contact, by its mode.
    for k in range(n):
        mode, row, pressure, friction = contacts[:, k], 5 + 2 * k, 5 + k, 5 + n + k
        opens, sticks = mode == OPENS, mode == STICKS
        slides = ~opens & ~sticks
        system[~opens, row, :5] = normal[k]
        system[:, row, pressure] = np.where(opens, 1.0, COMPLIANCE)
        system[sticks, row + 1, :5] = tangent[k]
        system[:, row + 1, friction] = np.where(sticks, COMPLIANCE, 1.0)
        system[slides, row + 1, pressure] = np.where(mode == SLIDE_AHEAD, 1.0, -1.0)[slides] * statics.friction[k]
    # One a joint.
    for k in range(2):
        row, stands = 5 + 2 * n + k, joints[:, k] == STANDS
        system[stands, row, 3 + k] = 1.0
        system[:, row, row] = np.where(stands, COMPLIANCE, 1.0)
        right[:, row, 0] = -joints[:, k] * statics.dry[k]
    solution = np.linalg.solve(system, right)
    return ModeSolutions(contacts, joints, solution[:, :5], solution[:, 5:])


def _agreement(
    statics: Statics, modes: ModeSolutions, torque: Float[np.ndarray, "2"]
) -> tuple[Bool[np.ndarray, "modes"], Float[np.ndarray, "modes 5"]]:
    """Return which modes move the object as they say they do, and the accelerations of all."""
    contacts, joints, n = modes.contacts, modes.joints, len(statics.names)
    known = np.append(1.0, torque)
    a, force = modes.acceleration @ known, modes.force @ known
    nothing, least = MODE_ROUNDING * np.abs(force).max(1, keepdims=True), MODE_ROUNDING / statics.mass.min()
    c_n, c_t, d = np.split(force, [n, 2 * n], axis=1)
    parting, slip = a @ statics.wrench[:, :n], a @ statics.wrench[:, n : 2 * n]
    slides = np.where(contacts == SLIDE_AHEAD, slip, -slip) > least
    sticks = np.abs(c_t) <= statics.friction * c_n + nothing
    closed = (c_n >= -nothing) & np.where(contacts == STICKS, sticks, slides)
    of_contact = np.where(contacts == OPENS, parting > least, closed)
    of_joint = np.where(joints == STANDS, np.abs(d) <= statics.dry + nothing, a[:, 3:] * joints > least)
    return of_contact.all(1) & of_joint.all(1) & (np.abs(a).max(1) > least), a
