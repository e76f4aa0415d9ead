"""Closed-loop laws: their design, their file, an independent reading of both, and executions under other friction."""

import importlib
import itertools
import json
from dataclasses import replace

import equinox as eqx
import numpy as np
import pytest
from reference.feedback_law import Law

import wholearm_jax as wa
from wholearm_jax.core.errors import BadInput
from wholearm_jax.execution import Amounts, ExecutionOutcome, Hardware, execute, run_trials
from wholearm_jax.feedback import HeldSet, PassingImpulse, begin, held_set, law_tables, step
from wholearm_jax.phases import closed_loop_result

STEP = 5e-4  # of executions [s]


@pytest.fixture(scope="module")
def path(controller, tmp_path_factory):
    path = tmp_path_factory.mktemp("controller") / "controller.json"
    wa.write_controller(controller, path)
    return path


def test_a_reading_of_the_page_and_the_file_gives_the_same_torques(controller, path):
    """Along measured angles that lag, wander off the path, stand at stops and go beyond them."""
    rng, law, state = np.random.default_rng(0), Law(path), None
    phases, worst = set(), 0.0
    for k in range(2600):
        t, n = 1e-3 * k, 0 if state is None else state.phase
        u = t - (0.0 if state is None else state.began)
        at = np.interp(u - 0.01, controller.phases[n].time, controller.phases[n].s_ref)
        angles = [np.interp(at, controller.phases[n].s, controller.phases[n].theta[:, j]) for j in range(2)]
        angles = np.round((np.array(angles) + 2e-3 * rng.standard_normal(2)) * 652) / 652 if k % 400 < 200 else angles
        if state is None:
            state = begin(controller, np.asarray(angles))
        state, torque = step(controller, state, t, np.asarray(angles))
        worst = max(worst, np.abs(torque - law.torque(t, np.asarray(angles))).max())
        phases.add(state.phase)
    assert phases == {0, 1}
    assert worst < 1e-9
    assert law.arrived == state.arrived


def test_the_file_is_complete(controller, path, tmp_path):
    wa.write_controller(wa.read_controller(path), tmp_path / "again.json")
    assert (tmp_path / "again.json").read_bytes() == path.read_bytes()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda c: c.update(version=0), "version"),
        (lambda c: c.pop("stiffness"), "stiffness: is missing"),
        (lambda c: c["phases"][1].update(gain=[[0.0, 1.0]]), r"phases\[1\]: gain"),
        (lambda c: c["phases"][0]["s"].reverse(), r"phases\[0\]: s: "),
        (lambda c: c.update(push="much"), "push: must be numbers"),
    ],
)
def test_what_is_wrong_with_a_file_is_said_in_one_line(path, tmp_path, change, says):
    content = json.loads(path.read_text())
    change(content)
    (tmp_path / "bad.json").write_text(json.dumps(content))
    with pytest.raises(BadInput, match=f"bad.json.*{says}") as error:
        wa.read_controller(tmp_path / "bad.json")
    assert "\n" not in str(error.value)


def test_gains_accelerate_by_one_and_places_are_lengths(controller, scene):
    """`s` is the length of the curve of joint angles, and a torque `g` adds 1 rad/s^2 to its second derivative."""
    for law, traced in zip(controller.phases, wa.trace(scene), strict=True):
        assert np.allclose(np.hypot(*np.diff(law.theta, axis=0).T), np.diff(law.s), rtol=0, atol=1e-12)
        assert np.allclose(np.hypot(*law.tangent.T), 1.0)
        assert np.allclose(law.theta[-1], np.asarray(traced.end)[3:], atol=1e-6)
        dynamics, last = traced.dynamics, int(traced.dynamics.count) - 1
        panel = int(dynamics.first[last] + dynamics.panels[last]) - 1  # at its end, powers of 1 sum up
        pull = np.asarray(dynamics.acceleration)[panel].sum(0)[3:]
        rate = np.hypot(*np.asarray(dynamics.velocity)[panel].sum(0)[3:])
        assert rate * pull @ law.gain[-1] == pytest.approx(1.0, rel=1e-5)


def test_friction_that_open_loop_does_not_survive_is_survived(controller, scene):
    """A fifth more friction on all links: the schedule leaves the object short, the law brings it to its end."""
    rougher = eqx.tree_at(lambda s: s.object.friction, scene, 1.2 * scene.object.friction)
    prediction = wa.simulate(rougher, wa.quasistatic(scene))
    assert execute(prediction, timestep=STEP).ending is not ExecutionOutcome.OK
    closed = execute(prediction, controller=controller, hardware=Hardware(), seed=0, timestep=STEP)
    assert closed.ending is ExecutionOutcome.OK
    assert closed.position_error < 1e-4


def test_trials_count_against_each_objects_own_end(controller, scene):
    prediction = wa.simulate(scene, wa.quasistatic(scene))
    amounts = Amounts(friction=0.1, geometry=2e-4)
    trials = run_trials(prediction, 1, amounts, controller=controller, workers=1, timestep=STEP)
    (run,) = trials.runs
    assert run.own_ending is ExecutionOutcome.OK
    assert run.own_position_error != run.position_error
    assert trials.own_successes == 1


def test_the_least_force_under_a_law_is_that_of_the_model(controller, scene):
    """Free bodies, sampled, late and noisy, against the path's equation of motion: within 5 % of the mean force."""
    prediction = wa.simulate(scene, wa.quasistatic(scene))
    trials = run_trials(prediction, 1, Amounts(friction=0.1), controller=controller, workers=1, timestep=STEP)
    (run,) = trials.runs
    own = wa.simulate(run.scene, wa.quasistatic(scene))
    course = execute(own, controller=controller, hardware=Hardware(), timestep=STEP)
    mean = np.mean([course.force(name, course.course.time).mean() for name in scene.phases[-1].formation.names])
    model = wa.check([run.scene], controller=controller)
    assert model.status[0] == 0
    assert run.least_force == pytest.approx(float(model.margin[0]), abs=0.05 * mean)
    assert trials.message.endswith("all contacts kept on the way: 1")
    # The reference stands phase by phase from when the law began each, and waits for the next one.
    assert course.begins[1] > controller.phases[0].duration
    expected = course.expected
    assert expected.time[-1] == pytest.approx(course.course.time[-1])
    late = np.stack([np.interp(expected.time, course.course.time, course.course.z[:, k]) for k in (0, 1)], axis=1)
    assert np.hypot(*(late - expected.z[:, :2]).T).max() < 5e-4


def test_the_margin_is_that_of_the_set_under_the_law(controller, scene):
    """Not only of objects that move as the reference does: in its second phase some are late, at a lesser force."""
    frictions = [scene.object.friction * np.array(corner) for corner in itertools.product((0.8, 1.2), repeat=3)]
    tables = law_tables(controller)
    results = [
        closed_loop_result(eqx.tree_at(lambda s: s.object.friction, scene, friction), tables) for friction in frictions
    ]
    least = np.min([[float(phase.margin) for phase in result.phases] for result in results], axis=0)
    claimed = np.array([law.margin for law in controller.phases])
    assert np.all(claimed <= least + 1e-4)
    np.testing.assert_allclose(claimed, least, rtol=0.01)


def test_a_controller_of_another_plan_is_refused(controller):
    other = wa.load("hexagon")
    with pytest.raises(ValueError, match="another plan"):
        execute(wa.simulate(other, wa.quasistatic(other)), controller=controller)


def test_rates_that_are_whole_numbers_are_those_rates(scene):
    """In Python, and in a file, where 60 stands for 60.0."""
    rates = {"stiffness": 60, "integral": 10, "observer": 200}
    whole = wa.feedback(scene, wa.quasistatic(scene), friction=0.1, **rates)
    given = wa.feedback(
        scene, wa.quasistatic(scene), friction=0.1, **{name: float(rate) for name, rate in rates.items()}
    )
    assert all(phase.margin > 0 for phase in given.phases)
    assert [phase.margin for phase in whole.phases] == [phase.margin for phase in given.phases]


def test_a_path_on_which_the_joints_stand_still_has_no_law(tmp_path, wholearm):
    """A triangle turns about its vertex on the palm, held by finger 1 alone: where that is perpendicular to the line
    from there to the vertex that it holds, it turns back."""
    radius, joint = 0.03, 0.05
    corners = radius * np.array([[0.0, 0.0], *([np.cos(a), np.sin(a)] for a in np.deg2rad([40, 145]))])
    middle, finger = corners.mean(0), {"length": 0.05, "inertia": 1e-4, "torque_limit": 1.0}
    turn = {
        "name": "turn",
        "contacts": ["palm:v0 rolling", "finger1:v1", "finger2:away"],
        "toward": "phi+",
        "until": {"phi": 0.45},
        "duration": 1.0,
    }
    scene = wa.parse(
        {
            "title": "triangle",
            "gravity": 9.81,
            "hand": {f"finger{k}": finger | {"joint": [x, 0.0]} for k, x in ((1, joint), (2, -joint))},
            "object": {"vertices": (corners - middle).tolist(), "mass": 0.2, "friction": 0.6},
            "start": {
                **dict(zip("xy", middle.tolist(), strict=True)),
                "phi": 0.0,
                "theta1": float(np.arctan2(corners[1, 1], corners[1, 0] - joint)),
                "theta2": 3.0,
            },
            "phase": [turn],
        }
    )
    still = f"'turn': both joints stand still where theta1 is {180 - np.degrees(np.arcsin(radius / joint)):.1f} deg"
    with pytest.raises(ValueError, match=still):
        wa.feedback(scene, wa.quasistatic(scene))

    wa.save(scene, tmp_path / "triangle.toml")
    code, out, err = wholearm("optimise", tmp_path / "triangle.toml", "--feedback", "--out", tmp_path / "out")
    assert code == 1, "as where no law holds"
    assert "ok, margin" in out
    assert f"no controller.json: {still}" in err
    assert not (tmp_path / "out" / "controller.json").exists()


@pytest.mark.parametrize("wrong", [{"friction": 1.0}, {"stiffness": 0.0}])
def test_numbers_out_of_range_are_refused(scene, wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        wa.feedback(scene, wa.quasistatic(scene), **wrong)


@pytest.mark.parametrize(("least", "code"), [(0.1, 0), (-0.1, 1)])
def test_a_law_is_written_only_where_it_holds_the_whole_set(least, code, wholearm, monkeypatch, controller, tmp_path):
    asked = []

    def design(*_, **uncertain):
        asked.append(uncertain)
        return replace(controller, phases=tuple(replace(phase, margin=least) for phase in controller.phases))

    package = importlib.import_module("wholearm_jax.feedback")
    monkeypatch.setattr(package, "feedback", design)
    monkeypatch.setattr(package, "held_set", lambda *_, **__: HeldSet(0.5, 2))
    monkeypatch.setattr(package, "least_passing_impulse", lambda *_: PassingImpulse(1, "palm:v4", -0.021))
    robust = ("--robust", "friction=10%", "--robust", "vertices=0.0002")
    status, _, err = wholearm("optimise", "heptagon", "--feedback", *robust, "--knots", "11", "--out", tmp_path)
    assert status == code
    assert asked == [{"friction": 0.1, "mass": 0.0, "shape": 2e-4}]
    assert (tmp_path / "controller.json").exists() == (code == 0)
    assert (tmp_path / "torque.csv").exists()
    assert ("would open" in err) == (code == 1)
    smaller = "a law holds --robust vertices=0.0001 --robust friction=5%; with torque limits 2 times as large"
    assert (smaller in err) == (code == 1)
    pulls = "'flip right': for some objects of the set the impulse at its beginning pulls at palm:v4, 2.1 % of the"
    assert (pulls in err) == (code == 0)
    assert "SCENE --feedback" not in err, "that is what was just asked for"


@pytest.mark.slow
def test_what_holds_where_no_law_holds_the_whole_set():
    """The hexagon's flip begins at a limit of its motors."""
    scene = wa.load("hexagon")
    schedule = wa.optimise(scene).torque
    held = held_set(scene, schedule, friction=0.1, shape=0.0)
    assert held.share in (0.25, 0.5, 0.75)
    assert held.motors in (1.5, 2.0)
    with_share, beyond = (
        wa.feedback(scene, schedule, friction=0.1 * share, shape=0.0).margin
        for share in (held.share, held.share + 0.25)
    )
    assert beyond <= 0 < with_share


def test_sets_that_a_law_does_not_know_are_refused(wholearm, tmp_path):
    status, _, err = wholearm("optimise", "heptagon", "--feedback", "--robust", "gravity=10%", "--out", tmp_path)
    assert (status, len(err.splitlines())) == (2, 1)
    assert "--robust knows friction=20%, mass=10% and vertices=0.0005" in err
