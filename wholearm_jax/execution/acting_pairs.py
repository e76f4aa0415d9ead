"""Which of MuJoCo's pairs of shapes act: those that stand for a contact, not those that meet a shape's thickness.

Slabs are thicker and longer than what they stand for. A fingertip touches an edge only between its ends, and where its
finger comes from the edge's outer side: from the inner side the finger meets an end of the edge first, and a tip that
slips past that vertex, a little inside it, would catch on the edge. Of two edges at a convex vertex that the tip has
sunk in, it touches the one in which it is less deep. A vertex touches a finger as far as its tip, where the slab goes
on: its end would push away along the finger a vertex that is less far from the tip than it has sunk in. And a dot of a
finger meets that face of the other finger on whose side it last was beyond that finger's end, around which it may pass.
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
    """Pairs of each fingertip and each edge: rows of MuJoCo's pairs, and places as `x + iy` [m].

    Edges are in the object's frame: a place `p` is `p * toward - origin` from where an edge begins, along the edge and
    to the object's inside. `convex` says it of the vertex at each one's end, `after` and `before` are the edges at
    either end. Deeper than `depth` [m] a tip is beyond an edge.
    """

    row: Int[np.ndarray, "fingers edges"]
    toward: Complex[np.ndarray, "edges"]  # of unit length
    origin: Complex[np.ndarray, "edges"]
    after: Int[np.ndarray, "edges"]
    before: Int[np.ndarray, "edges"]
    length: Float[np.ndarray, "edges"]
    convex: Bool[np.ndarray, "edges"]
    joint: Complex[np.ndarray, "fingers"]
    tip: Complex[np.ndarray, "fingers"]  # in the finger's frame, whose x-axis is the finger
    depth: float


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

    `row` has MuJoCo's pairs with either face, `finger` (0 or 1) is the one with the faces, `length` [m] long and with
    its joint at `joint`. They lie above and below `middle` [m] in its frame, whose x-axis is the finger; `upward` is 1
    or -1: that toward the object is above or below. `dot` is in the frame of the other finger, with its joint at
    `dot_joint`. Places are `x + iy` [m].
    """

    row: Int[np.ndarray, "dots 2"]
    finger: Int[np.ndarray, "dots"]
    joint: Complex[np.ndarray, "dots"]
    length: Float[np.ndarray, "dots"]
    middle: Float[np.ndarray, "dots"]
    upward: Float[np.ndarray, "dots"]
    dot: Complex[np.ndarray, "dots"]
    dot_joint: Complex[np.ndarray, "dots"]


@dataclass(frozen=True)
class ActingPairs:
    """What decides which pairs act; those that do begin at a `gap` [m]."""

    edges: EdgePairs
    vertices: VertexPairs
    faces: FacePairs
    gap: float


def acting_pairs(
    model: mujoco.MjModel, names: tuple[str, ...], solid, hand: Hand, gap: float, depth: float
) -> ActingPairs:
    """Return the pairs of a model, whose contacts are `names`, that act at some times only."""
    edges, vertices = _edge_pairs(model, names, solid, hand, depth), _vertex_pairs(model, names, solid, hand)
    return ActingPairs(edges, vertices, _face_pairs(model, hand), gap)


def _edge_pairs(model: mujoco.MjModel, names: tuple[str, ...], solid, hand: Hand, depth: float) -> EdgePairs:
    start = solid.vertices[: solid.count] @ AS_COMPLEX
    along = np.roll(start, -1) - start
    row, finger, _ = _finger_pairs(model, names, EDGE)
    toward, number = along.conj() / np.abs(along), np.arange(len(start))
    return EdgePairs(
        row=np.stack([row[finger == k] for k in range(2)]),
        toward=toward,
        origin=start * toward,
        after=np.roll(number, -1),
        before=np.roll(number, 1),
        length=np.abs(along),
        convex=(np.roll(along, -1) / along).imag > 0,
        joint=np.asarray(hand.joint) @ AS_COMPLEX,
        tip=np.array([complex(*link_dots(hand, k)[1][1]) for k in range(2)]),
        depth=depth,
    )


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
    finger, joint = np.array([1 - k for k, _, _ in dots], int), np.asarray(hand.joint) @ AS_COMPLEX
    return FacePairs(
        row=np.array(rows, int).reshape(-1, 2),
        finger=finger,
        joint=joint[finger],
        length=np.asarray(hand.length)[finger],
        middle=np.asarray(hand.offset - hand.back)[finger] / 2,
        upward=np.array([1.0, -1.0])[finger],
        dot=np.array([complex(*at) for _, _, at in dots], complex),
        dot_joint=joint[1 - finger],
    )


def choose_pairs(
    model: mujoco.MjModel, acting: ActingPairs, qpos: Float[np.ndarray, "5"], everywhere: bool = False
) -> None:
    """Leave out, for the next step, pairs of which a shape's thickness would be met, not what it stands for.

    Faces are chosen anew where a dot is beyond the other finger's end, or `everywhere`.
    """
    place, turn = complex(*qpos[:2]), np.exp(1j * qpos[2:])  # of the object; of it and each finger
    vertices = acting.vertices
    corner = place + vertices.vertex * turn[0]
    along = ((corner - vertices.joint) * turn[1:].conj()[vertices.finger]).real
    _act(model, acting, vertices.row, along <= vertices.length)
    _act(model, acting, acting.edges.row, _tip_touches(acting.edges, place, turn))
    if len(acting.faces.row):
        _choose_faces(model, acting, turn[1:], everywhere)


def _tip_touches(edges: EdgePairs, place: complex, turn: Complex[np.ndarray, "3"]) -> Bool[np.ndarray, "fingers edges"]:
    """Say which edges the fingertips touch if they come that near, for an object at `place` and the bodies' turns."""
    back, fingers = turn[0].conj(), turn[1:]
    tip = (edges.joint + edges.tip * fingers - place) * back
    from_start = np.multiply.outer(tip, edges.toward) - edges.origin
    along, inside = from_start.real, from_start.imag
    from_outside = np.multiply.outer(fingers * back, edges.toward).imag >= 0
    touches = from_outside & (along >= 0) & (along <= edges.length) & (inside < edges.depth)
    # At a convex vertex that the tip has sunk in from both sides, the less deep one.
    sunk = touches & (inside > 0)
    both = sunk & sunk[:, edges.after] & edges.convex
    if not both.any():
        return touches
    deeper = inside > inside[:, edges.after]
    return touches & ~(both & deeper) & ~(both & ~deeper)[:, edges.before]


def _choose_faces(model: mujoco.MjModel, acting: ActingPairs, turn: Complex[np.ndarray, "2"], everywhere: bool) -> None:
    """Let dots that are beyond the other finger's end, or all, meet that of its faces on whose side they are."""
    faces = acting.faces
    dot = faces.dot_joint + faces.dot * turn[1 - faces.finger] - faces.joint
    dot = dot * turn[faces.finger].conj()  # in the frame of the faces
    beyond = dot.real > faces.length
    if everywhere:
        beyond[:] = True
    if not beyond.any():
        return
    before = faces.upward * dot.imag > faces.middle
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
