"""Many scenes at once: draw, check, summarise, robust schedules."""

from wholearm_jax.ensembles.batch import check, check_in_chunks
from wholearm_jax.ensembles.ensemble import Ensemble, make_ensemble
from wholearm_jax.ensembles.passes import BLOCK
from wholearm_jax.ensembles.robust import optimise_robustly
from wholearm_jax.ensembles.scene_batch import SceneBatch
from wholearm_jax.ensembles.scene_check import COARSE_PASS, BatchResult, check_scene, from_result
from wholearm_jax.ensembles.summary import (
    EnsembleSummary,
    most_influential,
    rank_correlations,
    summarise,
    wilson_interval,
)

__all__ = [
    "BLOCK",
    "COARSE_PASS",
    "BatchResult",
    "Ensemble",
    "EnsembleSummary",
    "SceneBatch",
    "check",
    "check_in_chunks",
    "check_scene",
    "from_result",
    "make_ensemble",
    "most_influential",
    "optimise_robustly",
    "rank_correlations",
    "summarise",
    "wilson_interval",
]
