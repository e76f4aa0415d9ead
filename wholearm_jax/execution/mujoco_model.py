r"""Virtual hardware: the hand and the polygon as free bodies in MuJoCo, held together by nothing but soft contacts.

The coordinates are those of the prediction, `z = (x, y, phi, theta1, theta2)`: two slides and a hinge for the object,
a hinge for each finger. Fingers have inertia J about their joint (and their centre of mass on it, so that gravity acts
on the object alone, as in eqs. 1-3), viscous friction B and dry friction D. No contact formation is assumed: all pairs
of features that may touch (`contact_set.contact_candidates`) are pairs of shapes that MuJoCo tests at every step. The
shapes make MuJoCo's distances equal the C-functions:

- an object vertex and a fingertip are dots, spheres of radius `r`, a hundred-thousandth of the object's;
- the palm and a finger's contact edge are slabs whose face lies `r` behind the line, so that a dot whose centre is on
  the line touches at gap 0; thick, so that no dot falls through, however soft the contact;
- an object's edge, for the fingertips, is such a slab, too. Slabs reach beyond their edges, and a tip near a vertex
  touches that of the edge on which it is.

The links are bodies among themselves, too: fingertips and joints are dots against the other finger, and fingertips
against the palm, without friction; ranges are joint limits. Layered fingers do not meet.

Slabs are thicker than what they stand for: which pairs act is chosen before every step (`acting_pairs`).

Where a finger's contact edge passes through its joint, finger and palm make a corner. Both go on a little beyond the
joint, the finger below the palm, so that a vertex pressed into the corner does not slip out between them.

A pair thus touches at one point of the plane. If `a_free` is the acceleration of the gap `C` without the contact, then

    C_ddot = (1 - d) a_free - d (b C_dot + k C),    b = 2 / (d t_c),  k = 1 / (d t_c^2)        (`ContactCompliance`)

critically damped, so that a steady load sags by `(1 - d) a_free t_c^2`. Friction obeys Coulomb's law with the link's
coefficient (`coulomb`), or, much faster where many models are rolled out together, MuJoCo's convex one.
"""

# MuJoCo's names come from a compiled module, which type checkers cannot see into.
# pyright: reportAttributeAccessIssue=false

from dataclasses import dataclass
from typing import Literal

import jax
import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from wholearm_jax.execution.acting_pairs import ActingPairs, acting_pairs, choose_pairs, link_dots, link_faces
from wholearm_jax.model import (
    EDGE,
    LINKS,
    VERTEX,
    Scene,
    contact_candidates,
    contact_name,
    parse_contact,
    rigid_body,
)

POINT_RADIUS = 1e-5  # radius of a dot [object radii]: far above rounding, its lever arm far below any tolerance
PAIR_DISTANCE = (
    1e-6  # gap at which contacts begin to act [object radii]: at 0 but for rounding, where objects start, all do
)
CORNER = 2e-3  # by how much finger and palm go on beyond the joint, and the finger beyond its tip [object radii]
LINK_MEETINGS = ("finger1 meets finger2", "finger1 meets the palm", "finger2 meets the palm")  # rows of `link_overlaps`
LINK_GIVE = 1e-3  # how far contacts between links give way, over those with the object
EDGE_DEPTH = 0.02  # how deep a fingertip may sink in an edge [object radii]
HALF_SPACE_DEPTH = 0.2  # slabs, and all shapes in depth [object radii]


@dataclass(frozen=True)
class ContactCompliance:
    """How contacts give way.

    `time_constant` t_c of the gap is in time steps (MuJoCo resolves no fewer than two), `impedance` is d in (0, 1).
    `friction` is Coulomb's law (`coulomb.step`), for which the rest has no meaning, or MuJoCo's own, `"convex"`:
    an elliptic cone in which slip dies out at the rate `b_f = 1 / (slip_constant * time step)` while friction holds;
    `slip_stiffness` is MuJoCo's `impratio`.

    Convex friction is Coulomb's only where slip is faster than `deceleration / b_f`; below that it fades out. An impact
    at a speed `v_n` decelerates by about `v_n / t_c`: where slip is slower than `mu v_n slip_constant / time_constant`,
    friction misses part of the impulse that Coulomb's law gives it. But the cone couples friction and gap: a contact
    that slides at `v_t` is lifted by `mu b_f v_t / k`, against the sag above. Where the lift wins, the contact
    chatters: the more so the harder it is (`d` near 1), the less load it bears, and the smaller `slip_constant`. And a
    small `d` makes the steps unstable, because MuJoCo's estimate of the inertia that a contact feels leaves out the
    other contacts: `d` = 0.4 was seen to be so at a `t_c` of two steps, not of three. `CONVEX` lies between.
    """

    time_constant: float = 3.0
    impedance: float = 0.9
    friction: Literal["coulomb", "convex"] = "coulomb"
    slip_constant: float = 30.0
    slip_stiffness: float = 100.0


CONVEX = ContactCompliance(impedance=0.5, friction="convex")
"""MuJoCo's own friction, at a compromise between chatter and missing impulses."""


@dataclass(frozen=True)
class MujocoModel:
    """A compiled model, the names of its contacts, and what Coulomb's friction needs of both.

    `pair[geom1, geom2]` is the row of `names`, or after them of `link_meetings`, that two shapes belong to (-1: none);
    `toward[row]` is 1 where MuJoCo's contact normal points into the object and -1 where it points out of it. Each row
    of `names` says which finger `turns` with its contact, about its `joint`, and has a `friction` coefficient. `acting`
    says which pairs act, and `mobility` is the diagonal of `M^-1`. `xml` is the model as MJCF, always with MuJoCo's
    friction and without `LINK_GIVE`, which MJCF cannot say.
    """

    model: mujoco.MjModel
    names: tuple[str, ...]
    acting: ActingPairs
    link_meetings: tuple[str, ...]
    pair: Int[np.ndarray, "geoms geoms"]
    toward: Int[np.ndarray, "rows"]
    joint: Float[np.ndarray, "2 2"]
    turns: Bool[np.ndarray, "rows 2"]
    friction: Float[np.ndarray, "rows"]
    mobility: Float[np.ndarray, "5"]
    softness: ContactCompliance
    xml: str


def build_mujoco_model(scene: Scene, timestep: float, softness: ContactCompliance = ContactCompliance()) -> MujocoModel:
    """Build the model of a scene for time steps of `timestep` [s]."""
    solid, hand = jax.tree.map(np.asarray, (rigid_body(scene.object), scene.hand))
    size = float(np.sqrt((solid.vertices[: solid.count] ** 2).sum(1).max()))
    spec = _world(scene, timestep, softness)
    _add_object(spec, solid, size)
    _add_hand(spec, scene.hand, size, _gives_way(softness, timestep))
    rows = _add_pairs(spec, solid, size, timestep, softness)
    meetings = _add_link_pairs(spec, hand, size, timestep, softness)
    model = spec.compile()
    _let_fingers_give_way(model, hand)
    if softness.friction == "coulomb":
        model.pair_dim[:] = 1  # normal forces alone
    pair = np.full((model.ngeom, model.ngeom), -1)
    toward = np.ones(len(rows), int)
    for row, ours, other in rows.values():
        first, second = sorted((model.geom(ours).id, model.geom(other).id), key=lambda g: model.geom_type[g])
        pair[first, second] = pair[second, first] = row
        toward[row] = 1 if second == model.geom(ours).id else -1
    link_meetings = tuple(dict.fromkeys(name for name, _, _ in meetings))
    for name, one, other in meetings:
        first, second = model.geom(one).id, model.geom(other).id
        pair[first, second] = pair[second, first] = len(rows) + link_meetings.index(name)
    link = np.array([parse_contact(name)[0] for name in rows])
    inertia = np.array([solid.mass, solid.mass, solid.inertia, *hand.inertia])
    acting = acting_pairs(model, tuple(rows), solid, hand, PAIR_DISTANCE * size, EDGE_DEPTH * size)
    choose_pairs(model, acting, np.asarray(scene.start), everywhere=True)
    return MujocoModel(
        model=model,
        names=tuple(rows),
        acting=acting,
        link_meetings=link_meetings,
        pair=pair,
        toward=toward,
        joint=np.asarray(hand.joint),
        turns=link[:, None] == np.array([1, 2]),
        friction=np.asarray(solid.friction)[link],
        mobility=1 / inertia,
        softness=softness,
        xml=spec.to_xml(),
    )


def _let_fingers_give_way(model, hand) -> None:
    """Tell MuJoCo how fingers move under a force, which it takes to be not at all: they turn about their centres.

    Contacts of links with each other are else so hard that no forces are found; those with the object hardly change.
    """
    for k, name in enumerate(LINKS[1:]):
        model.body_invweight0[model.body(name).id, 0] = LINK_GIVE * hand.length[k] ** 2 / hand.inertia[k]


def _world(scene, timestep, softness):
    """Options: a Newton solver on elliptic cones, solved to rounding level; joint damping taken implicitly."""
    spec = mujoco.MjSpec()
    spec.modelname = scene.title
    spec.compiler.degree = False
    option = spec.option
    option.timestep = timestep
    option.gravity = [*np.asarray(scene.gravity), 0.0]
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.impratio = softness.slip_stiffness
    option.tolerance, option.iterations = 1e-12, 50
    option.ccd_tolerance = 1e-10
    return spec


def _add_body(spec, name, position, inertia, mass):
    """A body with the inertia given about its own origin, whatever its shapes."""
    added = spec.worldbody.add_body(name=name, pos=position)
    added.explicitinertial, added.ipos = True, np.zeros(3)
    added.mass, added.inertia = float(mass), np.full(3, float(inertia))
    return added


def _add_object(spec, solid, size):
    """The object: slides, hinge, a dot on each vertex and a slab on each edge."""
    body_ = _add_body(spec, "object", [0, 0, 0], solid.inertia, solid.mass)
    for name, kind, axis in (("x", "SLIDE", [1, 0, 0]), ("y", "SLIDE", [0, 1, 0]), ("phi", "HINGE", [0, 0, 1])):
        body_.add_joint(name=name, type=getattr(mujoco.mjtJoint, f"mjJNT_{kind}"), axis=axis)
    corners = solid.vertices[: solid.count]
    for k, corner in enumerate(corners):
        _add_geom(body_, f"v{k}", "SPHERE", [POINT_RADIUS * size, 0, 0], [*corner, 0])
    thick, dot = HALF_SPACE_DEPTH * size, POINT_RADIUS * size
    beyond = 2 * EDGE_DEPTH * size  # slabs reach beyond their edges' ends by more than bodies sink in
    for k, (start, end) in enumerate(zip(corners, np.roll(corners, -1, 0), strict=True)):
        length = float(np.hypot(*(end - start)))
        _add_slab(body_, f"e{k}", -beyond, length + beyond, dot, 1.0, thick, start, (end - start) / length)


def _add_hand(spec, hand, size, compliance):
    """The palm, and two fingers with a motor each; the tip is a dot at the end of the contact edge.

    What only links meet: a dot on the joint, one at the end of a back apart from the contact edge, and the back's slab.
    """
    left, right = float(hand.joint[1, 0]), float(hand.joint[0, 0])
    thick, dot = HALF_SPACE_DEPTH * size, POINT_RADIUS * size
    beyond = [CORNER * size * (float(offset) <= 0) for offset in hand.offset]
    _add_slab(spec.worldbody, "palm", left - beyond[1], right + beyond[0], -dot, -1.0, thick)
    for k, (name, side) in enumerate(zip(LINKS[1:], (1.0, -1.0), strict=True)):
        length, offset = float(hand.length[k]), float(hand.offset[k])
        finger = _add_body(spec, name, [*np.asarray(hand.joint[k]), 0], hand.inertia[k], 1.0)
        finger.add_joint(
            name=f"theta{k + 1}",
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=[0, 0, 1],
            damping=[float(hand.viscous[k]), 0, 0],
            frictionloss=float(hand.dry[k]),
            # Dry friction is as stiff as MuJoCo makes it: the joint creeps least where it should stand.
            solref_friction=[2 * spec.option.timestep, 1.0],
            solimp_friction=[0.999, 0.999, 1e-3, 0.5, 2],
            limited=mujoco.mjtLimited.mjLIMITED_TRUE,
            range=np.asarray(hand.range[k]),
            solref_limit=compliance["solref"],
            solimp_limit=compliance["solimp"],
        )
        _add_slab(finger, name, -beyond[k], length + CORNER * size, side * offset - side * dot, -side, thick)
        _add_geom(finger, f"{name}_tip", "SPHERE", [dot, 0, 0], [length, side * offset, 0])
        back = float(hand.back[k])
        _add_slab(finger, f"{name}_back", 0.0, length, -side * (back - dot), side, thick)
        _add_geom(finger, f"{name}_back_tip", "SPHERE", [dot, 0, 0], [length, -side * back, 0])
        _add_geom(spec.worldbody, f"{name}_joint", "SPHERE", [dot, 0, 0], [*np.asarray(hand.joint[k]), 0])
        motor = spec.add_actuator(name=name, target=f"theta{k + 1}", trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.gainprm[0], motor.biastype = 1.0, mujoco.mjtBias.mjBIAS_NONE


def _add_slab(owner, name, start, end, face, away, thick, origin=(0.0, 0.0), direction=(1.0, 0.0)):
    """A box along a line from `start` to `end`, its face at a height of `face`, its body on the side `away` of it.

    The line begins at `origin` and has a `direction` of unit length.
    """
    (x, y), along, height = direction, (start + end) / 2, face + away * thick / 2
    middle = [origin[0] + along * x - height * y, origin[1] + along * y + height * x, 0]
    half_angle = np.arctan2(y, x) / 2
    turn = [np.cos(half_angle), 0.0, 0.0, np.sin(half_angle)]
    _add_geom(owner, name, "BOX", [(end - start) / 2, thick / 2, thick / 2], middle, quat=turn)


def _add_geom(owner, name, kind, size, position, **more):
    """A shape that touches only what `_add_pairs` says."""
    shape = getattr(mujoco.mjtGeom, f"mjGEOM_{kind}")
    owner.add_geom(name=name, type=shape, size=size, pos=position, contype=0, conaffinity=0, **more)


def _add_pairs(spec, solid, size, timestep, softness):
    """Declare all pairs that may touch; name -> (row, the object's shape, the hand's shape)."""
    pairs, rows = contact_candidates(len(solid.vertices)), {}
    columns = (np.asarray(a).tolist() for a in (pairs.link, pairs.kind, pairs.feature))
    d, b = softness.impedance, 1 / (softness.slip_constant * timestep)
    for link, kind, feature in zip(*columns, strict=True):
        if feature >= solid.count:
            continue
        ours = f"{'v' if kind == VERTEX else 'e'}{feature}"
        other = LINKS[link] + ("_tip" if kind == EDGE else "")
        name = contact_name(link, kind, feature)
        rows[name] = len(rows), ours, other
        spec.add_pair(
            name=name,
            geomname1=ours,
            geomname2=other,
            condim=3,
            margin=PAIR_DISTANCE * size,
            friction=[float(solid.friction[link])] * 2 + [0, 0, 0],
            solreffriction=[0.0, -b * d],
            **_gives_way(softness, timestep),
        )
    return rows


def _gives_way(softness: ContactCompliance, timestep: float) -> dict[str, list[float]]:
    """MuJoCo's parameters of a contact or a limit that gives way as `softness` says."""
    d = softness.impedance
    return {"solref": [softness.time_constant * timestep, 1.0], "solimp": [d, d, 1e-3, 0.5, 2]}


def _add_link_pairs(spec, hand, size, timestep, softness) -> list[tuple[str, str, str]]:
    """Declare the pairs of links that may meet: (what meets, the dot, the slab)."""
    meetings = []
    for k in (0, 1):
        dots = [dot for dot, _ in link_dots(hand, k)]
        meetings += [(LINK_MEETINGS[1 + k], tip, "palm") for tip in dots[1:]]
        if not hand.layered:
            meetings += [(LINK_MEETINGS[0], dot, face) for dot in dots for face in link_faces(1 - k)]
    for _, dot, slab in meetings:
        spec.add_pair(
            name=f"{dot} on {slab}",
            geomname1=dot,
            geomname2=slab,
            condim=1,
            margin=PAIR_DISTANCE * size,
            **_gives_way(softness, timestep),
        )
    return meetings
