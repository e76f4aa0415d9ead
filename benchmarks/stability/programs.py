"""The package's own steps on a batch of random scenes: trace, reduce, simulate, score, judge, and what they found.

Each step is the public function of its module under one `vmap`: nothing is skipped and nothing is softened. Beside the
outcome, the tables are read at places and times for `checks` to look at.
"""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp

from benchmarks.stability.readings import PLACES, TIMES, Followed, Readings
from benchmarks.stability.scenes import Scenes
from wholearm_jax.dynamics import PathDynamics, resolve_impact, tabulate_path_dynamics
from wholearm_jax.margin import best_quasistatic_torque_batch, minimum_margin
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
)
from wholearm_jax.phases import assess_phase
from wholearm_jax.phases.phase_tracing import trace_phase_path
from wholearm_jax.simulation import IntegratorOptions, dense_output, simulate_motion
from wholearm_jax.tracing import ContactPath, Resolution


def mechanics(scene: Scenes):
    """The package's system and heading of one scene."""
    shape = Polygon(scene.vertices, scene.count, scene.mass, scene.friction, flush_tolerance=scene.flush_tolerance)
    solid = rigid_body(shape)
    solid = eqx.tree_at(lambda b: b.inertia, solid, jnp.where(scene.uniform, solid.inertia, scene.inertia))
    hand = Hand(
        joint=scene.joint,
        length=scene.length,
        offset=scene.offset,
        back=scene.back,
        range=scene.range,
        inertia=scene.joint_inertia,
        viscous=scene.viscous,
        dry=scene.dry,
        torque_limit=scene.torque_limit,
        layered=scene.layered,
        clearance=jnp.zeros(()),
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
    path, _, _ = trace_phase_path(formation, scene.rough, heading, resolution, True, False)
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
    readings = Readings(path, dynamics, phase_schedule, scene.duration, motion, steps)
    unit = configuration_unit(jnp.sqrt((solid_vertices(scene) ** 2).sum(1).max()))
    last = readings.last
    tension = jnp.where(jnp.isfinite(found.loss_time), found.loss_time, 0.0)
    shares = jnp.concatenate([end * TIMES, tension * (1 + 1e-7 * jnp.array([-1.0, 1.0]))]).astype(end.dtype)
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
        rest=jnp.where(motion.at_rest[last] & (motion.count > 0), motion.phase_time[last], end),
        departs=jnp.where(motion.at_rest[0], motion.phase_time[1], 0.0),
        moved=jnp.any(~motion.at_rest & (jnp.arange(options.max_steps) < motion.count)),
        along=jax.vmap(readings.place)(jnp.asarray(PLACES, end.dtype)),
        at=jax.vmap(readings.moment)(shares),
        ends=jax.vmap(readings.node)(jnp.stack([jnp.zeros_like(motion.count), motion.count])),
        seam=jax.vmap(readings.seam, (0, None))(jnp.arange(dynamics.speed_ratio.shape[0] - 1), unit).max(),
        within=readings.within(options.max_steps),
        grain=readings.grain(),
        finite=readings.finite(),
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
    *(
        "vertices",
        "mass",
        "friction",
        "joint",
        "length",
        "offset",
        "back",
        "range",
        "joint_inertia",
        "viscous",
        "dry",
        "gravity",
    ),
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
