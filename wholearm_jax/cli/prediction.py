"""Trace and simulate a plan for a command, refuse unusable input, and note doubtful input on standard error."""

from pathlib import Path

import jax

from wholearm_jax.cli.arguments import BadInput, note

TOUCHING_TOL = 1e-6  # gap below which a contact touches, over the mechanics' unit of length


def trace_or_exit(name: str, scene):
    """Trace a plan.

    Raises `BadInput`, naming the contact, where the contacts of a formation cannot all touch at the start of its phase.
    """
    from wholearm_jax.phases import trace

    traced = trace(scene)
    failed = next((k for k, phase in enumerate(traced) if int(phase.dynamics.status) != 0), None)
    if failed is not None:  # the phases after it have no start
        _require_touching(name, scene, traced, failed)
    _note_unreached(name, scene, traced)
    return traced


def _require_touching(name: str, scene, traced, number: int) -> None:
    """Refuse a phase whose contacts do not all touch where it starts: from the given start, or the last phase's end."""
    import numpy as np

    from wholearm_jax.phases import target_configuration

    gaps, phase, previous = _gap_function(scene), scene.phases[number], scene.phases[number - 1]
    initial_guess = target_configuration(previous, traced[number - 1]) if number > 0 else scene.start
    gap, length, unit = gaps(phase.formation, traced[number].path.start, initial_guess)
    where = "with the others, from this start"
    if number > 0 and not np.any(gap > TOUCHING_TOL):
        gap, _, _ = gaps(phase.formation, initial_guess / unit, initial_guess)
        where = f"where phase '{previous.name}' ends"
    if np.all(gap <= TOUCHING_TOL):
        return
    worst = int(np.argmax(gap))
    contact = phase.formation.names[phase.formation.contact_of_row[worst]]
    key, size = f"phase[{number}].contacts", float(gap[worst] * length)
    if phase.formation.tangential[worst]:
        raise BadInput(f"{name}: {key}: {contact} cannot stay in its place {where}: it is off by {size:.3g} m")
    raise BadInput(f"{name}: {key}: {contact} cannot touch {where}: a gap of {size:.3g} m stays open")


def _gap_function(scene):
    """Return the function `(formation, z, initial_guess) -> (gap of each constraint, unit of length, units of z)`."""
    from wholearm_jax.model import anchor_rolling, constraints, contact_kinematics, rigid_body, scaled_mechanics

    @jax.jit
    def gaps(formation, z, initial_guess):
        mechanics = scaled_mechanics(rigid_body(scene.object), scene.hand, scene.gravity, formation)
        contacts = anchor_rolling(mechanics.contacts, initial_guess / mechanics.configuration_unit)
        kinematics, residual = contact_kinematics(contacts, z), jax.numpy.abs(constraints(contacts, z))
        outside = jax.numpy.maximum(contacts.lower - kinematics.along, kinematics.along - contacts.upper)
        distance = jax.numpy.hypot(kinematics.gap, jax.numpy.maximum(0.0, outside))
        is_angle = contacts.tangential if contacts.is_away is None else contacts.tangential | contacts.is_away
        gap = jax.numpy.where(is_angle, residual, distance)
        return gap, mechanics.length, mechanics.configuration_unit

    return gaps


def _note_unreached(name: str, scene, traced) -> None:
    """Note the phases that end before their `until`."""
    from wholearm_jax.model import COORDINATES
    from wholearm_jax.tracing import PathEnd

    for k, (phase, trace) in enumerate(zip(scene.phases, traced, strict=True)):
        row = int(phase.target.until_coordinate)
        if row >= 0 and int(trace.dynamics.status) == 0 and int(trace.path.end_reason) != PathEnd.TARGET:
            begin, end = (float(z[row]) for z in (trace.begin, trace.end))
            until = f"{COORDINATES[row]} = {float(phase.target.until_value):.6g}"
            note(f"{name}: phase[{k}].until: {until} is not on its path, which leads from {begin:.6g} to {end:.6g}")


def read_controller_of(scene, controller: Path):
    """Read a controller. Raises `BadInput` where it is one of another plan."""
    from wholearm_jax.feedback import require_same_plan
    from wholearm_jax.files import read_controller

    law = read_controller(controller)
    try:
        require_same_plan(law, scene)
    except ValueError as error:
        raise BadInput(f"{controller}: {error}") from None
    return law


def refuse_short(scene, schedule, torque: Path) -> None:
    """Raise `BadInput` for a schedule of file `torque` that is shorter than its plan, before anything is computed."""
    from wholearm_jax.phases import require_covered

    try:
        require_covered(scene, schedule)
    except ValueError as error:
        raise BadInput(f"{torque}: {error}") from None


def simulate_or_exit(scene, schedule, torque: Path, tolerance: float, traced):
    """Simulate a plan under the schedule of file `torque`. Raises `BadInput` for a schedule that is too short."""
    from wholearm_jax.phases import simulate

    refuse_short(scene, schedule, torque)
    note_doubtful_schedule(scene, schedule, torque)
    return simulate(scene, schedule, tolerance=tolerance, traced=traced)


def note_doubtful_schedule(scene, schedule, torque: Path) -> None:
    """Note that the schedule of file `torque` is much longer than its plan, or where it exceeds a torque limit."""
    from wholearm_jax.model import limit_violations
    from wholearm_jax.phases import note_on_length

    length = note_on_length(scene, schedule)
    if length is not None:
        note(f"{torque}: {length}")
    for joint, size, when, limit in limit_violations(schedule, scene.hand.torque_limit):
        note(f"{torque}: |tau{joint}| is {size:.4g} N m at t = {when:.4g} s, beyond the limit of {limit:.4g} N m")
