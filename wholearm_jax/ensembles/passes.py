"""One pass over packed scenes: blocks of scenes on every device, with the two compiled programs that serve them.

One program traces the paths of a block, the other tabulates, simulates and assesses on them; the second compiles in the
background while the first runs. A CPU checks the scenes of a block one after the other, each with loops that take only
the iterations they need; a GPU checks them side by side (`jax.vmap`). Where all scenes have the same paths, these are
traced once a block. With several devices, `shard_map` gives each its own block.
"""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from wholearm_jax.core import CachedJit, compile_in_background, wait_for
from wholearm_jax.ensembles.ensemble import Ensemble
from wholearm_jax.ensembles.scene_batch import SceneBatch, SceneSource
from wholearm_jax.ensembles.scene_check import BatchResult, Fidelity, check_on_paths
from wholearm_jax.model import LawTables, TorqueSchedule
from wholearm_jax.phases import trace_paths_in_one_program
from wholearm_jax.tracing import placeholder_path

BLOCK = 128  # scenes that one device takes at once


def run_pass(
    source: Ensemble | SceneBatch,
    numbers: np.ndarray,
    schedule: TorqueSchedule | LawTables,
    arrival,
    fidelity: Fidelity,
    mesh: Mesh,
) -> tuple[BatchResult, np.ndarray]:
    """Check the scenes `numbers` at one fidelity: their results, and the `NextPass` that each needs.

    The last block is filled up by repeating the last scene.
    """
    size = BLOCK * mesh.size
    filled = np.append(numbers, np.repeat(numbers[-1:], -len(numbers) % size))
    parts = []
    for block in filled.reshape(-1, size):
        if isinstance(source, Ensemble):
            parts.append(_check_block(source, jnp.asarray(block), schedule, arrival, fidelity, mesh))
        else:
            selected, renumbered = source.select(block), jnp.asarray(np.arange(size))
            parts.append(_check_block(selected, renumbered, schedule, arrival, fidelity, mesh))
    return jax.tree.map(lambda *columns: np.concatenate([np.asarray(c) for c in columns])[: len(numbers)], *parts)


def _check_block(
    source: SceneSource, numbers, schedule: TorqueSchedule | LawTables, arrival, fidelity: Fidelity, mesh: Mesh
):
    """Check `BLOCK` scenes a device."""
    side_by_side = mesh.devices.flat[0].platform != "cpu"
    common = source, schedule, arrival, fidelity, side_by_side
    compiled = compile_in_background(_precompile_checks, mesh, common, numbers)
    paths = _call_on_devices(mesh, trace_block, (source, fidelity.resolution, side_by_side), numbers)
    wait_for(compiled)
    return _call_on_devices(mesh, check_block, common, numbers, paths)


def _precompile_checks(mesh: Mesh, common: tuple, numbers) -> None:
    """Check scenes on placeholder paths, which compiles the program for traced ones."""
    source, _, _, fidelity, _ = common
    shape = mesh.size if source.has_common_paths else len(numbers), len(source.nominal.phases)
    paths = jax.tree.map(lambda a: np.broadcast_to(a, (*shape, *a.shape)), placeholder_path(fidelity.resolution))
    if mesh.size > 1:  # placed as traced paths will be
        paths = jax.device_put(paths, NamedSharding(mesh, PartitionSpec("scenes")))
    _call_on_devices(mesh, check_block, common, numbers, paths)


def _call_on_devices(mesh: Mesh, program: CachedJit, common: tuple, *per_device):
    """Call a program with `common` arguments, and with `per_device` arguments split over the devices."""
    if mesh.size == 1:
        return program(common, *per_device)
    own = jax.tree.map(lambda a: jax.ShapeDtypeStruct((len(a) // mesh.size, *a.shape[1:]), a.dtype), per_device)
    return _call_sharded(mesh, program.embedded(common, *own), common, *per_device)


@CachedJit
def _call_sharded(mesh: Mesh, program: Callable, common: tuple, *per_device):
    """Call a program on every device with its own part of the `per_device` arguments."""
    arrays, static = eqx.partition(common, eqx.is_array)

    def local(arrays, *per_device):
        return program(eqx.combine(arrays, static), *per_device)

    split, whole = PartitionSpec("scenes"), PartitionSpec()
    specs = (whole, *(split for _ in per_device))
    return jax.shard_map(local, mesh=mesh, in_specs=specs, out_specs=split, check_vma=False)(arrays, *per_device)


@CachedJit
def trace_block(common, numbers):
    """Trace the paths of scenes, once if all have the same; `common` is (source, resolution, side by side)."""
    source, resolution, side_by_side = common

    def trace_scene(number):
        return trace_paths_in_one_program(source.draw(number), resolution)

    return _map_scenes(trace_scene, side_by_side)(numbers[:1] if source.has_common_paths else numbers)


@CachedJit
def check_block(common, numbers, paths):
    """Check scenes on their paths; `common` is (source, schedule, arrival, fidelity, side by side)."""
    source, schedule, arrival, fidelity, side_by_side = common

    def check_one(number, paths):
        return check_on_paths(source.draw(number), paths, schedule, arrival, fidelity)

    if source.has_common_paths:
        shared = jax.tree.map(lambda a: a[0], paths)
        return _map_scenes(lambda number: check_one(number, shared), side_by_side)(numbers)
    return _map_scenes(lambda scene: check_one(*scene), side_by_side)((numbers, paths))


def _map_scenes(function, side_by_side: bool):
    """Map a function of one scene over scenes, side by side or one after the other."""
    return jax.vmap(function) if side_by_side else partial(jax.lax.map, function)
