"""The mechanics of many scenes at once, written a second time: NumPy only, nothing shared with the package.

Everything is in object units (lengths in the object's largest radius, masses in its mass, times in seconds). Leading
axes of a configuration `z = (x, y, phi, theta1, theta2)` are (scenes, places). With `q` the object's centre, `r` the
vertex about it, `d` a link's direction, `n` the normal into the object, `t` the tangent and `S` the quarter turn,

    vertex on a link    C = n.(q + r - j) - offset,    G_n = [n, n.S r, -side d.(q + r - j)],     t = -S n
    tip on an edge      C = n.(q + r - tip),           G_n = [n, S n.(q + r - tip) + n.S r, -n.S (tip - j)]

and `G_t z_dot` is the velocity of the object's material point against the link's, along `t`. A contact that rolls has a
second row: the place where it touches its feature stays `held`, and the row is its `G_t`. Newton and Euler:

    M z_ddot + B z_dot + D sgn(z_dot) - g - E tau = (G_n - Xi U G_t)^T c_n,     G_n z_ddot = -G_n_dot z_dot
"""

from typing import NamedTuple

import numpy as np


class Geometry(NamedTuple):
    """Contacts at configurations: gap, place along the feature, `G_n`, `G_t` and `G_n_dot z_dot`.

    In the second row of a contact that rolls, `gap` is how far it has left its place, and `normal_rows` its `G_t`.
    """

    gap: np.ndarray
    along: np.ndarray
    normal_rows: np.ndarray
    slip_rows: np.ndarray
    left: np.ndarray


def quarter(a):
    """Vectors turned by +90 degrees."""
    turned = np.empty(a.shape)
    turned[..., 0], turned[..., 1] = -a[..., 1], a[..., 0]
    return turned


def dot(a, b):
    """Scalar products along the last axis."""
    return (a * b).sum(-1)


def centroid_and_inertia(vertices, count):
    """Centroid and polar second moment per area about it of padded polygons, as fans of triangles from vertex 0."""
    p = vertices - vertices[:, :1]
    real = (np.arange(p.shape[1] - 1) + 1 < count[:, None]) & (np.arange(p.shape[1] - 1) > 0)
    a, b = p[:, :-1], p[:, 1:]
    segment = np.where(real, a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0], 0.0) / 2
    area = segment.sum(1)
    centroid = (segment[..., None] * (a + b)).sum(1) / 3 / area[:, None]
    second = (segment * ((a * a).sum(2) + (a * b).sum(2) + (b * b).sum(2))).sum(1) / 6
    return vertices[:, 0] + centroid, second / area - (centroid**2).sum(1)


class Model:
    """A batch of scenes with one formation of four contacts each."""

    def __init__(
        self, *, vertices, count, friction, joint, length, offset, inertia, viscous, dry, gravity, formation, tangential
    ):
        self.vertices, self.count = vertices, count
        self.joint, self.length, self.offset = joint, length, offset
        self.inertia, self.viscous, self.dry, self.gravity = inertia, viscous, dry, gravity
        self.link, self.kind, self.feature = formation
        self.friction = np.take_along_axis(friction, self.link, axis=1)
        self.tangential, self.held = tangential, np.zeros(tangential.shape)
        self.slides = ~tangential & ~np.roll(tangential, -1, axis=1)

    @classmethod
    def in_object_units(cls, shape, formation, friction, joint_inertia):
        """From shapes of the stability benchmark's `scenes` (unit size and mass), for the geometry and friction
        alone."""
        n = len(shape.count)
        zero, body = np.zeros((n, 2)), np.stack([np.ones(n), np.ones(n), np.full(n, 0.3)], axis=1)
        return cls(
            vertices=shape.vertices,
            count=shape.count,
            friction=friction,
            joint=shape.joint,
            length=shape.length,
            offset=shape.offset,
            inertia=np.concatenate([body, joint_inertia], axis=1),
            viscous=zero,
            dry=zero,
            gravity=zero,
            formation=tuple(formation[..., k] for k in range(3)),
            tangential=np.zeros((n, 4), bool),
        )

    @classmethod
    def of(cls, scenes, rows=slice(None)):
        """From `benchmarks.stability.scenes.Scenes`, which are in SI units."""
        some = scenes[rows]
        center, second = centroid_and_inertia(some.vertices, some.count)
        vertices = some.vertices - center[:, None]
        size = np.sqrt((vertices**2).sum(2)).max(1)
        rotary = (some.mass * size**2)[:, None]
        own = np.where(some.uniform, second / size**2, some.inertia / rotary[:, 0])
        model = cls(
            vertices=vertices / size[:, None, None],
            count=some.count,
            friction=some.friction,
            joint=some.joint / size[:, None, None],
            length=some.length / size[:, None],
            offset=some.offset / size[:, None],
            inertia=np.concatenate([np.ones((len(size), 2)), own[:, None], some.joint_inertia / rotary], axis=1),
            viscous=some.viscous / rotary,
            dry=some.dry / rotary,
            gravity=some.gravity / size[:, None],
            formation=(some.link, some.kind, some.feature),
            tangential=some.tangential,
        )
        model.size, model.mass = size, some.mass
        rough = some.rough / np.stack([size, size, *np.ones((3, len(size)))], axis=1)
        model.held = model.geometry(rough[:, None]).along[:, 0]
        return model

    def slack(self, force):
        """What of constraint forces (scenes, places, 4) counts toward the margin: `c_n`, and `mu c_n - |c_t|`."""
        cone = self.friction[:, None] * np.roll(force, 1, axis=-1) - np.abs(force)
        return np.where(self.tangential[:, None], cone, force)

    def take(self, rows):
        """The same for some of the scenes."""
        small = object.__new__(Model)
        small.__dict__ = {name: value[rows] for name, value in self.__dict__.items()}
        return small

    # --- contacts -----------------------------------------------------------------------------------------------------

    def _poses(self, z):
        """Vertices about the centre (scenes, places, vertices, 2) and the links' directions (scenes, places, 3, 2)."""
        c, s = np.cos(z[..., 2])[..., None], np.sin(z[..., 2])[..., None]
        px, py = self.vertices[:, None, :, 0], self.vertices[:, None, :, 1]
        away = np.stack([c * px - s * py, s * px + c * py], axis=-1)
        angle = np.concatenate([np.zeros_like(z[..., :1]), z[..., 3:]], axis=-1)
        return away, np.stack([np.cos(angle), np.sin(angle)], axis=-1)

    def _links(self):
        """Joint, length, offset and side of the palm and both fingers."""
        zero = np.zeros((len(self.count), 1))
        joint = np.concatenate([np.zeros((len(self.count), 1, 2)), self.joint], axis=1)
        length = np.concatenate([zero, self.length], axis=1)
        return joint, length, np.concatenate([zero, self.offset], axis=1), np.array([1.0, 1.0, -1.0])

    def following(self):
        """The number of each vertex's next one."""
        number = np.arange(1, self.vertices.shape[1] + 1)
        return np.where(number < self.count[:, None], number, 0)

    def geometry(self, z, z_dot=None) -> Geometry:
        """The formation's contacts at `z` (scenes, places, 5)."""
        z_dot = np.zeros_like(z) if z_dot is None else z_dot
        away, directions = self._poses(z)
        joint, length, offset, side = self._links()
        scene = np.arange(len(self.count))[:, None]
        joint, length, offset = joint[scene, self.link], length[scene, self.link], offset[scene, self.link]
        joint, side = joint[:, None], side[self.link][:, None, :, None]
        length, offset = length[:, None, :, None], offset[:, None, :, None]
        tip_on_edge = (self.kind == 1)[:, None]
        r = away[scene, :, self.feature].swapaxes(1, 2)
        edge = away[scene, :, self.following()[scene, self.feature]].swapaxes(1, 2) - r
        extent = np.sqrt(dot(edge, edge))[..., None]
        edge = edge / np.where(extent > 0, extent, 1.0)
        d = directions[scene, :, self.link].swapaxes(1, 2)
        q, q_dot, rate = z[..., None, :2], z_dot[..., None, :2], z_dot[..., None, 2]
        spins = np.concatenate([np.zeros_like(z_dot[..., :1]), z_dot[..., 3:]], axis=-1)
        spin = spins[scene, :, self.link].swapaxes(1, 2)
        arm = length * d + offset * side * quarter(d)

        normal = np.where(tip_on_edge[..., None], quarter(edge), side * quarter(d))
        tangent = -quarter(normal)
        point = q + r - joint  # the vertex from the joint
        gap_a, gap_b = dot(normal, point) - offset[..., 0], dot(normal, point - arm)
        along = np.where(tip_on_edge, -dot(edge, point - arm), dot(d, point))
        touch = np.where(tip_on_edge[..., None], arm + joint - q, r)  # the contact point from the centre
        lever = np.where(tip_on_edge[..., None], arm, point)  # and from the joint
        turn = np.where(
            tip_on_edge, dot(quarter(normal), point - arm) + dot(normal, quarter(r)), dot(normal, quarter(r))
        )
        swing = np.where(tip_on_edge, -dot(normal, quarter(arm)), -side[..., 0] * dot(d, point))
        velocity = q_dot + rate[..., None] * quarter(r)
        left_a = -2 * side[..., 0] * spin * dot(d, velocity) - spin**2 * dot(normal, point) - rate**2 * dot(normal, r)
        left_b = (
            -(rate**2) * dot(normal, point - arm)
            + 2 * rate * dot(quarter(normal), velocity - spin[..., None] * quarter(arm))
            + dot(normal, -(rate**2)[..., None] * r + (spin**2)[..., None] * arm)
        )
        which = (self.link[:, None, :, None] - 1 == np.arange(2)).astype(float)
        slide = -dot(tangent, quarter(lever))
        normal_rows = np.concatenate([normal, turn[..., None], swing[..., None] * which], axis=-1)
        slip_rows = np.concatenate(
            [tangent, dot(tangent, quarter(touch))[..., None], slide[..., None] * which], axis=-1
        )
        gap, left = np.where(tip_on_edge, gap_b, gap_a), np.where(tip_on_edge, left_b, left_a)
        rolls = self.tangential[:, None]
        if rolls.any():
            sense = np.where(tip_on_edge, -1.0, side[..., 0])
            along_a = 2 * spin * dot(quarter(d), velocity) - spin**2 * dot(d, point) - rate**2 * dot(d, r)
            along_b = (
                rate**2 * dot(edge, point - arm)
                - 2 * rate * dot(quarter(edge), velocity - spin[..., None] * quarter(arm))
                + dot(edge, (rate**2)[..., None] * r - (spin**2)[..., None] * arm)
            )
            gap = np.where(rolls, sense * (along - self.held[:, None]), gap)
            left = np.where(rolls, sense * np.where(tip_on_edge, along_b, along_a), left)
            normal_rows = np.where(rolls[..., None], slip_rows, normal_rows)
        return Geometry(gap=gap, along=along, normal_rows=normal_rows, slip_rows=slip_rows, left=left)

    def limits(self):
        """Between which places `along` a formation's contacts stay on their features."""
        scene = np.arange(len(self.count))[:, None]
        start = self.vertices[scene, self.feature]
        after = np.take_along_axis(self.following(), self.feature, axis=1)
        extent = np.sqrt(((self.vertices[scene, after] - start) ** 2).sum(2))
        reach = np.concatenate([self.joint[:, :1, 0], self.length], axis=1)[scene, self.link]
        low = np.where(self.link == 0, self.joint[:, 1:, 0], 0.0)
        return low, np.where(self.kind == 1, extent, reach)

    def crossing(self, z) -> np.ndarray:
        """Whether an object's vertex lies behind the palm or the line of a finger (scenes, places)."""
        _, directions = self._poses(z)
        points, _, real = self.outline(z)
        joint, _, offset, side = self._links()
        gaps = [points[..., 1]]
        for link in (1, 2):
            normal = side[link] * quarter(directions[..., link, :])
            gaps.append(dot(normal[:, :, None], points - joint[:, None, None, link]) - offset[:, link, None, None])
        return np.any(real & (np.min(gaps, axis=0) < -1e-9), axis=2)

    def depth(self, z):
        """How deep the palm and the fingers' contact edges are in the object (scenes, places); 0 outside.

        The points looked at are the feet of all vertices on each, its ends, and the middles between the places where
        its line crosses the object's edges.
        """
        points, following, real = self.outline(z)
        root1, root2, end1, end2 = np.moveaxis(self.corners(z), 2, 0)
        _, length, _, _ = self._links()
        _, directions = self._poses(z)
        worst = np.zeros(z.shape[:2])
        starts = (end2, root1, root2)
        reaches = (end1[..., :1] - end2[..., :1], length[:, None, 1, None], length[:, None, 2, None])
        for link, (start, reach) in enumerate(zip(starts, reaches, strict=True)):
            d, reach = directions[..., link, :], np.broadcast_to(reach, (*z.shape[:2], 1))
            feet = np.where(real, np.clip(dot(d[:, :, None], points - start[:, :, None]), 0.0, reach), 0.0)
            feet = np.concatenate([feet, reach, 0 * reach], axis=2)
            aside = dot(quarter(d)[:, :, None], points - start[:, :, None])
            other = dot(quarter(d)[:, :, None], following - start[:, :, None])
            share = aside / np.where(aside == other, np.inf, aside - other)
            meet = points + share[..., None] * (following - points)
            crossed = real & (share >= 0) & (share <= 1)
            crossings = np.where(crossed, np.clip(dot(d[:, :, None], meet - start[:, :, None]), 0.0, reach), 0.0)
            stops = np.sort(np.concatenate([feet, crossings], axis=2), axis=2)
            feet = np.concatenate([feet, (stops[..., 1:] + stops[..., :-1]) / 2], axis=2)
            probes = start[:, :, None] + feet[..., None] * d[:, :, None]
            worst = np.maximum(worst, _inside(probes, points, following, real).max(2))
        return worst

    def corners(self, z) -> np.ndarray:
        """Where the fingers' roots and the palm's ends at both fingers are: (scenes, places, 4, 2)."""
        _, directions = self._poses(z)
        joint, _, offset, side = self._links()
        roots = [
            joint[:, None, link] + offset[:, None, link, None] * side[link] * quarter(directions[..., link, :])
            for link in (1, 2)
        ]
        ends = [np.broadcast_to(joint[:, None, link] * [1.0, 0.0], roots[0].shape) for link in (1, 2)]
        return np.stack([*roots, *ends], axis=2)

    def corner_from_edge(self, z, corner, feature) -> np.ndarray:
        """How far one of `corners` is from an edge (scenes), at the first place."""
        row = np.arange(len(z))
        points, following, _ = self.outline(z)
        begin, edge = points[row, 0, feature], (following - points)[row, 0, feature]
        away = self.corners(z)[row, 0, np.minimum(corner, 3)] - begin
        share = np.clip(dot(away, edge) / np.maximum(dot(edge, edge), 1e-300), 0.0, 1.0)
        left = away - share[:, None] * edge
        return np.sqrt(dot(left, left))

    def depth_of_corners(self, z) -> np.ndarray:
        """How deep roots of fingers and ends of the palm are in the object (scenes, places); 0 outside."""
        points, following, real = self.outline(z)
        return _inside(self.corners(z), points, following, real).max(2)

    def outline(self, z):
        """The object's vertices, the next one of each (scenes, places, vertices, 2), and which are real."""
        points = z[..., None, :2] + self._poses(z)[0]
        real = (np.arange(points.shape[2]) < self.count[:, None])[:, None]
        after = np.broadcast_to(self.following()[:, None, :, None], points.shape)
        return points, np.take_along_axis(points, after, axis=2), real

    def curve(self, z, chart):
        """`dz/ds` and `d2z/ds2` in a chart: `G_n x = 0`, `u.x = 1`, `G_n x' = -G_n_dot x`, `u.x' = 0`."""
        rows = np.concatenate([self.geometry(z).normal_rows, chart[..., None, :]], axis=-2)
        x = np.linalg.solve(rows, np.broadcast_to(np.eye(5)[4][:, None], (*z.shape, 1)))[..., 0]
        left = np.concatenate([-self.geometry(z, x).left, np.zeros_like(z[..., :1])], axis=-1)
        return x, np.linalg.solve(rows, left[..., None])[..., 0]

    # --- dynamics -----------------------------------------------------------------------------------------------------

    def tangent(self, z, toward):
        """Unit null vectors of `G_n` (scenes, places, 5) with a positive product with `toward`; and the least and the
        largest singular value of `G_n`."""
        _, values, basis = np.linalg.svd(self.geometry(z).normal_rows)
        x = basis[..., -1, :]
        return x * np.where(dot(x, toward) < 0, -1.0, 1.0)[..., None], values[..., -1], values[..., 0]

    def wrench(self, at: Geometry, slip_sign, scale=1.0):
        """`(G_n - Xi U G_t)^T` (scenes, places, 5, 4)."""
        friction = self.friction[:, None] * slip_sign * np.asarray(scale)[..., None, None]
        return np.swapaxes(at.normal_rows - friction[..., None] * at.slip_rows, -1, -2)

    def determinant(self, z, scale):
        """The determinant of the 5x5 matrix at one configuration a scene, friction times `scale`."""
        z = z[:, None]
        x = self.tangent(z, np.ones(5))[0]
        at = self.geometry(z)
        sign = np.sign(np.einsum("npci,npi->npc", at.slip_rows, x))
        wrench = self.wrench(at, sign, np.broadcast_to(scale, len(z)))
        matrix = np.concatenate([(self.inertia[:, None] * x)[..., None], -wrench], axis=-1)
        return np.linalg.det(matrix)[:, 0]

    def resting(self, z, toward, torque):
        """Accelerations along `toward` of an object at rest (scenes, places): forward signs, then backward signs.

        `torque` is in object units. Also the reciprocal condition numbers of both systems.
        """
        x, _, _ = self.tangent(z, toward)
        at = self.geometry(z)
        slip = np.where(self.slides[:, None], np.einsum("npci,npi->npc", at.slip_rows, x), 0.0)
        sign, turn = (np.where(np.abs(v) > 1e-9, np.sign(v), 0.0) for v in (slip, x[..., 3:]))
        answers, health = [], []
        for way in (1.0, -1.0):
            matrix = np.concatenate([(self.inertia[:, None] * x)[..., None], -self.wrench(at, way * sign)], axis=-1)
            push = np.concatenate(
                [
                    np.broadcast_to(self.gravity[:, None], (*z.shape[:2], 2)),
                    np.zeros((*z.shape[:2], 1)),
                    torque - self.dry[:, None] * way * turn,
                ],
                axis=-1,
            )
            values = np.linalg.svd(matrix, compute_uv=False)
            health.append(values[..., -1] / values[..., 0])
            safe = np.where((health[-1] > 1e-14)[..., None, None], matrix, np.eye(5))
            answers.append(np.linalg.solve(safe, push[..., None])[..., 0, 0])
        return answers, health

    def forces(self, z, z_dot, torque, slip_sign, joint_sign):
        """Accelerations and contact forces of the un-reduced 9x9 system (scenes, places, 5 and 4), object units."""
        at = self.geometry(z, z_dot)
        shape = (*z.shape[:2], 9, 9)
        matrix = np.zeros(shape)
        matrix[..., np.arange(5), np.arange(5)] = self.inertia[:, None]
        matrix[..., :5, 5:] = -self.wrench(at, slip_sign)
        matrix[..., 5:, :5] = at.normal_rows
        right = np.concatenate([self.applied(z_dot, torque, joint_sign), -at.left], axis=-1)
        answer = np.linalg.solve(matrix, right[..., None])[..., 0]
        return answer[..., :5], answer[..., 5:]

    def applied(self, z_dot, torque, joint_sign):
        """`E tau + g - B z_dot - D sgn(z_dot)` (scenes, places, 5), object units."""
        weight = np.broadcast_to(self.gravity[:, None], (*z_dot.shape[:2], 2))
        joints = torque - self.viscous[:, None] * z_dot[..., 3:] - self.dry[:, None] * joint_sign
        return np.concatenate([weight, np.zeros_like(weight[..., :1]), joints], axis=-1)


def _inside(probes, here, there, real):
    """How deep points (scenes, places, points, 2) lie in polygons with edges from `here` to `there`; 0 outside."""
    edge = (there - here)[:, :, None]
    away = probes[..., None, :] - here[:, :, None]
    size = np.maximum(dot(edge, edge), 1e-300)
    share = np.clip(dot(away, edge) / size, 0.0, 1.0)
    left = away - share[..., None] * edge
    distance = np.where(real[:, :, None], np.sqrt(dot(left, left)), np.inf).min(-1)
    low, high = here[:, :, None, :, 1], there[:, :, None, :, 1]
    level = probes[..., None, 1]
    spans = (low > level) != (high > level)
    rise = np.where(high == low, 1.0, high - low)
    crosses = here[:, :, None, :, 0] + (level - low) / rise * edge[..., 0] > probes[..., None, 0]
    odd = (spans & crosses & real[:, :, None]).sum(-1) % 2 == 1
    return np.where(odd, distance, 0.0)
