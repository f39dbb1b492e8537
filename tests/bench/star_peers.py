"""Other people's star identification on our lists: python tests/bench/star_peers.py PEER LISTS.json.

Runs by itself, with nothing of this repository, in whichever Python the peers are installed in: cedar-solve
wants numpy below 2. Prints one JSON object: of each list milliseconds of CPU and the boresight (3,), or
null where the peer refused; and what the process grew by in resident memory with the catalogue and the
index, after the peer itself was imported.
"""

import importlib
import json
import math
import resource
import sys
import time
from collections.abc import Callable
from typing import Any

Solver = Callable[[dict[str, Any]], "list[float] | None"]


def direction(right_ascension: float, declination: float) -> list[float]:
    """Return the unit vector of a place given in degrees."""
    ra, dec = math.radians(right_ascension), math.radians(declination)
    return [math.cos(dec) * math.cos(ra), math.cos(dec) * math.sin(ra), math.sin(dec)]


def cedar() -> Solver:
    """Return cedar-solve with the database it comes with, 10 to 30 deg."""
    import numpy as np  # noqa: PLC0415 - the peers are imported where they are asked for
    from tetra3 import Tetra3  # type: ignore[import-not-found]  # noqa: PLC0415 - of the peer's Python

    solver = Tetra3("default_database")

    def solve(stars: dict[str, Any]) -> "list[float] | None":
        centroids = np.array(stars["pixels"]).reshape(-1, 2)[:, ::-1] + 0.5
        size = (stars["size"], stars["size"])
        found = solver.solve_from_centroids(
            centroids, size, stars["field_deg"], stars["known_deg"], distortion=None, solve_timeout=5000
        )
        return None if found["RA"] is None else direction(found["RA"], found["Dec"])

    return solve


def tetra3rs() -> Solver:
    """Return tetra3rs with a database for 10 to 30 deg."""
    import numpy as np  # noqa: PLC0415
    import tetra3rs as peer  # type: ignore[import-not-found]  # noqa: PLC0415 - of the peer's Python

    database = peer.SolverDatabase.generate_from_gaia(
        max_fov_deg=30.0, min_fov_deg=10.0, epoch_proper_motion_year=2026.5
    )

    def solve(stars: dict[str, Any]) -> "list[float] | None":
        size = stars["size"]
        centroids = np.array(stars["pixels"]).reshape(-1, 2) - 0.5 * (size - 1)
        brightness = np.linspace(2.0, 1.0, len(centroids))
        if len(centroids) < 4:
            return None
        found = database.solve_from_centroids(
            np.column_stack([centroids, brightness]),
            fov_estimate_deg=stars["field_deg"],
            image_width=size,
            image_height=size,
            fov_max_error_deg=stars["known_deg"],
        )
        return direction(found.ra_deg, found.dec_deg) if found else None

    return solve


PEERS: dict[str, tuple[str, Callable[[], Solver]]] = {
    "cedar-solve": ("tetra3", cedar),
    "tetra3rs": ("tetra3rs", tetra3rs),
}
"""Of each the module it is imported by, and what makes its solver."""


def main(peer: str, path: str) -> int:
    """Print the peer's answers to the lists of a file."""
    with open(path, encoding="utf-8") as file:
        lists = json.load(file)
    module, make = PEERS[peer]
    try:
        importlib.import_module(module)
    except ImportError as error:
        sys.stderr.write(f"{error}\n")
        return 3
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    solve = make()
    results = []
    solve(lists[0])
    megabytes = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024.0
    for stars in lists:
        begin = time.process_time()
        boresight = solve(stars)
        results.append({"ms": 1000.0 * (time.process_time() - begin), "boresight": boresight})
    sys.stdout.write(json.dumps({"results": results, "megabytes": megabytes}))
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
