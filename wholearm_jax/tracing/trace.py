r"""Trace the path `z(s)` of a contact formation: its start, its end, its kinks and its nodes.

Four constraints (gaps, and the places where rolling contacts touch) in five unknowns leave a curve that depends on
geometry alone, along which the object moves like a bead on a wire. It is parameterised by the linear coordinate
`s = s_ref + u . (z - z_ref)` (object units, see `scaled_mechanics`), `u` being the unit tangent where the chart begins;
where the curve turns away from `u` a new chart follows, so turning points of single coordinates are nothing special.
Continuation (`trace_curve`) runs on constants; the end and the kinks are roots on the path, whose derivatives follow
from the implicit function theorem (`solve_on_path`).

A path is split into *segments* where a contact's slip or a joint's speed reverses or the chart changes: within a
segment everything is smooth. Segments are divided into panels with Chebyshev nodes, at which the equations of motion
are tabulated.

Derivation: section 3 of `docs/derivation.md`.
"""

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.core import Status, eps_power
from wholearm_jax.model import PathTarget, ScaledMechanics, anchor_rolling
from wholearm_jax.tracing.continuation import trace_curve
from wholearm_jax.tracing.curve import TracedCurve
from wholearm_jax.tracing.event_location import locate_events
from wholearm_jax.tracing.events import event_functions
from wholearm_jax.tracing.nodes import solve_nodes
from wholearm_jax.tracing.path import ContactPath, PathEnd, Resolution
from wholearm_jax.tracing.projection import dominant_coordinate, orient_tangent, project_onto_path, settle_on_link
from wholearm_jax.tracing.segments import distribute_panels, segment_signs, split_into_segments
from wholearm_jax.tracing.start_checks import is_rank_deficient, links_overlap, violates_contact_limits


def trace_path(
    mechanics: ScaledMechanics,
    initial_guess: Float[Array, "5"],
    target: PathTarget,
    resolution: Resolution,
    may_settle: bool | Bool[Array, ""] = True,
) -> ContactPath:
    """Project an initial guess onto the path of a formation and follow the path to its end.

    Args:
        mechanics: the formation in object units.
        initial_guess: `z` in SI units (5,).
        target: the direction of travel, and where to stop before the formation ends (SI).
        resolution: array sizes.
        may_settle: whether the start may be moved to where a vertex a little behind a link touches (`settle_on_link`).

    Returns:
        The path. Nothing is raised: `status` is `no_convergence` (the contacts cannot all touch near the start, or an
        event or a node was not located), `left_formation` (at the start a contact is beyond its feature, or the object
        inside a link), `obstacle` (at the start links lie in one another),
        `singular` (dependent constraints, a fold, a bifurcation, or the target's coordinate does not
        move), `max_steps` (no end within reach) or `ok`.
    """
    # Scale to object units, and anchor rolling contacts where the initial guess has them.
    initial_guess = initial_guess / mechanics.configuration_unit
    until = target.until_value / mechanics.configuration_unit[target.until_coordinate]
    target = eqx.tree_at(lambda t: t.until_value, target, until)
    mechanics = eqx.tree_at(lambda m: m.contacts, mechanics, anchor_rolling(mechanics.contacts, initial_guess))
    fixed, fixed_target = stop_gradient(mechanics), stop_gradient(target)

    # Project, follow the curve, locate its end and kinks.
    start, residual, tangent = project_onto_path(mechanics, initial_guess)
    start, tangent = settle_on_link(mechanics, start, tangent, may_settle)
    tangent = orient_tangent(tangent, fixed_target)
    events = event_functions(mechanics, target, stop_gradient(start))
    fixed_start, fixed_events = stop_gradient((start, events))
    curve = trace_curve(fixed, fixed_events, fixed_start, tangent, resolution.max_continuation_steps)
    points = locate_events(mechanics, events, curve, resolution.segments)

    # Split into segments and solve the constraints at every node.
    segments = split_into_segments(curve, points, start, resolution.segments)
    layout = distribute_panels(stop_gradient(segments.breakpoints), segments.count, resolution)
    nodes, correction, reversals = solve_nodes(mechanics, curve, segments, layout, resolution)
    slip_sign, joint_sign, contradicted = segment_signs(
        stop_gradient(reversals), layout.segment_of_panel, resolution.segments
    )
    nodes_failed = contradicted | (correction.max() > eps_power(nodes, 3 / 8))

    # The first condition that holds decides.
    touches = residual < 100 * jnp.finfo(initial_guess.dtype).eps
    dependent = is_rank_deficient(fixed, stop_gradient(initial_guess))
    moves = jnp.abs(tangent[dominant_coordinate(target, tangent)]) > 1e-6
    refusals = (
        (~touches & dependent, int(Status.SINGULAR)),
        (~touches, int(Status.NO_CONVERGENCE)),
        (violates_contact_limits(fixed, fixed_start), int(Status.LEFT_FORMATION)),
        (links_overlap(fixed, fixed_start), int(Status.OBSTACLE)),
        (~moves, int(Status.SINGULAR)),
        (curve.status > 0, curve.status),
        (points.has_bifurcation, int(Status.SINGULAR)),
        (points.failed | nodes_failed, int(Status.NO_CONVERGENCE)),
    )
    reason, contact = _path_end(curve, mechanics.candidates.lower.shape[0])
    return ContactPath(
        status=jnp.select([c for c, _ in refusals], [status for _, status in refusals], int(Status.OK)),
        start=start,
        end=points.end,
        end_reason=reason,
        end_contact=contact,
        slip_sign=slip_sign,
        joint_sign=joint_sign,
        nodes=nodes,
        **layout._asdict(),
        **vars(segments),
    )


def _path_end(curve: TracedCurve, candidates: int) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """Translate the row of the terminal event into a `PathEnd` and the row of the contact or obstacle."""
    contacts_end, target = candidates + 8, candidates + 8  # the contacts' rows stand twice, then comes the target's
    reasons = (
        (curve.end < 0, int(PathEnd.NONE)),
        (curve.end < candidates, int(PathEnd.CONTACT_MADE)),
        (curve.end < contacts_end, int(PathEnd.FEATURE_END)),
        (curve.end == target, int(PathEnd.TARGET)),
    )
    row = jnp.select(
        [curve.end < candidates, curve.end < contacts_end],
        [curve.end, (curve.end - candidates) % 4],
        jnp.maximum(curve.end - target - 1, 0),
    )
    return jnp.select([c for c, _ in reasons], [end for _, end in reasons], int(PathEnd.OBSTACLE)), row
