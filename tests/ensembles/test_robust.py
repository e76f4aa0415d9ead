"""A schedule for a sample of scenes does better on scenes that it has not seen than one for the nominal scene."""

import json
from pathlib import Path

import equinox as eqx
import numpy as np
import pytest
from support import layered

import wholearm_jax as wa
from wholearm_jax.ensembles.ensemble import make_ensemble
from wholearm_jax.ensembles.robust import optimise_robustly
from wholearm_jax.model.scene import replace_duration


@pytest.fixture(scope="module")
def slide():
    plan = layered("heptagon")
    return eqx.tree_at(lambda s: s.phases, plan, plan.phases[:1])


@pytest.fixture(scope="module")
def told():
    return []


@pytest.fixture(scope="module")
def found(slide, told):
    both = wa.read_torque(Path(__file__).parents[1] / "data" / "heptagon_torque.csv")
    nominal = wa.torque_schedule(both.times[:51], both.values[:51])
    varied = make_ensemble(slide, {"friction": "20%"}, seed=1)
    return optimise_robustly(
        varied, samples=12, steps=40, arrival=0.02, nominal=nominal, callback=lambda *one: told.append(one)
    )


def test_more_of_the_unseen_scenes_hold(found):
    nominal, robust = found.out_of_sample
    assert nominal.success_rate < 0.7 < 0.9 < robust.success_rate


def test_the_worst_margin_of_unseen_scenes_is_larger(found):
    nominal, robust = found.out_of_sample
    assert robust.margin > nominal.margin + 0.02


def test_the_best_on_the_samples_is_kept(found):
    nominal, robust = found.in_sample
    assert (robust.success_rate, robust.margin) > (nominal.success_rate, nominal.margin)


def test_what_is_told_of_scenes_is_what_checks_find(slide):
    both = wa.read_torque(Path(__file__).parents[1] / "data" / "heptagon_torque.csv")
    nominal = wa.torque_schedule(both.times[:51], both.values[:51])
    varied = make_ensemble(slide, {"friction": "20%"}, seed=1)
    settings = {"samples": 12, "steps": 1, "quantile": 0.4, "arrival": 0.02}
    found = optimise_robustly(varied, nominal=nominal, **settings)
    checked = wa.check(varied, nominal, count=24, arrival=0.02)
    for held, rows in ((found.in_sample[0], slice(0, 12)), (found.out_of_sample[0], slice(12, 24))):
        assert held.success_rate == (checked.status[rows] == 0).mean()
        assert held.margin == pytest.approx(np.sort(checked.margin[rows])[4], abs=1e-5)


def test_numbers_of_samples_and_steps_are_asked_for(slide):
    with pytest.raises(ValueError, match="steps must be positive"):
        optimise_robustly(make_ensemble(slide, {"friction": "20%"}, seed=1), steps=0)


def test_a_nominal_schedule_keeps_to_the_plan_and_the_limits(slide):
    varied, limit = make_ensemble(slide, {"friction": "20%"}, seed=1), np.asarray(slide.hand.torque_limit)
    beyond, short = (
        wa.torque_schedule([0.0, end], [[0.0, 0.0], share * limit]) for end, share in ((1.0, 1.1), (0.5, 0.1))
    )
    with pytest.raises(ValueError, match=r"finger 1 is .* N m, its limit"):
        optimise_robustly(varied, nominal=beyond)
    with pytest.raises(ValueError, match=r"covers 0 to 0\.5 s"):
        optimise_robustly(varied, nominal=short)


def test_every_step_is_told(found, told):
    assert [step for step, _ in told] == list(range(41))
    nominal, robust = found.in_sample
    assert told[0][1] == nominal
    assert robust == max((held for _, held in told), key=lambda held: (held.success_rate, held.margin))


def test_unseen_scenes_are_others(found):
    for phase_schedule, unseen in zip(found.in_sample, found.out_of_sample, strict=True):
        assert phase_schedule.margin != unseen.margin


def test_what_the_command_writes(slide, wholearm, tmp_path):
    """A folder as of any plan: the nominal scene under the robust torques, and how many unseen scenes they hold."""
    wa.save(slide, tmp_path / "slide.toml")
    vary_by = ("--robust", "friction=20%", "--samples", "12", "--steps", "2", "--seed", "1", "--arrival", "0.02")
    status, out, _ = wholearm("optimise", tmp_path / "slide.toml", *vary_by, "--report", "--out", tmp_path / "out")
    lines = out.splitlines()
    assert lines[0].startswith("12 sampled scenes: nominal ")
    assert lines[1].startswith("12 unseen scenes: nominal ")
    assert f"-> {tmp_path / 'out'}" in lines[2]
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names >= {"torque.csv", "trajectory.csv", "summary.json", "report.html", "plan.svg", "result.svg"}
    told = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert told["command"] == "optimise --robust"
    assert f"robust {100 * told['unseen_share']:.1f} % hold, worst margin {told['unseen_margin']:.4g} N" in lines[1]
    assert status == (0 if told["unseen_share"] == 1 else 1)
    again = wa.simulate(slide, wa.read_torque(tmp_path / "out" / "torque.csv"), arrival=0.02)
    assert again.margin == told["margin"]
    assert "share that holds of unseen scenes" in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.slow
def test_an_object_that_waits_where_nothing_holds_it_does_not_hold(slide):
    """Fingers that open gently do not move the object as far as accelerations tell, but nothing holds it either."""
    both = wa.read_torque(Path(__file__).parents[1] / "data" / "heptagon_torque.csv")
    push = np.asarray(both.values[:51])
    late = eqx.tree_at(lambda s: s.phases, slide, (replace_duration(slide.phases[0], 1.2),))
    varied, share = make_ensemble(late, {"friction": "0.1%"}, seed=1), {}
    for name, torque in (("squeeze", 0.2 * push[0]), ("open", np.array([-0.05, 0.06]))):
        waiting = wa.torque_schedule([0.0, 0.2, *(0.2 + np.asarray(both.times[:51]))], [torque, torque, *push])
        found = optimise_robustly(varied, samples=12, steps=1, arrival=0.02, nominal=waiting)
        share[name] = found.in_sample[0].success_rate
        assert wa.simulate(varied.draw(0), waiting, arrival=0.02).status.label == (
            "ok" if share[name] else "contact_lost"
        )
    assert share == {"squeeze": 1.0, "open": 0.0}
