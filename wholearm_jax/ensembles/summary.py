"""Summarise: what became of very many scenes, without holding more of them than a sample."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from wholearm_jax.core import Status
from wholearm_jax.ensembles.batch import BatchResult
from wholearm_jax.model import Scene

SAMPLE = 100_000  # scenes, evenly spread, from which quantiles and influences are taken
QUANTILES = (0.0, 0.01, 0.05, 0.5, 0.95, 1.0)


@dataclass(frozen=True)
class EnsembleSummary:
    """How many of `count` scenes hold and how the others fail.

    `failures` counts (phase, status, contact), by name. `numbers` are the sampled scenes, `margins` [N] and `statuses`
    theirs.
    """

    count: int
    holds: int
    failures: dict[tuple[str, str, str | None], int]
    numbers: np.ndarray
    margins: np.ndarray
    statuses: np.ndarray

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % confidence interval of the share that holds (Wilson's)."""
        return wilson_interval(self.holds, self.count)

    @property
    def quantiles(self) -> dict[str, float]:
        """Margins [N] by the share of the scenes that stay below; minus infinity where no motion could be scored."""
        ordered = np.sort(self.margins)
        return {f"{q:g}": float(ordered[round(q * (len(ordered) - 1))]) for q in QUANTILES}

    @property
    def lines(self) -> list[str]:
        """The survey in words."""
        low, high = (100 * end for end in self.interval)
        share = 100 * self.holds / self.count
        told = [f"{self.holds} of {self.count} hold: {share:.2f} %, 95 % confidence interval {low:.2f} to {high:.2f} %"]
        told.append("margin [N] by quantile: " + ", ".join(f"{q}: {m:.4g}" for q, m in self.quantiles.items()))
        for (phase, status, contact), many in sorted(self.failures.items(), key=lambda item: -item[1]):
            told.append(f"{phase}: {status}" + (f" at {contact}" if contact else "") + f": {many}")
        return told

    def as_dict(self) -> dict:
        """The survey for a JSON file."""
        keys = ("phase", "status", "contact", "count")
        often = sorted(self.failures.items(), key=lambda item: -item[1])
        return {
            "count": self.count,
            "holds": self.holds,
            "share": self.holds / self.count,
            "interval": list(self.interval),
            "quantiles": {q: m if np.isfinite(m) else None for q, m in self.quantiles.items()},
            "failures": [dict(zip(keys, (*key, many), strict=True)) for key, many in often],
        }


def summarise(scene: Scene, chunks: Iterable[BatchResult], count: int) -> EnsembleSummary:
    """Count through chunks of results; `scene` gives phases and contacts their names."""
    every, first, holds, failures = max(1, -(-count // SAMPLE)), 0, 0, Counter()
    numbers, margins, statuses = [], [], []
    for part in chunks:
        bad = part.status != Status.OK
        holds += int((~bad).sum())
        rows, many = np.unique(
            np.stack([part.phase[bad], part.status[bad], part.contact[bad]]).astype(int), axis=1, return_counts=True
        )
        for (phase, status, contact), number in zip(rows.T.tolist(), many.tolist(), strict=True):
            at = scene.phases[phase]
            name = at.formation.names[contact] if contact >= 0 else None
            failures[at.name, Status(status).label, name] += number
        kept = np.arange(-first % every, len(part.status), every)
        numbers.append(first + kept)
        margins.append(part.margin[kept])
        statuses.append(part.status[kept])
        first += len(part.status)
    return EnsembleSummary(
        count, holds, dict(failures), *(np.concatenate(column) for column in (numbers, margins, statuses))
    )


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's 95 % confidence interval of a proportion."""
    from scipy.stats import binomtest  # takes half a second to import

    interval = binomtest(int(successes), int(trials)).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)


def rank_correlations(
    margins: Float[np.ndarray, "scenes"], offsets: Float[np.ndarray, "scenes parameters"]
) -> Float[np.ndarray, "parameters"]:
    """Compute Spearman's rank correlation of the margin with each parameter; 0 where either does not vary."""
    from scipy.stats import spearmanr

    correlations = np.zeros(offsets.shape[1])
    if len(margins) > 1 and np.any(margins != margins[0]):
        for k, column in enumerate(offsets.T):
            if np.ptp(column) > 0:
                correlations[k] = spearmanr(margins, column).statistic
    return correlations


def most_influential(parameters: Sequence[str], influence: Float[np.ndarray, "p"], most: int = 2) -> list[int]:
    """The numbers of the parameters that the margin depends on most."""
    order = np.argsort(-np.abs(influence), kind="stable")
    return [int(k) for k in order[:most] if influence[k] != 0 and parameters[k]]
