r"""Many scenes: how many a second one schedule is checked against, and what limits it.

    python benchmarks/batch.py [--quick]

The heptagon's whole plan (two phases, 2 s), every path traced anew, vertices within 0.2 mm and friction within 10 %, in
one process with a device for each processor: checks over the size of the batch, on one device as well, beside what two
gain for arithmetic alone; checks of the first phase alone (1 s); checks of objects that differ in friction and mass
alone; checks with the gradient of the margin with respect to all torques, optimisations, one process against two, the
largest difference of a margin from the full resolution, compile times (the first call's, nothing kept; compiled quickly
and well) and peak memory. Beside them MuJoCo's rollouts of the same plan with the same scenes on all threads, at the
longest of some time steps whose object ends within 1 % of its way from the prediction (`pose`), and at the longest
whose least force is within 1 % of the predicted one, or else the shortest (`margin`; phases are of equal length, and
twentieths of a phase at its ends are left out, where soft contacts take over); and the same with Coulomb's friction
(`execution`), at the longest step whose least force is.
"""

import argparse
import itertools
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import measure
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from layered_scenes import layered, layered_file

import wholearm_jax as wa
from wholearm_jax.ensembles import BLOCK, COARSE_PASS, check_scene, make_ensemble
from wholearm_jax.model import TorqueSchedule, pad_schedule
from wholearm_jax.simulation import Adjoint

HERE = Path(__file__).parent
COUNTS = (128, 1024, 8192, 65_536, 1_000_000)
ALIKE = 65_536
COMPARED = 8192
OPTIMISED = 3
VARIED = {"vertices": 0.0002, "friction": "10%"}
STEPS = (1.6e-3, 8e-4, 4e-4, 2e-4, 1e-4, 5e-5, 2.5e-5, 1.25e-5)
FINEST = 5e-5  # [s], of those with Coulomb's friction
ROLLOUTS = 16
ARRIVAL = 0.02


def memory() -> float:
    """The largest resident size so far [MiB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def checks(ensemble, torque, counts) -> dict:
    """Rates and memory over the size of the batch; the first call's time; the error of the margins."""
    begun = time.perf_counter()
    quick = wa.check(ensemble, torque, count=BLOCK, arrival=ARRIVAL)
    first = time.perf_counter() - begun
    rows = []
    for count in counts:
        begun, busy = time.perf_counter(), time.process_time()
        wa.check(ensemble, torque, count=count, arrival=ARRIVAL)
        rate, processor = count / (time.perf_counter() - begun), count / (time.process_time() - busy)
        rows.append({"count": count, "rate": rate, "rate_processor": processor, "memory": memory()})
        print(f"check {count}: {rate:.0f} a second, {processor:.0f} a processor-second, {memory():.0f} MiB", flush=True)
    full = wa.check(ensemble, torque, count=BLOCK, arrival=ARRIVAL, tolerance=1e-10)
    error = float(np.abs(quick.margin - full.margin).max())
    print(f"first call {first:.1f} s, error of a margin {error:.1e} N", flush=True)
    return {"first": first, "error": error, "rows": rows}


def scaling(ensemble, torque) -> dict:
    """What all devices gain over one: for checks, and for arithmetic without any memory to speak of."""

    def squares(x):
        return jax.lax.fori_loop(0, 200_000, lambda _, x: x * x - 0.5, x)

    def arithmetic(devices) -> float:
        mesh, each = Mesh(np.asarray(devices), ("scenes",)), PartitionSpec("scenes")
        loop = jax.shard_map(squares, mesh=mesh, in_specs=each, out_specs=each)
        run, start = jax.jit(loop), np.full(256 * len(devices), 0.1)
        jax.block_until_ready(run(start))
        begun = time.perf_counter()
        jax.block_until_ready(run(start))
        return len(devices) / (time.perf_counter() - begun)

    def check(devices) -> float:
        count = 8 * BLOCK * len(devices)
        wa.check(ensemble, torque, count=BLOCK, arrival=ARRIVAL, devices=devices)
        begun = time.perf_counter()
        wa.check(ensemble, torque, count=count, arrival=ARRIVAL, devices=devices)
        return count / (time.perf_counter() - begun)

    every, found = jax.devices(), {"devices": len(jax.devices())}
    for name, part in (("check", check), ("arithmetic", arithmetic)):
        pairs = [(part(every[:1]), part(every)) for _ in range(3)]
        gains = [all_of_them / one for one, all_of_them in pairs]
        found[name] = {"gain": float(np.median(gains)), "one": float(np.median([one for one, _ in pairs]))}
        print(f"{len(every)} devices over one, {name}: {found[name]['gain']:.2f}", flush=True)
    return found


def same_geometry(torque) -> dict:
    """Checks of objects that differ in friction and mass alone: their paths are one another's."""
    ensemble = make_ensemble(layered("heptagon"), {"mass": "5%", "friction": "10%"}, seed=1)
    wa.check(ensemble, torque, count=BLOCK, arrival=ARRIVAL)
    begun = time.perf_counter()
    wa.check(ensemble, torque, count=ALIKE, arrival=ARRIVAL)
    rate = ALIKE / (time.perf_counter() - begun)
    print(f"friction and mass alone: {rate:.0f} a second, {memory():.0f} MiB", flush=True)
    return {"count": ALIKE, "rate": rate, "memory": memory()}


def one_phase(torque) -> dict:
    """Checks of the first phase alone, a second of motion."""
    scene = layered("heptagon")
    ensemble = make_ensemble(replace(scene, phases=scene.phases[:1]), VARIED, seed=1)
    wa.check(ensemble, torque, count=BLOCK, arrival=ARRIVAL)
    begun = time.perf_counter()
    wa.check(ensemble, torque, count=ALIKE, arrival=ARRIVAL)
    rate = ALIKE / (time.perf_counter() - begun)
    print(f"one phase: {rate:.0f} a second", flush=True)
    return {"count": ALIKE, "rate": rate}


def gradients(ensemble, torque) -> dict:
    """Checks with the gradient with respect to all torques, a block at a time."""
    schedule, options = pad_schedule(torque), COARSE_PASS.options
    level = COARSE_PASS._replace(
        options=replace(options, adjoint=Adjoint.REVERSE, has_jumps=bool(np.any(np.diff(torque.times) == 0)))
    )

    def one(number):
        def margin(values):
            answer, _ = check_scene(ensemble.draw(number), TorqueSchedule(schedule.times, values), ARRIVAL, level)
            return answer.margin

        return jax.value_and_grad(margin)(schedule.values)

    block = jax.jit(lambda numbers: jax.lax.map(one, numbers))
    begun = time.perf_counter()
    jax.block_until_ready(block(np.arange(BLOCK)))
    first, begun = time.perf_counter() - begun, time.perf_counter()
    for k in range(2):
        jax.block_until_ready(block(np.arange(BLOCK) + k * BLOCK))
    rate = 2 * BLOCK / (time.perf_counter() - begun)
    print(f"check and gradient: {rate:.0f} a second, first call {first:.1f} s", flush=True)
    return {"first": first, "rate": rate}


def optimisations(ensemble) -> dict:
    """Each scene its own schedule, one after the other."""
    wa.optimise(ensemble.draw(np.asarray(0)))
    begun = time.perf_counter()
    for number in range(1, 1 + OPTIMISED):
        wa.optimise(ensemble.draw(np.asarray(number)))
    rate = OPTIMISED / (time.perf_counter() - begun)
    print(f"optimise: {rate:.2f} a second", flush=True)
    return {"rate": rate}


def margin_error(done) -> float:
    """How far the least force of an execution is from the predicted one, relative, changes of formation left out."""
    count = len(done.prediction.phases)
    time, least = done.expected.time, {}
    share = time / time[-1] * count % 1.0
    for which in ("expected", "executed"):
        forces = []
        for number, phase in enumerate(done.prediction.phases):
            inside = (time / time[-1] * count // 1 == number) & (share > 0.05) & (share < 0.95)
            for name in phase.contacts:
                column = done.expected.cn[:, done.names.index(name)] if which == "expected" else done.force(name)
                forces.append(np.nanmin(column[inside]))
        least[which] = min(forces)
    return float(abs(least["executed"] / least["expected"] - 1))


def laid_in(ensemble, torque):
    """The plan's prediction, and scenes of the ensemble with where each object lies in the hand."""
    from wholearm_jax.execution import start_near, start_of

    prediction = wa.simulate(ensemble.scene, torque)
    scenes = [ensemble.draw(np.asarray(number)) for number in range(ROLLOUTS)]
    return prediction, scenes, [start_near(s, start_of(prediction), np.zeros(3)) for s in scenes]


def roll_out(models, starts, torques) -> None:
    """Drive models from rest at their starts, on all threads."""
    import mujoco
    from mujoco import rollout

    state = mujoco.mjtState.mjSTATE_FULLPHYSICS
    places = np.zeros((len(models), mujoco.mj_stateSize(models[0], state)))
    places[:, 1:6] = starts  # time, positions, velocities
    data = [mujoco.MjData(models[0]) for _ in range(os.cpu_count() or 1)]
    rollout.rollout(models, data, places, torques[None])


def rollouts(ensemble, torque) -> dict:
    """MuJoCo, its own friction, all threads: rates at the longest time step that still ends near the prediction."""
    from wholearm_jax.execution import CONVEX, build_mujoco_model, clock, execute, motor_torques

    prediction, scenes, starts = laid_in(ensemble, torque)
    course = np.concatenate([np.asarray(t.z) for t in wa.trajectory(prediction)])
    moved = np.abs(np.diff(course, axis=0))
    way, turn = np.hypot(moved[:, 0], moved[:, 1]).sum(), moved[:, 2].sum()
    rows = []
    for wanted in STEPS:
        done = execute(prediction, timestep=wanted, softness=CONVEX)
        begins, step = clock(ensemble.scene, wanted)
        models = [build_mujoco_model(s, step, CONVEX).model for s in scenes]
        begun = time.perf_counter()
        roll_out(models, np.stack(starts), motor_torques(torque, begins, step))
        rate = ROLLOUTS / (time.perf_counter() - begun)
        pose = max(done.position_error / way, abs(done.angle_error) / turn)
        rows.append({"timestep": step, "rate": rate, "pose_error": float(pose), "margin_error": margin_error(done)})
        errors = f"end {100 * pose:.2g} % of the way off, margin {100 * rows[-1]['margin_error']:.3g} % off"
        print(f"MuJoCo at {step:g} s: {rate:.1f} a second, {errors}", flush=True)
        if rows[-1]["margin_error"] <= 0.01:
            break
    by_pose = next((row for row in rows if row["pose_error"] <= 0.01), rows[-1])
    return {"threads": os.cpu_count(), "rows": rows, "pose": by_pose, "margin": rows[-1]}


def by_coulomb(ensemble, torque) -> dict:
    """Free bodies with Coulomb's friction, all processors: the rate at the longest step with right margins."""
    from wholearm_jax.execution import build_mujoco_model, clock, execute, motor_torques
    from wholearm_jax.execution import rollout_in_parallel as driven

    prediction, scenes, starts = laid_in(ensemble, torque)
    steps = [step for step in STEPS if step >= FINEST]
    errors = [margin_error(execute(prediction, timestep=step)) for step in steps]
    wrong = max((k for k, error in enumerate(errors) if error > 0.01), default=-1)
    longest = min(wrong + 1, len(steps) - 1)
    wanted, error = steps[longest], errors[longest]
    begins, step = clock(ensemble.scene, wanted)
    copies = [(build_mujoco_model(s, step), start) for s, start in zip(scenes, starts, strict=True)]
    torques, workers = motor_torques(torque, begins, step), os.cpu_count() or 1
    list(driven(copies[:workers], itertools.repeat(torques[:10]), workers))  # starts the processes
    begun = time.perf_counter()
    list(driven(copies, itertools.repeat(torques), workers))
    rate = ROLLOUTS / (time.perf_counter() - begun)
    print(f"free bodies at {step:g} s: {rate:.2f} a second, margin {100 * error:.2g} % off", flush=True)
    return {"timestep": step, "rate": rate, "margin_error": error}


def processes(number: int, folder: Path, torque: Path, count: int, chunk: int) -> float:
    """The rate of a store's growth by `number` processes, after each has written its first chunk."""
    out = folder / f"{number}.zarr"
    varied = [f"--vary={name}={amount}" for name, amount in VARIED.items()]
    line = [
        sys.executable,
        "-c",
        "from wholearm_jax.cli.app import main; main()",
        "check",
        str(layered_file("heptagon")),
    ]
    line += ["--torque", str(torque), *varied, "--count", str(count), "--chunk", str(chunk), "--out", str(out)]
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(folder / "programs"), "MPLBACKEND": "agg"}
    joined = ["--coordinator", "127.0.0.1:47113", "--processes", str(number), "--process"]
    lines = [[*line, *joined, str(k)] if number > 1 else line for k in range(number)]
    silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    running = [subprocess.Popen(one, env=environment, **silent) for one in lines]
    if any(process.wait() for process in running):
        raise RuntimeError("a check failed")
    # All processes compute from the last of their first chunks on.
    written = np.array([(out / "margin" / "c" / str(k)).stat().st_mtime for k in range(count // chunk)])
    since = max(written[k::number][0] for k in range(number))
    rate = chunk * int((written > since).sum()) / (written.max() - since)
    print(f"{number} processes: {rate:.0f} a second", flush=True)
    return float(rate)


def by_processes(torque: Path) -> dict:
    """Rates of one process and of two."""
    with tempfile.TemporaryDirectory() as folder:
        return {str(n): processes(n, Path(folder), torque, 4096, 512) for n in (1, 2)}


def compiling() -> dict:
    """First calls and rates in processes of their own, compiled quickly and well, and from how many scenes on the
    second pays."""
    found = {}
    for mode in ("quickly", "well"):
        told = subprocess.run(
            [sys.executable, __file__, "--compiled", mode], capture_output=True, text=True, check=True
        )
        found[mode] = json.loads(told.stdout)
        print(
            f"compiled {mode}: first call {found[mode]['first']:.1f} s, {found[mode]['rate']:.0f} a second", flush=True
        )
    quickly, well = found["quickly"], found["well"]
    found["even"] = (well["first"] - quickly["first"]) / (1 / quickly["rate"] - 1 / well["rate"])
    print(f"compiling well pays from {found['even']:.0f} scenes on", flush=True)
    return found


def first_and_rate(ensemble, torque) -> dict:
    """The first call's time, nothing kept, and the rate of one of `COMPARED` scenes."""
    times = []
    for count in (BLOCK, COMPARED):
        begun = time.perf_counter()
        wa.check(ensemble, torque, count=count, arrival=ARRIVAL)
        times.append(time.perf_counter() - begun)
    return {"first": times[0], "rate": COMPARED / times[1]}


def draw(found: dict, path: Path) -> None:
    """Rates over the size of the batch, with lines for what has one rate."""
    figure, ax = plt.subplots(figsize=(4.2, 3.4), layout="constrained")
    rows = found["check"]["rows"]
    ax.loglog([r["count"] for r in rows], [r["rate"] for r in rows], "o-", color="#0072B2", label="check")
    lines = {
        "check and gradient": found["gradient"],
        "MuJoCo, end to 1 %": found["mujoco"]["pose"],
        "Coulomb's friction, margin to 1 %": found["coulomb"],
        "optimise": found["optimise"],
    }
    for (name, part), colour in zip(lines.items(), ("#009E73", "#D55E00", "#E69F00", "#CC79A7"), strict=True):
        ax.axhline(part["rate"], color=colour, ls="--", lw=1.2, label=name)
    ax.set(xlabel="scenes", ylabel="plans a second")
    ax.spines[["top", "right"]].set_visible(False)
    figure.legend(*ax.get_legend_handles_labels(), loc="outside upper center", ncols=2, frameon=False, fontsize=8)
    figure.savefig(path, bbox_inches="tight")


def main() -> None:
    """Measure, save, draw, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small batches of checks alone; nothing is written")
    parser.add_argument("--only", help="measure this part anew, e.g. check")
    parser.add_argument("--compiled", choices=("quickly", "well"), help=argparse.SUPPRESS)
    given = parser.parse_args()
    wa.configure(compiled=given.compiled or "well")
    jax.config.update("jax_num_cpu_devices", os.cpu_count() or 1)
    jax.config.update("jax_enable_compilation_cache", False)  # compile times are to be fresh
    ensemble, file = make_ensemble(layered("heptagon"), VARIED, seed=1), HERE / "data" / "heptagon_knots.csv"
    torque = wa.read_torque(file)
    if given.compiled:
        print(json.dumps(first_and_rate(ensemble, torque)))
        return
    if given.quick:
        checks(ensemble, torque, COUNTS[:2])
        return
    parts = {
        "check": lambda: checks(ensemble, torque, COUNTS),
        "compiled": compiling,
        "scaling": lambda: scaling(ensemble, torque),
        "same_geometry": lambda: same_geometry(torque),
        "one_phase": lambda: one_phase(torque),
        "mujoco": lambda: rollouts(ensemble, torque),
        "coulomb": lambda: by_coulomb(ensemble, torque),
        "gradient": lambda: gradients(ensemble, torque),
        "optimise": lambda: optimisations(ensemble),
        "processes": lambda: by_processes(file),
    }
    kept = measure.RESULTS / "batch.json"
    found = json.loads(kept.read_text()) if given.only else {}
    found.pop("machine", None)
    for name, part in parts.items():
        if given.only in (None, name):
            found[name] = part()
            measure.save("batch", found)
    draw(found, kept.with_suffix(".svg"))


if __name__ == "__main__":
    main()
