"""Which of MuJoCo's pairs of shapes act: those that stand for a contact, not those that meet a shape's thickness.

Slabs and wedges are thicker than what they stand for. A fingertip touches an edge only where its finger comes from the
edge's outer side: from the inner side the finger meets an end of the edge first, and a tip that slips past that vertex,
a little inside it, would catch on the edge. A vertex touches a finger as far as its tip, where the slab goes on: its
end would push away along the finger a vertex that is less far from the tip than it has sunk in. And a dot of a finger
meets that face of the other finger on whose side it last was beyond that finger's end, around which it may pass.
"""

# MuJoCo's names come from a compiled module, which type checkers cannot see into.
# pyright: reportAttributeAccessIssue=false

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from wholearm_jax.model import EDGE, LINKS, VERTEX, Hand, parse_contact

AS_COMPLEX = np.array([1, 1j])  # `(x, y) @ AS_COMPLEX = x + iy`
FAR_BELOW = 1e9  # how far below its margin a contact that is left out would act


@dataclass(frozen=True)
class EdgePairs:
    """Pairs of a fingertip and an edge: rows of MuJoCo's pairs, fingers (0 or 1), and the edges' outward normals."""

    row: Int[np.ndarray, "edge_pairs"]
    finger: Int[np.ndarray, "edge_pairs"]
    normal: Float[np.ndarray, "edge_pairs 2"]  # in the object's frame


@dataclass(frozen=True)
class VertexPairs:
    """Pairs of a vertex and a finger: rows of MuJoCo's pairs, fingers (0 or 1), and places as `x + iy` [m]."""

    row: Int[np.ndarray, "vertex_pairs"]
    finger: Int[np.ndarray, "vertex_pairs"]
    vertex: Complex[np.ndarray, "vertex_pairs"]  # in the object's frame
    joint: Complex[np.ndarray, "vertex_pairs"]  # the finger's, and
    length: Float[np.ndarray, "vertex_pairs"]  # how far it goes


@dataclass(frozen=True)
class FacePairs:
    """Pairs of a finger's dot and the faces of the other finger: that toward the object, and its back.

    `row` has MuJoCo's pairs with either face, `finger` (0 or 1) is the one with the faces and `dot` the other one's
    place in its own frame, whose x-axis is the finger, as `x + iy`.
    """

    row: Int[np.ndarray, "dots 2"]
    finger: Int[np.ndarray, "dots"]
    dot: Complex[np.ndarray, "dots"]


@dataclass(frozen=True)
class ActingPairs:
    """What decides which pairs act; those that do begin at a `gap` [m]."""

    edges: EdgePairs
    vertices: VertexPairs
    faces: FacePairs
    hand: Hand
    gap: float


def acting_pairs(model: mujoco.MjModel, names: tuple[str, ...], solid, hand: Hand, gap: float) -> ActingPairs:
    """Return the pairs of a model, whose contacts are `names`, that act at some times only."""
    edges, vertices = _edge_pairs(model, names, solid), _vertex_pairs(model, names, solid, hand)
    return ActingPairs(edges, vertices, _face_pairs(model, hand), hand, gap)


def _edge_pairs(model: mujoco.MjModel, names: tuple[str, ...], solid) -> EdgePairs:
    corners = solid.vertices[: solid.count]
    along = np.roll(corners, -1, 0) - corners
    row, finger, feature = _finger_pairs(model, names, EDGE)
    return EdgePairs(row, finger, np.stack([along[feature, 1], -along[feature, 0]], axis=1))


def _vertex_pairs(model: mujoco.MjModel, names: tuple[str, ...], solid, hand) -> VertexPairs:
    row, finger, feature = _finger_pairs(model, names, VERTEX)
    vertex, joint = solid.vertices[feature] @ AS_COMPLEX, np.asarray(hand.joint)[finger] @ AS_COMPLEX
    return VertexPairs(row, finger, vertex, joint, np.asarray(hand.length)[finger])


def _finger_pairs(model: mujoco.MjModel, names: tuple[str, ...], kind: int) -> Int[np.ndarray, "3 pairs"]:
    """Return the rows of MuJoCo's pairs of the fingers with one kind of feature, fingers (0 or 1), and features."""
    parsed = [(name, *parse_contact(name)[:3]) for name in names]
    return np.array([(model.pair(name).id, link - 1, k) for name, link, own, k in parsed if own == kind and link > 0]).T


def _face_pairs(model: mujoco.MjModel, hand) -> FacePairs:
    dots = [] if hand.layered else [(k, name, at) for k in (0, 1) for name, at in link_dots(hand, k)]
    rows = [[model.pair(f"{name} on {face}").id for face in link_faces(1 - k)] for k, name, _ in dots]
    return FacePairs(
        np.array(rows, int).reshape(-1, 2),
        np.array([1 - k for k, _, _ in dots], int),
        np.array([complex(*at) for _, _, at in dots], complex),
    )


def choose_pairs(
    model: mujoco.MjModel, acting: ActingPairs, qpos: Float[np.ndarray, "5"], everywhere: bool = False
) -> None:
    """Leave out, for the next step, pairs of which a shape's thickness would be met, not what it stands for.

    Faces are chosen anew where a dot is beyond the other finger's end, or `everywhere`.
    """
    phi, angles = qpos[2], qpos[3:]
    vertices = acting.vertices
    corner = qpos[0] + 1j * qpos[1] + vertices.vertex * np.exp(1j * phi)
    along = ((corner - vertices.joint) * np.exp(-1j * angles)[vertices.finger]).real
    _act(model, acting, vertices.row, along <= vertices.length)
    normal, toward_tip = acting.edges.normal, angles[acting.edges.finger] - phi
    from_outside = normal[:, 0] * np.cos(toward_tip) + normal[:, 1] * np.sin(toward_tip) <= 0
    _act(model, acting, acting.edges.row, from_outside)
    if len(acting.faces.row):
        _choose_faces(model, acting, angles, everywhere)


def _choose_faces(model: mujoco.MjModel, acting: ActingPairs, angles: Float[np.ndarray, "2"], everywhere: bool) -> None:
    """Let dots that are beyond the other finger's end, or all, meet that of its faces on whose side they are."""
    hand, faces = acting.hand, acting.faces
    other, finger = 1 - faces.finger, faces.finger
    turn, joint = np.exp(1j * angles), hand.joint @ AS_COMPLEX
    dot = (joint[other] + faces.dot * turn[other] - joint[finger]) / turn[finger]  # in the frame of the faces
    height = np.array([1.0, -1.0])[finger] * dot.imag  # toward the object
    beyond = everywhere | (dot.real > hand.length[finger])
    before = height > (hand.offset - hand.back)[finger] / 2
    _act(model, acting, faces.row[beyond], np.stack([before, ~before], axis=1)[beyond])


def _act(
    model: mujoco.MjModel, acting: ActingPairs, rows: Int[np.ndarray, "..."], whether: Bool[np.ndarray, "..."]
) -> None:
    """Let pairs act at their gap, or not at all."""
    model.pair_margin[rows] = np.where(whether, acting.gap, -FAR_BELOW * acting.gap)


def link_dots(hand, k: int) -> list[tuple[str, tuple[float, float]]]:
    """Return the names and places, in the finger's frame, of what may meet another link: its joint and tips."""
    name, side = LINKS[1 + k], (1.0, -1.0)[k]
    dots = [(f"{name}_joint", (0.0, 0.0)), (f"{name}_tip", (hand.length[k], side * hand.offset[k]))]
    if hand.offset[k] + hand.back[k] != 0:
        dots.append((f"{name}_back_tip", (hand.length[k], -side * hand.back[k])))
    return dots


def link_faces(k: int) -> tuple[str, str]:
    """Return the names of a finger's slabs, toward the object and away from it."""
    return LINKS[1 + k], f"{LINKS[1 + k]}_back"
