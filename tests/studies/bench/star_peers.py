"""Runs another star identification program on our lists: tests/studies/bench/star_peers.py PEER JOBS.json.

The program runs without this repository in the Python environment of the other programs, because cedar-solve
needs numpy below 2. A job is a star list (`pixels`, `size`) or a frame (`image`, a numpy file), with the
field of view and its uncertainty in degrees. For a frame, the time includes the other program's star
extraction. A job with `passes` is repeated, and its time is the median. The program prints one JSON object
with the CPU time (ms) and the boresight (3,) of each job, or null for a refusal. It also prints by how much
catalogue and index increase the resident memory, after the import of the other program.
"""

import importlib
import json
import math
import resource
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

Solver = Callable[[dict[str, Any]], "list[float] | None"]


def direction(right_ascension: float, declination: float) -> list[float]:
    """Return the unit vector of a right ascension and declination in degrees."""
    ra, dec = math.radians(right_ascension), math.radians(declination)
    return [math.cos(dec) * math.cos(ra), math.cos(dec) * math.sin(ra), math.sin(dec)]


def cedar(**extraction: Any) -> Solver:
    """Return cedar-solve with its own database for fields of 10 to 30 deg."""
    import numpy as np  # noqa: PLC0415 - of the peer's Python, where it is asked for

    tetra3: Any = importlib.import_module("tetra3")
    solver = tetra3.Tetra3("default_database")

    def solve(job: dict[str, Any]) -> "list[float] | None":
        if "image" in job:
            size = job["image"].shape
            centroids = tetra3.get_centroids_from_image(job["image"], **extraction)
        else:
            size = (job["size"], job["size"])
            centroids = np.array(job["pixels"]).reshape(-1, 2)[:, ::-1] + 0.5
        found = solver.solve_from_centroids(
            centroids, size, job["field_deg"], job["known_deg"], distortion=None, solve_timeout=5000
        )
        return None if found["RA"] is None else direction(found["RA"], found["Dec"])

    return solve


def tetra3rs(**extraction: Any) -> Solver:
    """Return tetra3rs with a database for fields of 10 to 30 deg."""
    import numpy as np  # noqa: PLC0415

    peer: Any = importlib.import_module("tetra3rs")
    database = peer.SolverDatabase.generate_from_gaia(
        max_fov_deg=30.0, min_fov_deg=10.0, epoch_proper_motion_year=2026.5
    )

    def solve(job: dict[str, Any]) -> "list[float] | None":
        if "image" in job:
            rows, columns = job["image"].shape
            centroids = peer.extract_centroids(job["image"], threads=1, **extraction).centroids
        else:
            rows = columns = job["size"]
            places = np.array(job["pixels"]).reshape(-1, 2) - 0.5 * (columns - 1)
            centroids = np.column_stack([places, np.linspace(2.0, 1.0, len(places))])
        if len(centroids) < 4:
            return None
        found = database.solve_from_centroids(
            centroids,
            fov_estimate_deg=job["field_deg"],
            image_width=columns,
            image_height=rows,
            fov_max_error_deg=job["known_deg"],
        )
        return direction(found.ra_deg, found.dec_deg) if found else None

    return solve


PEERS: dict[str, tuple[str, Callable[[], Solver]]] = {
    "cedar-solve": ("tetra3", cedar),
    "cedar-solve, any area": ("tetra3", lambda: cedar(max_area=None)),
    "tetra3rs": ("tetra3rs", tetra3rs),
    "tetra3rs, any shape": ("tetra3rs", lambda: tetra3rs(max_elongation=None, max_sharpness=None)),
}
"""Module and solver factory of each other program, with its default filters or without filters."""


def main(peer: str, path: str) -> int:
    """Print the results of the program `peer` for the jobs of a file."""
    with open(path, encoding="utf-8") as file:
        jobs = json.load(file)
    module, make = PEERS[peer]
    try:
        importlib.import_module(module)
    except ImportError as error:
        sys.stderr.write(f"{error}\n")
        return 3
    import numpy as np  # noqa: PLC0415 - the peer's

    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    solve = make()
    results = []
    for number, job in enumerate(jobs):
        if "image" in job:
            job["image"] = np.load(job["image"])
        if number == 0:
            solve(job)
            megabytes = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024.0
        times = []
        for _ in range(job.get("passes", 1)):
            begin = time.process_time()
            boresight = solve(job)
            times.append(1000.0 * (time.process_time() - begin))
        results.append({"ms": statistics.median(times), "boresight": boresight})
        job.clear()
    sys.stdout.write(json.dumps({"results": results, "megabytes": megabytes}))
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
