"""Groups of results, and their statistics; a statistic without values is None."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from ground.campaigns.runner import Result
from knightcube.astro.arrays import FloatArray

Values = Sequence[float] | FloatArray


def grouped(results: Iterable[Result], *keys: str) -> dict[str, list[Result]]:
    """Return the results by the values of their `keys`, joined by slashes, in order of appearance."""
    groups: dict[str, list[Result]] = {}
    for result in results:
        groups.setdefault("/".join(str(result[key]) for key in keys), []).append(result)
    return groups


def mean(values: Values) -> float | None:
    """Return the mean."""
    return float(np.mean(values)) if len(values) else None


def median(values: Values) -> float | None:
    """Return the median."""
    return float(np.median(values)) if len(values) else None


def rms(values: Values) -> float | None:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else None


def largest(values: Values) -> float | None:
    """Return the largest value."""
    return float(np.max(values)) if len(values) else None


def squared_sigmas(error: FloatArray, covariance: FloatArray) -> float:
    """Return the normalised error squared of an error (n,) with a stated covariance (n, n)."""
    return float(error @ np.linalg.solve(covariance, error))
