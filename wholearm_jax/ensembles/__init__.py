"""Many scenes at once: draw, check, summarise, robust schedules."""

from wholearm_jax.ensembles.batch import (
    BLOCK,
    COARSE_PASS,
    BatchResult,
    SceneBatch,
    check,
    check_in_chunks,
    check_scene,
    from_result,
)
from wholearm_jax.ensembles.ensemble import Ensemble, make_ensemble
from wholearm_jax.ensembles.robust import optimise_robustly
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
