"""Attitude solvers beside scipy's Rotation.align_vectors: `python -m tests.studies.bench attitude`.

Random attitudes and stars, each star's error drawn from 0.3 to 3 times 5 arcsec. All solvers take every case
in turn, so that the machine's mood is shared; each is timed with its checks, its covariance and its loss,
scipy's with its loss alone. `apart` is the largest angle to the solution by singular values as the package
gives it, `of B` to the singular vectors of B alone, which lose rounding over the square of the stars'
separation, as scipy's do. NEES: squared error over the covariance, 1 when honest; for scipy, which gives
none, over the optimal one.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from knightcube.astro.arrays import FloatArray
from knightcube.astro.attitude.solvers import DEFAULT, SOLVERS, singular_values
from knightcube.astro.attitude.wahba import sightings
from knightcube.astro.quaternion import angle_between, conjugate, multiply, to_rotation_vector
from tests.knightcube.astro.attitude.sights import Sight, information, sight

_SEED = 20_412
_SIGMA = np.radians(5.0 / 3600.0)
_NARROW = np.radians(3.0)
_PEER = "scipy"
# Stars that their errors may bring together fix no attitude: no less than this part of a right angle's.
_LEAST_INFORMATION = 1e-5


@dataclass(frozen=True, slots=True)
class Family:
    """Cases of one kind: stars, half the field in rad, and the rotation in rad, drawn when None."""

    name: str
    stars: int
    half_field: float | None
    angle: float | None = None


FAMILIES = (
    Family("20 stars, whole sky", 20, None),
    Family("20 stars, 6 deg field", 20, _NARROW),
    Family("2 stars, whole sky", 2, None),
    Family("2 stars, 6 deg field", 2, _NARROW),
    Family("20 stars, 6 deg field, 180 deg", 20, _NARROW, np.pi - 1e-9),
    Family("20 stars, 6 deg field, no turn", 20, _NARROW, 0.0),
)


@dataclass(frozen=True, slots=True)
class Row:
    """One solver's figures on one family."""

    solver: str
    median_us: float
    p95_us: float
    apart: float
    apart_of_profile: float
    nees: float


def measure(family: Family, cases: int, seed: int) -> list[Row]:
    """Return the row of every solver and of scipy."""
    rng = np.random.default_rng([seed, FAMILIES.index(family)])
    times: dict[str, list[float]] = {name: [] for name in (*sorted(SOLVERS), _PEER)}
    apart = {name: (0.0, 0.0) for name in times}
    nees: dict[str, list[float]] = {name: [] for name in times}
    for _ in range(cases):
        seen = _case(rng, family)
        settled = SOLVERS["svd"](seen.observed, seen.reference, seen.sigma)
        profile = sightings(seen.observed, seen.reference, seen.sigma).profile
        alone = singular_values(profile)
        for name, taken in times.items():
            quaternion, covariance = _timed(name, seen, taken)
            error = to_rotation_vector(multiply(quaternion, conjugate(seen.quaternion)))
            spread = settled.covariance if covariance is None else covariance
            nees[name].append(float(error @ np.linalg.solve(spread, error)) / 3.0)
            off = (
                float(angle_between(quaternion, settled.quaternion)),
                float(angle_between(quaternion, alone)),
            )
            apart[name] = max(apart[name][0], off[0]), max(apart[name][1], off[1])
    return [
        Row(
            name,
            1e6 * float(np.median(taken)),
            1e6 * float(np.percentile(taken, 95.0)),
            *apart[name],
            float(np.mean(nees[name])),
        )
        for name, taken in times.items()
    ]


def _case(rng: np.random.Generator, family: Family) -> Sight:
    """Return a case whose stars are apart."""
    while True:
        seen = sight(rng, family.stars, family.half_field, _SIGMA, family.angle)
        least = np.linalg.eigvalsh(information(seen.observed, seen.sigma))[0]
        if least > _LEAST_INFORMATION * np.sum(seen.sigma**-2.0):
            return seen


def _timed(name: str, seen: Sight, taken: list[float]) -> tuple[FloatArray, FloatArray | None]:
    """Return a solver's quaternion (4,) and covariance (3, 3), None of scipy; note the time taken, s."""
    weights = seen.sigma**-2.0
    solver: Callable[..., object] = Rotation.align_vectors if name == _PEER else SOLVERS[name]
    third = weights if name == _PEER else seen.sigma
    start = time.perf_counter()
    solver(seen.observed, seen.reference, third)
    taken.append(time.perf_counter() - start)
    if name == _PEER:
        rotation, _ = Rotation.align_vectors(seen.observed, seen.reference, weights)
        # scipy's quaternion turns vectors, ours turns axes.
        return conjugate(rotation.as_quat()), None
    fix = SOLVERS[name](seen.observed, seen.reference, seen.sigma)
    return fix.quaternion, fix.covariance


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables, or one JSON object."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", type=int, default=2000, help="of each kind (default %(default)s)")
    parser.add_argument("--seed", type=int, default=_SEED, help="default %(default)s")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of the tables")
    options = parser.parse_args(arguments)
    if options.cases < 1:
        parser.error(f"--cases {options.cases}: at least 1")
    tables = {}
    for family in FAMILIES:
        rows = measure(family, options.cases, options.seed)
        tables[family.name] = [asdict(row) for row in rows]
        if not options.json:
            sys.stdout.write(_table(family, rows, options.cases, options.seed))
            sys.stdout.flush()
    if options.json:
        whole = {"seed": options.seed, "cases": options.cases, "default": DEFAULT, "families": tables}
        sys.stdout.write(json.dumps(whole) + "\n")
    return 0


def _table(family: Family, rows: Sequence[Row], cases: int, seed: int) -> str:
    peer = next(row for row in rows if row.solver == _PEER)
    lines = [
        f"{family.name} ({cases} cases, seed {seed})",
        "solver          median us   p95 us  x scipy   apart rad  of B rad   NEES",
    ]
    for row in sorted(rows, key=lambda row: row.median_us):
        name = row.solver + (" *" if row.solver == DEFAULT else "")
        lines.append(
            f"{name:14} {row.median_us:10.1f} {row.p95_us:8.1f} {row.median_us / peer.median_us:8.2f}"
            f"   {row.apart:9.1e} {row.apart_of_profile:9.1e} {row.nees:6.2f}"
        )
    return "\n".join([*lines, "* the default", ""]) + "\n"


if __name__ == "__main__":
    raise SystemExit(main())
