"""Do planned motions work? Goals on random parts, planned, optimised and executed by free bodies in MuJoCo.

    python benchmarks/plan_executions.py [--plans 50] [--regrasps 50] [--tumbling] [--seconds 4] [--quick]

Parts, hands and goals are those of `planning.py`; with regrasps, turns by 45 to 90 degrees, and slides after which a
finger leans 0.8 rad farther over the object, from elsewhere. Each part on each hand is asked one goal after the other,
and of the plans that are found the best with a regrasp is taken; with `--tumbling` the bundled heptagon and hexagon are
to turn by 90 and 180 degrees, either way, with a minute for each. The best plan is optimised, each phase in a second,
and executed at the default time step: open loop, and where that does not succeed, as where errors grow along a path,
under the law of `wholearm optimise --feedback` for the largest range of friction that it holds (20, 10, 5 % or the
nominal one), at 1 kHz, 1 ms late, with encoders of 4096 counts and 1 % of torque noise. An execution succeeds within
0.5 mm and 0.01 rad of the predicted end, the last contacts closed and no link met that should not be.
Prints and writes how many plans are optimised, how many executions succeed, and what became of the others; results of
a kind that is not run stay as they are kept.
"""

import argparse
import itertools
import time
from collections import Counter
from collections.abc import Iterable, Iterator

import numpy as np
from measure import kept, save
from planning import GOALS, HANDS, at_rest, objects

import wholearm_jax as wa
from wholearm_jax.core import Status
from wholearm_jax.ensembles import wilson_interval
from wholearm_jax.execution import ExecutionOutcome, Hardware, execute

WITH_REGRASPS = {
    **{f"turn {a} deg": {"phi": -np.radians(a)} for a in (45, 60, 75, 90)},
    "slide 20 mm, finger 1 by -0.8 rad": {"x": -0.02, "theta1": -0.8},
    "slide 20 mm, finger 2 by 0.8 rad": {"x": -0.02, "theta2": 0.8},
}
SECONDS_TO_TUMBLE = 60.0
FRICTION = (0.2, 0.1, 0.05, 0.0)  # half widths that a law is designed for, the largest that it holds


def plans(seconds: float, seed: int, with_regrasps: bool) -> Iterator[tuple[dict, wa.Scene]]:
    """Yield plans for one goal after the other, without end."""
    rng = np.random.default_rng(seed)
    goals = WITH_REGRASPS if with_regrasps else GOALS
    options = {"count": 3, "regrasp_cost": 0.0} if with_regrasps else {"count": 1}
    while True:
        for kind, shape in objects(rng, 1):
            for hand, (joint, length) in HANDS.items():
                scene, goal = at_rest(shape, joint, length), str(rng.choice(list(goals)))
                if scene is None:
                    continue
                found = wa.plan(scene, by=goals[goal], time_limit=seconds, **options).plans
                for plan in [each for each in found if not with_regrasps or any(s.regrasp for s in each.steps)][:1]:
                    about = {"kind": kind, "hand": hand, "goal": goal, "bound": plan.bound, "phases": len(plan.steps)}
                    yield about, plan.scene


def tumbles(seconds: float) -> Iterator[tuple[dict, wa.Scene | None]]:
    """Yield plans that turn the bundled objects by 90 and 180 degrees; None where there is none."""
    for name, degrees in itertools.product(("heptagon", "hexagon"), (-90, 90, -180, 180)):
        result = wa.plan(wa.load(name), by={"phi": np.radians(degrees)}, count=1, time_limit=seconds)
        about = {"kind": name, "hand": "its own", "goal": f"turn {degrees} deg"}
        if result.found:
            plan = result.plans[0]
            yield about | {"bound": plan.bound, "phases": len(plan.steps)}, plan.scene
        else:
            yield about | {"status": "no plan", "message": result.reason}, None


def design(scene: wa.Scene, schedule: wa.TorqueSchedule) -> tuple[float, wa.Controller]:
    """Design a law for the largest range of friction that it holds, of those tried."""
    for friction in FRICTION:
        law = wa.feedback(scene, schedule, friction=friction)
        if law.margin > 0:
            break
    return friction, law


def carry_out(scene: wa.Scene) -> dict:
    """Optimise a plan and execute it."""
    begun = time.perf_counter()
    optimum = wa.optimise(scene)
    found = {
        "status": optimum.result.status.name.lower(),
        "message": optimum.result.message,
        "margin": float(optimum.result.margin),
        "optimise_seconds": time.perf_counter() - begun,
    }
    if optimum.result.status != Status.OK:
        return found
    execution = execute(optimum.result)
    found["open_loop"] = execution.ending.value
    if execution.ending is not ExecutionOutcome.OK:
        try:
            found["friction"], law = design(scene, optimum.torque)
            execution = execute(optimum.result, controller=law, hardware=Hardware())
        except ValueError as refused:  # no law holds the object
            found["message"] = str(refused)
    return found | {
        "ending": execution.ending.value,
        "execution": execution.message,
        "position_error": execution.position_error,
        "angle_error": abs(execution.angle_error),
    }


def measure(planned: Iterable[tuple[dict, wa.Scene | None]]) -> Iterator[dict]:
    """Carry out plans, one after the other."""
    for about, scene in planned:
        row = about if scene is None else about | carry_out(scene)
        print(
            f"{row['kind']}, {row['hand']}, {row['goal']}: open loop {row.get('open_loop', 'none')};"
            f" {row.get('execution', row['message'])}",
            flush=True,
        )
        yield row


def report(label: str, rows: list[dict]) -> None:
    """Print how many succeed, and what became of the others."""
    endings = Counter(row.get("ending", "not executed: " + row["status"]) for row in rows)
    succeed = endings.pop(ExecutionOutcome.OK.value, 0)
    low, high = wilson_interval(succeed, len(rows))
    alone = sum(row.get("open_loop") == ExecutionOutcome.OK.value for row in rows)
    others = ", ".join(f"{count} {why}" for why, count in endings.most_common()) or "no other"
    errors = [row["position_error"] for row in rows if "position_error" in row]
    print(
        f"{label}: {succeed} of {len(rows)} executions succeed ({100 * low:.0f} to {100 * high:.0f} %),"
        f" {alone} of them open loop; {others};"
        f" {1e3 * np.median(errors):.3g} mm from the predicted end in the median"
    )


def main() -> None:
    wa.configure()
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--plans", type=int, default=50, help="without regrasps")
    parser.add_argument("--regrasps", type=int, default=50, help="plans with regrasps")
    parser.add_argument("--tumbling", action="store_true", help="turn the bundled objects by 90 and 180 degrees, too")
    parser.add_argument("--seconds", type=float, default=4.0, help="to plan for each goal")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--quick", action="store_true", help="one plan, half a second; nothing is written")
    given = parser.parse_args()
    counts = {"without regrasps": (given.plans, False), "with regrasps": (given.regrasps, True)}
    if given.quick:
        counts = {"without regrasps": (1, False)}
    seconds = 0.5 if given.quick else given.seconds
    planned: dict[str, Iterable] = {
        label: itertools.islice(plans(seconds, given.seed, with_regrasps), count)
        for label, (count, with_regrasps) in counts.items()
        if count
    }
    if given.tumbling:
        planned["tumbling"] = tumbles(SECONDS_TO_TUMBLE)
    for label, each in planned.items():
        rows: list[dict] = []
        for row in measure(each):
            rows.append(row)
            if not given.quick:  # as they come, for a run of hours may be cut short
                save("plan_executions", kept("plan_executions") | {label: rows})
        report(label, rows)


if __name__ == "__main__":
    main()
