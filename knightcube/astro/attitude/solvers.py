"""The attitude solvers by name, all of one signature, and the default (Michalski 3.4)."""

from __future__ import annotations

from knightcube.astro.arrays import FloatArray
from knightcube.astro.attitude import davenport, esoq2, foam, olae, predictive, quest, singular_values, triad
from knightcube.astro.attitude.wahba import AttitudeFix, Solver

SOLVERS: dict[str, Solver] = {
    "davenport": davenport.solve,
    "esoq2": esoq2.solve,
    "foam": foam.solve,
    "olae": olae.solve,
    "predictive": predictive.solve,
    "quest": quest.solve,
    "svd": singular_values.solve,
    "triad": triad.solve,
}
OPTIMAL = frozenset(SOLVERS) - {"olae", "triad"}
DEFAULT = "davenport"


def solve(observed: FloatArray, reference: FloatArray, sigma: FloatArray) -> AttitudeFix:
    """Return the default solver's attitude; arguments and exceptions as of every `Solver`."""
    return SOLVERS[DEFAULT](observed, reference, sigma)
