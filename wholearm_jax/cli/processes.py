"""Processes of one `wholearm check`: joined by `--coordinator` or by SLURM's variables, one device a processor."""

import os
from contextlib import suppress
from dataclasses import dataclass

from wholearm_jax.cli.arguments import BadInput


@dataclass(frozen=True)
class ProcessRank:
    """This process among those of a run."""

    number: int  # from 0
    count: int

    @property
    def is_first(self) -> bool:
        return self.number == 0

    def wait_for_others(self, name: str) -> None:
        """Return when every process has come to the barrier `name`."""
        if self.count > 1:
            from jax.experimental.multihost_utils import sync_global_devices

            sync_global_devices(name)


def use_all_processors() -> None:
    """Make one device for each processor, unless JAX has been given their number."""
    import jax

    is_set = "xla_force_host_platform_device_count" in os.environ.get("XLA_FLAGS", "")
    if not is_set and jax.config.values["jax_num_cpu_devices"] < 0:
        processors = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else range(os.cpu_count() or 1)
        with suppress(RuntimeError):  # a process that has used JAX before keeps its devices
            jax.config.update("jax_num_cpu_devices", len(processors))


def join_processes(coordinator: str | None, processes: int | None, process: int | None) -> ProcessRank:
    """Join the other processes of a run, if there are any. Raises `BadInput`."""
    given = [value is not None for value in (coordinator, processes, process)]
    slurm = int(os.environ.get("SLURM_NTASKS", "1")) > 1 and "SLURM_PROCID" in os.environ
    if not any(given) and not slurm:
        return ProcessRank(0, 1)
    if any(given) and not all(given):
        raise BadInput("several processes: give all of --coordinator HOST:PORT, --processes and --process")
    if process is not None and processes is not None and process >= processes:
        raise BadInput(f"--process {process}: there are only {processes}, counted from 0")
    import jax

    try:
        jax.distributed.initialize(coordinator, processes, process)
    except (RuntimeError, ValueError) as error:
        raise BadInput(f"--coordinator {coordinator}: {str(error).splitlines()[0]}") from None
    return ProcessRank(jax.process_index(), jax.process_count())
