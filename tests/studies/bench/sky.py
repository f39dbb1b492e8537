"""The star tracker on photographs and on simulated frames.

The photographs are in a folder with a file `truth.json`, which gives right ascension and declination of the
image's centre and the horizontal field of view in degrees. Each photograph is solved with a field of view
that is known to 5 %; photographs of 10 to 30 deg are also solved with an unknown field. Photographs with an
aspect ratio of 4 to 3 and a field of at least 10 deg are also reduced to 646 x 486 pixels (`reduced`) and
solved with a known field. The simulated frames have the simulator's camera with a field of 12 deg known to
0.1 deg and an exposure of 0.1 s. The angle of the axis of rotation from the boresight is random between 30
and 90 deg, or 90 deg in the rows with `across`. `over bound` is the rms error across the boresight divided by
the Cramer-Rao bound of the star positions; `bound` is the same ratio for the magnitude of the rate.
Identified stars lower the bound of the rate by at most 2 %, because the rate follows from the lengths of
streaks. Times are processor times of one core. For photographs, the time of each program is the median of
some passes after a first pass that is not counted. The other star identification programs extract the stars
themselves, with their default filters and without filters. `ratios` has, for each other program and each size
of photographs, the median ratio of this project's time to that program's time, with known field. `dim frames`
are frames of a calibrated camera with exposures so short that few stars are detected.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from ground.campaigns.runner import show
from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.quaternion import attitude_matrix, conjugate, multiply, to_rotation_vector
from knightcube.vision.camera.images import read_image
from knightcube.vision.frame_job import solve_frame
from knightcube.vision.startracker.solve import SolveSettings
from tests.knightcube.vision.startracker.frames import NARROW, SkyFrame, sky, sky_frame
from tests.studies.bench.star_peers import PEERS
from tests.studies.bench.starid import Answer, PeerPython, Peers, peer_answers
from tests.studies.command import Json, command, scratch
from tests.support.photographs import (
    _HIGHEST_DEG,
    _LOWEST_DEG,
    _NARROW_KNOWN_DEG,
    FIELD_SHARE,
    NARROW_DEG,
    PHOTOGRAPHS,
    RIGHT_ARCSEC,
    Photograph,
    angle_arcsec,
    centre_of,
    photograph,
    reduced,
    solved,
)

_SEED = 16_018
_STREAKS_PX = (0.0, 10.0, 20.0, 40.0, 80.0)
_OBLIQUE, _ACROSS = (30.0, 90.0), (90.0, 90.0)
_EXPOSURE = 0.1
_SHORT_EXPOSURES, _BEYOND = (0.003, 0.002, 0.0012, 0.0008), 6.0


_REDUCED, _ASPECT_ERROR = (646, 486), 0.02


@dataclass(frozen=True)
class Trial:
    """A photograph, its true values, whether its field is known, and its reduced size or None."""

    name: str
    truth: dict[str, float]
    known: bool
    size: tuple[int, int] | None = None

    def configuration(self) -> str:
        """Return the name of the group of trials in which the trial is counted."""
        kind = "photographs" if self.size is None else f"photographs of {self.size[0]} x {self.size[1]} px"
        return f"{kind}, field {'known' if self.known else 'unknown'}"


def _shown(folder: Path) -> Iterator[Trial]:
    """Yield the trials of all photographs; the trials of reduced photographs come last."""
    truth = json.loads((folder / "truth.json").read_text())
    for name, values in truth.items():
        yield Trial(name, values, True)
        if _LOWEST_DEG <= values["fov"] <= _HIGHEST_DEG:
            yield Trial(name, values, False)
    columns, rows = _REDUCED
    for name, values in truth.items():
        size = read_image(folder / name).shape
        similar = abs(size[1] / size[0] * rows / columns - 1.0) < _ASPECT_ERROR
        if similar and size[1] > columns and values["fov"] >= _LOWEST_DEG:
            yield Trial(name, values, True, _REDUCED)


def pictures_of(folder: Path, passes: int) -> list[Photograph]:
    """Return the results of all trials, with the median time of `passes` passes."""
    trials = list(_shown(folder))
    # In the first pass, numba loads each function from its file.
    each = [
        [photograph(folder, one.name, one.truth, one.known, one.size) for one in trials]
        for _ in range(1 + passes)
    ]
    times = np.median([[one.ms for one in found] for found in each[1:]], axis=0)
    return [replace(one, ms=float(ms)) for one, ms in zip(each[-1], times, strict=True)]


def scene_of(length: float, theta_deg: tuple[float, float], frame: int) -> SkyFrame:
    """Return a frame with streaks that are `length` px long."""
    key = [_SEED, frame, round(length)] + ([1] if theta_deg == _ACROSS else [])
    return sky_frame(np.random.default_rng(key), length, _EXPOSURE, theta_deg=theta_deg)


def row_of(length: float, theta_deg: tuple[float, float], frames: int) -> dict[str, Any]:
    """Return the statistics of `frames` random frames with streaks that are `length` px long."""
    each = [solved(scene_of(length, theta_deg, frame), length) for frame in range(frames)]
    columns = {name: np.array([getattr(one, name) for one in each]) for name in asdict(each[0])}
    told = ~np.isnan(columns["across"])
    across, rate = columns["across"][told], columns["rate"][~np.isnan(columns["rate"])]
    bound = columns["rate_bound"][~np.isnan(columns["rate_bound"])]
    return {
        "length_px": length,
        "across": theta_deg == _ACROSS,
        "frames": frames,
        "right": int(np.sum(across <= RIGHT_ARCSEC)),
        "wrong": int(np.sum(across > RIGHT_ARCSEC)),
        "median_arcsec": _or_nan(np.median, across),
        "worst_arcsec": _or_nan(np.max, across),
        "over_bound": _or_nan(_rms, across) / _or_nan(_rms, columns["across_bound"][told]),
        "nees": _or_nan(np.mean, columns["nees"][told]),
        "rate_rms_percent": _or_nan(_rms, rate),
        "rate_worst_percent": _or_nan(np.max, np.abs(rate)),
        "rate_bound_percent": _or_nan(_rms, bound),
        "median_ms": float(np.median(columns["ms"])),
        "p95_ms": float(np.percentile(columns["ms"], 95.0)),
        "tracking_ms": float(np.median(columns["tracking_ms"])),
    }


def dim_row_of(exposure: float, frames: int) -> dict[str, Any]:
    """Return the statistics of `frames` random frames of a calibrated camera with a short exposure, s.

    An attitude is wrong if its error exceeds 6 standard deviations.
    """
    right, faint, wrong, ratios, times = 0, 0, 0, [], []
    for frame in range(frames):
        scene = sky_frame(np.random.default_rng([_SEED, frame]), 0.0, exposure)
        begin = time.process_time()
        found = solve_frame(scene.pixels, NARROW.pinhole, (1.0, 1.0), exposure, sky(), SolveSettings())
        times.append(1e3 * (time.process_time() - begin))
        if found.fix is not None:
            error = to_rotation_vector(multiply(found.fix.quaternion, conjugate(scene.attitude)))
            square = float(error @ np.linalg.solve(found.fix.covariance, error))
            right, wrong = right + (square <= _BEYOND**2), wrong + (square > _BEYOND**2)
            faint += found.faint
            ratios.append(square / 3.0)
    return {
        "exposure_ms": 1e3 * exposure,
        "frames": frames,
        "right": right,
        "of_these_faint": faint,
        "wrong": wrong,
        "nees": _or_nan(np.mean, np.array(ratios)),
        "median_ms": float(np.median(times)),
        "p95_ms": float(np.percentile(times, 95.0)),
    }


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _or_nan(figure: Any, values: FloatArray) -> float:
    return float(figure(values)) if len(values) else math.nan


@dataclass(frozen=True)
class Case:
    """A frame for the other programs, with its configuration, true direction (3,) and job in their format."""

    configuration: str
    boresight: FloatArray
    job: dict[str, Any]


def peer_cases(photographs: Path, frames: int, folder: Path, passes: int) -> list[Case]:
    """Return every photograph and simulated frame, written to `folder`.

    The other programs solve each photograph `passes` times.
    """
    cases: list[Case] = []

    def add(
        configuration: str, boresight: FloatArray, pixels: Image, field: float, known: float, times: int = 1
    ) -> None:
        path = folder / f"{len(cases)}.npy"
        np.save(path, pixels)
        job = {"image": str(path), "field_deg": field, "known_deg": known, "passes": times}
        cases.append(Case(configuration, boresight, job))

    if (photographs / "truth.json").is_file():
        for one in _shown(photographs):
            pixels, fov = read_image(photographs / one.name), one.truth["fov"]
            pixels = pixels if one.size is None else reduced(pixels, *one.size)
            field, error = (fov, FIELD_SHARE * fov) if one.known else (20.0, 10.0)
            add(one.configuration(), centre_of(one.truth), pixels, field, error, passes)
    for length in _STREAKS_PX:
        for frame in range(frames):
            scene = scene_of(length, _OBLIQUE, frame)
            boresight = attitude_matrix(scene.attitude)[2]
            add(f"{length:.0f} px, field known", boresight, scene.pixels, NARROW_DEG, _NARROW_KNOWN_DEG)
    return cases


def peer_rows(
    photographs: Path, frames: int, peer_python: str, pictures: Sequence[Photograph], passes: int
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return the statistics of the other programs by configuration, and the time ratios by frame size."""
    rows, ratios = [], []
    with scratch() as folder:
        cases = peer_cases(photographs, frames, folder, passes)
        for peer in PEERS:
            said = peer_answers(peer, peer_python, [case.job for case in cases])
            if said is None:
                continue
            for configuration in dict.fromkeys(case.configuration for case in cases):
                chosen = [
                    (answer, case)
                    for answer, case in zip(said[0], cases, strict=True)
                    if case.configuration == configuration
                ]
                rows.append({"peer": peer, "configuration": configuration, **_peer_row(chosen)})
            ratios += _ratios(peer, pictures, said[0])
    return rows, ratios


def _ratios(peer: str, pictures: Sequence[Photograph], answers: Sequence[Answer]) -> list[dict[str, Any]]:
    """Return the median ratio of our time to that of another program for each size of photographs."""
    by_size: dict[str, list[float]] = {}
    for ours, theirs in zip(pictures, answers, strict=False):  # the simulated frames follow the photographs
        if ours.known:
            by_size.setdefault(ours.size, []).append(ours.ms / theirs.ms)
    return [
        {"peer": peer, "size": size, "photographs": len(found), "ratio": float(np.median(found))}
        for size, found in sorted(by_size.items())
    ]


def _peer_row(chosen: Sequence[tuple[Answer, Case]]) -> dict[str, Any]:
    off = np.array(
        [angle_arcsec(a.boresight, c.boresight) for a, c in chosen if a.boresight is not None], dtype=float
    )
    ms = [answer.ms for answer, _ in chosen]
    return {
        "frames": len(chosen),
        "right": int(np.sum(off <= RIGHT_ARCSEC)),
        "wrong": int(np.sum(off > RIGHT_ARCSEC)),
        "refused": len(chosen) - len(off),
        "median_arcsec": _or_nan(np.median, off),
        "median_ms": float(np.median(ms)),
        "p95_ms": float(np.percentile(ms, 95.0)),
    }


def _counted(pictures: Sequence[Photograph]) -> dict[str, Any]:
    """Return the results of the photographs, and how many of them are right and wrong."""
    right = sum(one.solved and one.arcsec <= RIGHT_ARCSEC for one in pictures)
    wrong = sum(one.solved for one in pictures) - right
    return {"photographs": [asdict(one) for one in pictures], "right": right, "wrong": wrong}


@command
def main(
    *,
    frames: Annotated[int, "of each length"] = 20,
    photographs: Annotated[Path, "folder of the photographs"] = PHOTOGRAPHS,
    passes: Annotated[int, "timed passes over the photographs"] = 3,
    peers: Peers = False,
    peer_python: PeerPython = sys.executable,
    json: Json = False,
) -> int:
    """Measure and print; return exit status 0."""
    pictures: list[Photograph] = []
    if (photographs / "truth.json").is_file():
        pictures = pictures_of(photographs, passes)
    else:
        sys.stderr.write(f"{photographs}: no truth.json: give --photographs; going on without\n")
    rows = [row_of(length, _OBLIQUE, frames) for length in _STREAKS_PX]
    rows += [row_of(length, _ACROSS, frames) for length in _STREAKS_PX if length]
    others, ratios = peer_rows(photographs, frames, peer_python, pictures, passes) if peers else ([], [])
    small = f"{_REDUCED[0]} x {_REDUCED[1]}"
    facts = _counted([one for one in pictures if one.size != small])
    facts["reduced"] = _counted([one for one in pictures if one.size == small])
    dim = [dim_row_of(exposure, frames) for exposure in _SHORT_EXPOSURES]
    show(facts | {"frames": rows, "dim frames": dim, "peers": others, "ratios": ratios}, json)
    return 0
