"""The package's own steps on a batch of random scenes: trace, reduce, simulate, score, judge, and what they found.

Each step is the public function of its module under one `vmap`: nothing is skipped and nothing is softened. Beside the
outcome, the tables are read at places and times for `checks` to look at.
"""

from functools import cache
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks.stability.scenes import Scenes
from wholearm_jax.dynamics import PathDynamics, evaluate, locate_panel, resolve_impact, tabulate_path_dynamics
from wholearm_jax.margin import best_quasistatic_torque_batch, contact_force, minimum_margin
from wholearm_jax.model import (
    Arrival,
    ContactFormation,
    Hand,
    PathTarget,
    Polygon,
    TorqueSchedule,
    configuration_unit,
    restrict_to_phase,
    rigid_body,
    scaled_mechanics,
    torque_at,
)
from wholearm_jax.phases import assess_phase
from wholearm_jax.simulation import IntegratorOptions, dense_output, evaluate_dense, path_acceleration, simulate_motion
from wholearm_jax.tracing import ContactPath, Resolution, trace_path

PLACES = np.concatenate([[0.0], (np.arange(30) + 0.5) / 30 + 0.01 * np.sin(np.arange(30.0)), [1.0]])
TIMES = (np.arange(9) + 0.5) / 9
GAUSS = np.polynomial.legendre.leggauss(4)


class Followed(NamedTuple):
    """What became of a scene's phase, and its tables read along the path, at times, and within steps (SI units)."""

    torque: TorqueSchedule
    status: Float[Array, ""]
    moving_status: Float[Array, ""]
    margin: Float[Array, ""]
    margin_share: Float[Array, ""]
    loss_time: Float[Array, ""]
    loss_contact: Float[Array, ""]
    ended: Float[Array, ""]
    phase_time: Float[Array, ""]
    s: Float[Array, ""]
    length: Float[Array, ""]
    w: Float[Array, ""]
    count: Float[Array, ""]
    rest: Float[Array, ""]
    departs: Float[Array, ""]
    moved: Float[Array, ""]
    along: dict
    at: dict
    ends: dict
    seam: Float[Array, ""]
    within: dict
    grain: Float[Array, ""]
    finite: Float[Array, ""]


def mechanics(scene: Scenes):
    """The package's system and heading of one scene."""
    shape = Polygon(scene.vertices, scene.count, scene.mass, scene.friction)
    solid = rigid_body(shape)
    solid = eqx.tree_at(lambda b: b.inertia, solid, jnp.where(scene.uniform, solid.inertia, scene.inertia))
    hand = Hand(
        joint=scene.joint,
        length=scene.length,
        offset=scene.offset,
        back=jnp.zeros(2),
        range=jnp.asarray([[-np.inf, np.inf]] * 2),
        inertia=scene.joint_inertia,
        viscous=scene.viscous,
        dry=scene.dry,
        torque_limit=scene.torque_limit,
        layered=jnp.asarray(True),
    )
    formation = ContactFormation(scene.link, scene.kind, scene.feature, scene.tangential)
    heading = PathTarget(scene.coordinate, scene.sign, scene.until_coordinate, scene.until_value)
    return scaled_mechanics(solid, hand, scene.gravity, formation), heading


def solid_vertices(scene: Scenes):
    """An object's vertices about its centre of mass."""
    return rigid_body(Polygon(scene.vertices, scene.count, scene.mass, scene.friction)).vertices


def prepare(scene: Scenes, resolution: Resolution) -> tuple[ContactPath, PathDynamics]:
    """Trace and reduce one scene."""
    formation, heading = mechanics(scene)
    path = trace_path(formation, scene.rough, heading, resolution)
    return path, tabulate_path_dynamics(formation, path)


def drive(dynamics: PathDynamics, scene: Scenes) -> TorqueSchedule:
    """A schedule for one scene, by `torque_kind`: 0, the best squeeze for a steady acceleration that passes the path in
    1 / `pace` of the duration, disturbed by `noise`; 1, random within the limits; 2, a thousand times that; 3, a
    millionth of it."""
    u = scene.pace * scene.knots
    one, rate, length = jnp.ones_like(u), scene.pace / scene.duration, dynamics.length
    places = dynamics.breakpoints[0] + length * jnp.minimum(u, 1.0) ** 2
    squeezed = best_quasistatic_torque_batch(
        dynamics, places, 2 * length * u * rate, 2 * length * rate**2 * one
    ).torque * (1 + scene.noise)
    random = scene.torque_limit * scene.noise
    kinds = [scene.torque_kind == k for k in range(3)]
    values = jnp.select(kinds, [squeezed, random, 1e3 * random], 1e-6 * random)
    return TorqueSchedule(scene.knots * scene.duration, jnp.where(jnp.isfinite(values), values, 0.0))


def follow(path: ContactPath, dynamics: PathDynamics, scene: Scenes, options: IntegratorOptions) -> Followed:
    """Simulate, score and judge one scene from rest, and read the results where the checks want them."""
    schedule = drive(dynamics, scene)
    phase_schedule = restrict_to_phase(schedule, jnp.zeros_like(scene.duration), scene.duration)
    motion = simulate_motion(dynamics, phase_schedule, scene.duration, options=options)
    found = minimum_margin(dynamics, phase_schedule, scene.duration, motion, options)
    entered = resolve_impact(dynamics, jnp.zeros_like(scene.rough))
    verdict, moving = (
        assess_phase(dynamics, motion, found, goal, entered) for goal in (Arrival.AT_REST, Arrival.MOVING)
    )
    end, s, w = (values[motion.count] for values in (motion.phase_time, motion.s, motion.w))
    steps = dense_output(dynamics, phase_schedule, scene.duration, motion)
    unit = configuration_unit(jnp.sqrt((solid_vertices(scene) ** 2).sum(1).max()))
    last = jnp.maximum(motion.count - 1, 0)
    rest = jnp.where(motion.at_rest[last] & (motion.count > 0), motion.phase_time[last], end)

    def read(segment, s):
        panel, xi = locate_panel(dynamics, segment, s)

        def velocity(s):
            panel, xi = locate_panel(dynamics, segment, s)
            return evaluate(dynamics.velocity, panel, xi)

        x, bend = jax.jvp(velocity, (s,), (jnp.ones_like(s),))
        z = evaluate(dynamics.configuration, panel, xi)
        return {"z": z, "x": x, "bend": bend, "slip": path.slip_sign[segment], "joint": path.joint_sign[segment]}

    def place(share):
        s = dynamics.breakpoints[0] + dynamics.length * share
        segment = jnp.minimum((s >= dynamics.breakpoints[1:-1]).sum(), dynamics.count - 1)
        panel, xi = locate_panel(dynamics, segment, s)
        tables = {
            "acceleration": evaluate(dynamics.acceleration, panel, xi),
            "force": evaluate(dynamics.force, panel, xi),
        }
        tables |= {"chart": path.chart[segment]}
        return read(segment, s) | tables

    def state(step, xi):
        arc = jax.tree.map(lambda a: a[step], steps)
        share, s, w = evaluate_dense(arc, xi)
        bend = path_acceleration(dynamics, phase_schedule, scene.duration, arc.segment, arc.row, share, s, w)
        motion = {"v": w / scene.duration, "a": bend / scene.duration**2, "share": share}
        pushed = contact_force(dynamics, phase_schedule, scene.duration, arc.segment, arc.row, share, s, w)
        motion |= {"torque": torque_at(phase_schedule, arc.row, share), "force": pushed}
        motion |= {"parts": magnitudes(arc, share, s, motion["v"])}
        return read(arc.segment, s) | motion | {"held": arc.at_rest | ~arc.live}

    def magnitudes(arc, share, s, v):
        """What each force is the sum of, in magnitude: against that its table is exact."""
        panel, xi = locate_panel(dynamics, arc.segment, s)
        terms = jnp.concatenate([jnp.stack([jnp.ones_like(v), v**2, v]), torque_at(phase_schedule, arc.row, share)])
        return jnp.abs(evaluate(dynamics.force, panel, xi)) @ jnp.abs(terms)

    def moment(share):
        step = jnp.clip((share >= motion.phase_time).sum() - 1, 0, last)
        width = motion.phase_time[step + 1] - motion.phase_time[step]
        xi = (share - motion.phase_time[step]) / jnp.where(width > 0, width, 1.0)
        return state(step, jnp.clip(xi, 0.0, 1.0))

    def node(k):
        step = jnp.where(k == 0, 0, last)
        fields = read(motion.segment[step], motion.s[k])
        entered = motion.w_begin[0]
        return fields | {"v": jnp.where(k == 0, entered, motion.w[k]) / scene.duration}

    def seam(k):
        """How far `z` and `z_dot` jump where piece `k` meets the next one."""
        here, there = (read(segment, dynamics.breakpoints[k + 1]) for segment in (k, k + 1))
        jumps = jnp.stack([there["z"] - here["z"], there["x"] * dynamics.speed_ratio[k + 1] - here["x"]]) / unit
        return jnp.where(k + 1 < dynamics.count, jnp.abs(jumps).max(), 0.0)

    # Rounding of what is differentiated in the panels of a piece, as short as pieces may be.
    extent = dynamics.breakpoints[motion.segment + 1] - dynamics.breakpoints[motion.segment]
    fine = jnp.finfo(end.dtype).eps * dynamics.panels[motion.segment] / jnp.where(extent > 0, extent, jnp.inf)
    grain = jnp.where(steps.live & ~motion.at_rest, fine, 0.0).max()
    tension = jnp.where(jnp.isfinite(found.loss_time), found.loss_time, 0.0)
    shares = jnp.concatenate([end * TIMES, tension * (1 + 1e-7 * jnp.array([-1.0, 1.0]))]).astype(end.dtype)
    nodes = jnp.arange(options.max_steps)
    xi = jnp.asarray((GAUSS[0] + 1) / 2, end.dtype)
    parts = (
        dynamics.acceleration,
        dynamics.force,
        dynamics.configuration,
        dynamics.velocity,
        motion.s,
        motion.w,
        motion.phase_time,
    )
    return Followed(
        torque=schedule,
        status=jnp.where(scene.at_rest, verdict.status, moving.status),
        moving_status=moving.status,
        margin=found.margin,
        margin_share=found.phase_time,
        loss_time=found.loss_time,
        loss_contact=found.loss_contact,
        ended=motion.status,
        phase_time=end,
        s=s - dynamics.breakpoints[0],
        length=dynamics.length,
        w=w,
        count=motion.count,
        rest=rest,
        departs=jnp.where(motion.at_rest[0], motion.phase_time[1], 0.0),
        moved=jnp.any(~motion.at_rest & (nodes < motion.count)),
        along=jax.vmap(place)(jnp.asarray(PLACES, end.dtype)),
        at=jax.vmap(moment)(shares),
        ends=jax.vmap(node)(jnp.stack([jnp.zeros_like(motion.count), motion.count])),
        seam=jax.vmap(seam)(jnp.arange(dynamics.speed_ratio.shape[0] - 1)).max(),
        within=jax.vmap(jax.vmap(state, (None, 0)), (0, None))(nodes, xi)
        | {
            "width": jnp.where(nodes < motion.count, motion.phase_time[1:] - motion.phase_time[:-1], 0.0)
            * scene.duration
        },
        grain=grain,
        finite=jnp.all(jnp.stack([jnp.all(jnp.isfinite(part)) for part in parts])),
    )


@cache
def tracer(resolution: Resolution):
    """`trace_phase` for a batch, compiled once."""
    return jax.jit(jax.vmap(lambda scene: prepare(scene, resolution)))


@cache
def follower(options: IntegratorOptions):
    """`trace_phase_path` for a batch, compiled once."""
    return jax.jit(jax.vmap(lambda path, dynamics, scene: follow(path, dynamics, scene, options)))


FLOATS = (
    *("vertices", "mass", "friction", "joint", "length", "offset", "joint_inertia", "viscous", "dry", "gravity"),
    *("rough", "until_value", "duration"),
)


def margin(floats: dict, scene: Scenes, options: IntegratorOptions):
    """The margin of a scene as a function of its floats and the schedule's values (in `floats["torque"]`)."""
    scene = scene._replace(**{name: floats[name] for name in FLOATS})
    _, dynamics = prepare(scene, Resolution())
    schedule = TorqueSchedule(jax.lax.stop_gradient(scene.knots * scene.duration), floats["torque"])
    phase_schedule = restrict_to_phase(schedule, jnp.zeros_like(scene.duration), scene.duration)
    motion = simulate_motion(dynamics, phase_schedule, scene.duration, options=options)
    return minimum_margin(dynamics, phase_schedule, scene.duration, motion, options).margin


@cache
def value(options: IntegratorOptions):
    """The margins of a batch."""
    return jax.jit(jax.vmap(lambda floats, scene: margin(floats, scene, options)))


@cache
def forward(options: IntegratorOptions):
    """Margins of a batch and their derivatives along given directions, in forward mode."""
    return jax.jit(jax.vmap(lambda f, way, scene: jax.jvp(lambda f: margin(f, scene, options), (f,), (way,))))


@cache
def reverse(options: IntegratorOptions):
    """The gradients of a batch, in reverse mode."""
    return jax.jit(jax.vmap(jax.grad(lambda floats, scene: margin(floats, scene, options))))
