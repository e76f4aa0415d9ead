"""The largest least slack of an object that is moved very slowly, by a linear programme over forces and torques.

Nothing here is shared with the package: contacts and equations of motion are those of `unreduced`.
"""

import numpy as np
from scipy.optimize import linprog

from tests.reference.unreduced import Model

STILL = 1e-2  # slip, over what it is a sum of, below which a contact does not slip


def largest_slack(data, z, z_dot, names):
    """Maximise the least of all `c_n`, and of `mu c_n - |c_t|` where contacts roll; sliding ones have `|c_t| = mu c_n`.

    One that does not slip although it may, as next to a rolling one on the same finger, gets no friction. `data` is a
    scene file's content, `z_dot` a velocity along the path of any size. Minus infinity: no torque within limits.
    """
    model, rest, n = Model(data, names), np.zeros(5), len(names)
    slip_rows = model.geometry(z, z_dot)[2]
    slip = slip_rows @ z_dot
    slides = ~model.rolls & (np.abs(slip) > STILL * (np.abs(slip_rows) @ np.abs(z_dot)))
    signs = np.concatenate([np.where(slides, np.sign(slip), 0.0), np.sign(z_dot[3:])])
    # Unknowns: every c_n, c_t of those that roll, two torques, the least slack.
    wrench = -model.matrix(z, rest, signs)[0][:5, 5:]
    balance = np.hstack([wrench, np.eye(5)[:, 3:], np.zeros((5, 1))])
    load = model.contacts.applied(rest[None, None], np.zeros(2), signs[-2:])[0, 0]
    unit, rolling = np.eye(balance.shape[1]), np.flatnonzero(model.rolls)
    slacks = [unit[k] for k in range(n)]
    slacks += [model.friction[k] * unit[k] + s * unit[n + i] for i, k in enumerate(rolling) for s in (1, -1)]
    limits = [(-most, most) for most in (data["hand"][f"finger{k}"]["torque_limit"] for k in (1, 2))]
    free = [(None, None)]
    bounds = [*free * wrench.shape[1], *limits, *free]
    above = unit[-1] - np.array(slacks)
    answer = linprog(-unit[-1], above, np.zeros(len(above)), balance, -load, bounds)
    return answer.x[-1] if answer.success else -np.inf
