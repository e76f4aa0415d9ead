"""What became of a phase is judged by rules: each rule at its edge, on motions that are written down, not simulated."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from support import layered

import wholearm_jax as wa
from wholearm_jax.dynamics import Impact
from wholearm_jax.margin import MarginResult
from wholearm_jax.model import Arrival
from wholearm_jax.phases.assessment import ARRIVAL_SPEED_FACTOR, BRAKING_SPEED, DEFAULT_ARRIVAL, assess_phase
from wholearm_jax.phases.contact_opening import MAX_OPENING, ContactOpening
from wholearm_jax.simulation import Motion

S = wa.Status
CALM = Impact(speed=jnp.asarray(0.0), impulse=jnp.zeros(4), size=jnp.asarray(1.0))
EDGE = 1e-3  # how far from an edge the cases stand, relatively


@pytest.fixture(scope="module")
def dynamics():
    return wa.trace(layered("heptagon"))[0].dynamics


def moved(dynamics, ended, short=0.0, speed=0.0, phase_time=1.0, rests=None):
    """A motion of two steps that ends `short` of its path (a share), with `speed` in path lengths a duration.

    `rests`: until when it waits at first; then the second step moves. None: both move.
    """
    end, length = float(dynamics.breakpoints[-1]), float(dynamics.length)
    first = 0.5 * phase_time if rests is None else rests
    s = [dynamics.breakpoints[0], dynamics.breakpoints[0] if rests is not None else end / 2, end - short * length]
    return Motion(
        phase_time=jnp.array([0.0, first, phase_time]),
        s=jnp.array(s),
        w=jnp.array([0.0, 0.0, speed * length]),
        w_begin=jnp.zeros(2),
        segment=jnp.zeros(2, int),
        row=jnp.zeros(2, int),
        at_rest=jnp.array([rests is not None, False]),
        count=jnp.asarray(2),
        status=jnp.asarray(int(ended)),
    )


def scored(lost=np.inf, contact=-1):
    numbers = {"margin": 1.0, "phase_time": 0.5, "s": 0.0, "contact": 0, "loss_time": lost, "loss_contact": contact}
    return MarginResult(**{name: jnp.asarray(value) for name, value in numbers.items()})


def opened(height):
    return ContactOpening(jnp.asarray(height), jnp.asarray(1e-3), jnp.asarray(2))


CLOSED = opened(0.0)


def judged(
    dynamics,
    motion,
    goal=Arrival.AT_REST,
    margin_result=None,
    impact=CALM,
    opening=opened(0.0),
    arrival=DEFAULT_ARRIVAL,
):
    code, scores = jnp.asarray(int(goal)), margin_result or scored()
    found = assess_phase(dynamics, motion, scores, code, impact, opening, arrival)
    return S(int(found.status)), float(found.phase_time), int(found.contact)


@pytest.mark.parametrize("arrival", [1e-6, 1e-2])
@pytest.mark.parametrize("ended", [S.OK, S.LEFT_FORMATION])
@pytest.mark.parametrize(("near", "slow"), [(True, True), (True, False), (False, True)])
def test_at_rest_at_the_end_means_near_and_slow(dynamics, ended, near, slow, arrival):
    """The speed left is at most what braking at 6 lengths a duration squared ends within the share of the path."""
    short = arrival * (1 - EDGE if near else 1 + EDGE)
    speed = np.sqrt(ARRIVAL_SPEED_FACTOR * arrival) * (1 - EDGE if slow else 1 + EDGE)
    status, share, contact = judged(dynamics, moved(dynamics, ended, short, speed), arrival=arrival)
    failed = S.NOT_REACHED if ended is S.OK else ended
    assert (status, share, contact) == (S.OK if near and slow else failed, 1.0, -1)
    assert np.sqrt(ARRIVAL_SPEED_FACTOR * arrival) == pytest.approx(np.sqrt(2 * 6 * arrival))


@pytest.mark.parametrize("slow", [True, False])
def test_what_brakes_harder_than_a_uniform_motion_may_be_as_fast_as_that_allows(dynamics, slow):
    """Braking by 200 lengths a duration squared in the last step, of half the duration, it needs 1e-6 of the path."""
    speed = np.sqrt(2 * 200.0 * DEFAULT_ARRIVAL) * (1 - EDGE if slow else 1 + EDGE)
    motion = moved(dynamics, S.LEFT_FORMATION, speed=speed)
    begin = (speed + 200.0 * 0.5) * dynamics.length
    motion = eqx.tree_at(lambda m: m.w_begin, motion, motion.w_begin.at[-1].set(begin))
    assert judged(dynamics, motion)[0] is (S.OK if slow else S.LEFT_FORMATION)


@pytest.mark.parametrize("slow", [True, False])
def test_what_brakes_however_hard_is_no_faster_than_a_tenth_of_the_mean_speed(dynamics, slow):
    speed = BRAKING_SPEED * (1 - EDGE if slow else 1 + EDGE)
    motion = moved(dynamics, S.LEFT_FORMATION, speed=speed)
    motion = eqx.tree_at(lambda m: m.w_begin, motion, motion.w_begin.at[-1].set(1e5 * dynamics.length))
    assert BRAKING_SPEED == 0.1
    assert judged(dynamics, motion)[0] is (S.OK if slow else S.LEFT_FORMATION)


@pytest.mark.parametrize("goal", [Arrival.MOVING, Arrival.ANY_SPEED])
@pytest.mark.parametrize("ended", [S.OK, S.LEFT_FORMATION])
def test_where_any_speed_will_do(dynamics, ended, goal):
    assert judged(dynamics, moved(dynamics, ended, speed=5.0, phase_time=0.7), goal)[0] is S.OK
    assert judged(dynamics, moved(dynamics, ended, short=0.1, speed=5.0), goal)[0] is (
        S.NOT_REACHED if ended is S.OK else ended
    )
    assert judged(dynamics, moved(dynamics, S.STUCK), goal)[0] is S.OK, "none is a speed, too"
    assert judged(dynamics, moved(dynamics, S.STUCK, short=0.1), goal)[0] is S.STUCK


def test_what_stands_near_the_end_has_arrived(dynamics):
    assert judged(dynamics, moved(dynamics, S.STUCK, short=0.9e-6))[0] is S.OK
    assert judged(dynamics, moved(dynamics, S.STUCK, short=1.1e-6))[0] is S.STUCK


def test_what_turns_back_has_arrived_if_it_was_late(dynamics):
    """As late as the speed it may have had would have taken it there."""
    allowed = np.sqrt(ARRIVAL_SPEED_FACTOR * DEFAULT_ARRIVAL)
    late, early = (moved(dynamics, S.REVERSED, phase_time=1 - allowed * (1 + side * EDGE)) for side in (-1, 1))
    assert judged(dynamics, late)[0] is S.OK
    assert judged(dynamics, early)[0] is S.REVERSED


def test_holds_are_broken_by_departing(dynamics):
    stays = moved(dynamics, S.STUCK, rests=1.0)
    assert judged(dynamics, stays, Arrival.HOLD) == (S.OK, 1.0, -1)
    forward = moved(dynamics, S.OK, rests=0.3)
    assert judged(dynamics, forward, Arrival.HOLD) == (S.NOT_REACHED, 0.3, -1)
    backward = moved(dynamics, S.REVERSED, rests=0.3, phase_time=0.3)
    assert judged(dynamics, backward, Arrival.HOLD) == (S.REVERSED, 0.3, -1)
    later = moved(dynamics, S.REVERSED, rests=0.3, phase_time=0.6)
    assert judged(dynamics, later, Arrival.HOLD) == (S.NOT_REACHED, 0.3, -1), "it set out forward first"
    at_once = moved(dynamics, S.OK)
    assert judged(dynamics, at_once, Arrival.HOLD) == (S.NOT_REACHED, 0.0, -1)


def test_a_tensile_force_counts_before_how_the_motion_ends(dynamics):
    for ended in (S.OK, S.LEFT_FORMATION, S.STUCK, S.REVERSED, S.MAX_STEPS):
        assert judged(dynamics, moved(dynamics, ended), margin_result=scored(0.4, 2)) == (S.CONTACT_LOST, 0.4, 2)
    held = moved(dynamics, S.STUCK, rests=1.0)
    assert judged(dynamics, held, Arrival.HOLD, scored(0.4, 2)) == (S.OK, 1.0, -1), "forces at rest are not determined"


OPENINGS = {
    "none opens": (0.1, 0.0, None),
    "one opens as little as surfaces are rough": (0.1, MAX_OPENING * (1 - EDGE), None),
    "one opens farther": (0.1, MAX_OPENING * (1 + EDGE), (S.CONTACT_LOST, 0.0, 2)),
    "one does not close again": (0.1, np.inf, (S.CONTACT_LOST, 0.0, 2)),
    "thrown back": (-1e-12, 0.0, (S.REVERSED, 0.0, -1)),
    "thrown back, and one opens": (-0.1, 1.0, (S.CONTACT_LOST, 0.0, 2)),
}


@pytest.mark.parametrize(("speed", "height", "expected"), OPENINGS.values(), ids=OPENINGS.keys())
@pytest.mark.parametrize("tensile", [False, True], ids=["", "tensile later"])
def test_impacts_that_are_refused(dynamics, tensile, speed, height, expected):
    """Before anything that happens later, and at the phase's beginning."""
    entered, opening = CALM._replace(speed=jnp.asarray(speed)), opened(height)
    score = scored(0.4, 0) if tensile else scored()
    otherwise = (S.CONTACT_LOST, 0.4, 0) if tensile else (S.OK, 1.0, -1)
    found = judged(dynamics, moved(dynamics, S.OK), margin_result=score, impact=entered, opening=opening)
    assert found == (expected or otherwise)


def test_a_path_that_cannot_be_traced_counts_before_all(dynamics):
    untraced = eqx.tree_at(lambda t: t.status, dynamics, jnp.asarray(int(S.NO_CONVERGENCE), dynamics.status.dtype))
    back = CALM._replace(speed=jnp.asarray(-1.0))
    found = judged(untraced, moved(dynamics, S.OK), margin_result=scored(0.4, 2), impact=back, opening=opened(np.inf))
    assert found == (S.NO_CONVERGENCE, 0.0, -1)
