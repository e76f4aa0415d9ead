"""The largest least slack of an object that is moved very slowly, by a linear programme over forces and torques.

Nothing here is shared with the package: points, normals and slips come from the polygon and the hand's numbers.
"""

import numpy as np
from scipy.optimize import linprog

LINKS = {"palm": 0, "finger1": 1, "finger2": 2}
STILL = 1e-2  # slip over the object's speed, below which a contact does not slip


def corners(vertices, z):
    """The polygon's corners in the world, its centroid at `(x, y)`."""
    x, y = np.transpose(vertices)
    after_x, after_y = np.roll(x, -1), np.roll(y, -1)
    cross = x * after_y - after_x * y
    centroid = np.array([((x + after_x) * cross).sum(), ((y + after_y) * cross).sum()]) / (3 * cross.sum())
    c, s = np.cos(z[2]), np.sin(z[2])
    return (vertices - centroid) @ np.array([[c, s], [-s, c]]) + z[:2]


def contact(data, z, name):
    """Its link, its point, and the normal that points into the object."""
    link, feature = name.split()[0].split(":")
    k, number, world = LINKS[link], int(feature[1:]), corners(np.array(data["object"]["vertices"]), z)
    along = np.array([np.cos(z[2 + k]), np.sin(z[2 + k])]) if k else np.array([1.0, 0.0])
    if feature[0] == "v":
        side = -1.0 if k == 2 else 1.0
        return k, world[number], side * np.array([-along[1], along[0]])
    finger = data["hand"][link]
    edge = world[(number + 1) % len(world)] - world[number]
    return k, np.array(finger["joint"]) + finger["length"] * along, np.array([-edge[1], edge[0]]) / np.hypot(*edge)


def largest_slack(data, z, z_dot, names):
    """Maximise the least of all `c_n`, and of `mu c_n - |c_t|` where contacts roll; sliding ones have `|c_t| = mu c_n`.

    One that does not slip although it may, as beside a rolling one on the same finger, gets no friction. `data` is a
    scene file's content, `z_dot` a velocity along the path of any size. Minus infinity: no torque within limits.
    """
    n, fingers = len(names), [data["hand"][f"finger{k}"] for k in (1, 2)]
    # Unknowns: c_n and c_t of each contact, two torques, the least slack. Equations: object, then each finger.
    equal, right = np.zeros((5, 2 * n + 3)), np.zeros(5)
    right[:2] = -data["object"]["mass"] * np.array(data["gravity"])
    above, slides = [], []
    for i, name in enumerate(names):
        k, point, normal = contact(data, z, name)
        tangent, arm = np.array([normal[1], -normal[0]]), point - z[:2]
        slip = speed = z_dot[:2] + z_dot[2] * np.array([-arm[1], arm[0]])
        if k:
            lever = point - np.array(fingers[k - 1]["joint"])
            slip = slip - z_dot[2 + k] * np.array([-lever[1], lever[0]])
        for column, push in ((i, normal), (n + i, tangent)):
            equal[:2, column] = push
            equal[2, column] = arm[0] * push[1] - arm[1] * push[0]
            if k:
                equal[2 + k, column] = lever[1] * push[0] - lever[0] * push[1]
        mu = data["object"]["friction"][list(LINKS)[k]]
        slack, row = np.zeros(2 * n + 3), np.zeros(2 * n + 3)
        slack[[i, -1]] = -1.0, 1.0
        above.append(slack)
        moves = np.abs(slip @ tangent) > STILL * np.hypot(*speed)
        row[[i, n + i]] = mu * np.sign(slip @ tangent) * moves, 1.0
        if "rolling" in name:
            above += [np.where(slack == -1.0, -mu, slack) + sign * np.eye(2 * n + 3)[n + i] for sign in (1, -1)]
        else:
            slides.append(row)
    for k, finger in enumerate(fingers):
        equal[3 + k, 2 * n + k] = 1.0
        right[3 + k] = finger["dry"] * np.sign(z_dot[3 + k])
    limits = [(-finger["torque_limit"], finger["torque_limit"]) for finger in fingers]
    answer = linprog(
        -np.eye(2 * n + 3)[-1],
        np.array(above),
        np.zeros(len(above)),
        np.vstack([equal, *slides]),
        np.append(right, np.zeros(len(slides))),
        [(None, None)] * (2 * n) + limits + [(None, None)],
    )
    return answer.x[-1] if answer.success else -np.inf
