"""The star tracker on photographs and on simulated frames.

The photographs are in a folder with a file `truth.json`, which gives right ascension and declination of the
image's centre and the horizontal field of view in degrees. Each photograph is solved with the field known to
5 %, and also with an unknown field if it is 10 to 30 deg wide. The simulated frames have the simulator's
camera with a field of 12 deg known to 0.1 deg and an exposure of 0.1 s. The axis of rotation is 30 to 90 deg
off the boresight, or perpendicular to it. `over bound` is the rms error across the boresight divided by the
Cramer-Rao bound of the star positions; `bound` is the same ratio for the magnitude of the rate. Identified
stars lower the bound of the rate by at most 2 %, because the rate follows from the lengths of streaks. Times
are processor times of one core, for photographs of the second of two passes. The other star identification
programs extract the stars themselves, with their default filters and without filters. `ratios` compares the
time of each photograph with known field with that of each other program: the median of the ratios for each
frame size.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from ground.campaigns.runner import show
from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.quaternion import attitude_matrix
from knightcube.vision.camera.images import read_image
from tests.knightcube.vision.startracker.frames import SkyFrame, sky_frame
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
    solved,
)

_SEED = 16_018
_STREAKS_PX = (0.0, 10.0, 20.0, 40.0, 80.0)
_OBLIQUE, _ACROSS = (30.0, 90.0), (90.0, 90.0)
_EXPOSURE = 0.1


def _shown(folder: Path) -> Iterator[tuple[str, dict[str, float], bool]]:
    """Yield name, truth and whether the field is known, once for each trial of a photograph."""
    for name, values in json.loads((folder / "truth.json").read_text()).items():
        yield name, values, True
        if _LOWEST_DEG <= values["fov"] <= _HIGHEST_DEG:
            yield name, values, False


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


def peer_cases(photographs: Path, frames: int, folder: Path) -> list[Case]:
    """Return every photograph and simulated frame, written to `folder`."""
    cases: list[Case] = []

    def add(configuration: str, boresight: FloatArray, pixels: Image, field: float, known: float) -> None:
        path = folder / f"{len(cases)}.npy"
        np.save(path, pixels)
        cases.append(
            Case(configuration, boresight, {"image": str(path), "field_deg": field, "known_deg": known})
        )

    if (photographs / "truth.json").is_file():
        for name, values, known in _shown(photographs):
            pixels, fov = read_image(photographs / name), values["fov"]
            field, error = (fov, FIELD_SHARE * fov) if known else (20.0, 10.0)
            configuration = f"photographs, field {'known' if known else 'unknown'}"
            add(configuration, centre_of(values), pixels, field, error)
    for length in _STREAKS_PX:
        for frame in range(frames):
            scene = scene_of(length, _OBLIQUE, frame)
            boresight = attitude_matrix(scene.attitude)[2]
            add(f"{length:.0f} px, field known", boresight, scene.pixels, NARROW_DEG, _NARROW_KNOWN_DEG)
    return cases


def peer_rows(
    photographs: Path, frames: int, peer_python: str, pictures: Sequence[Photograph]
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return the statistics of the other programs by configuration, and the time ratios by frame size."""
    rows, ratios = [], []
    with scratch() as folder:
        cases = peer_cases(photographs, frames, folder)
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
            ratios += _ratios(peer, photographs, pictures, said[0])
    return rows, ratios


def _ratios(
    peer: str, folder: Path, pictures: Sequence[Photograph], answers: Sequence[Answer]
) -> list[dict[str, Any]]:
    """Return the median ratio of our time to that of another program for each size of photographs."""
    by_size: dict[str, list[float]] = {}
    for ours, theirs in zip(pictures, answers, strict=False):  # the simulated frames follow the photographs
        if ours.known:
            rows, columns = read_image(folder / ours.name).shape[:2]
            by_size.setdefault(f"{columns} x {rows}", []).append(ours.ms / theirs.ms)
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


@command
def main(
    *,
    frames: Annotated[int, "of each length"] = 20,
    photographs: Annotated[Path, "folder of the photographs"] = PHOTOGRAPHS,
    peers: Peers = False,
    peer_python: PeerPython = sys.executable,
    json: Json = False,
) -> int:
    """Measure and print; return exit status 0."""
    pictures: list[Photograph] = []
    if (photographs / "truth.json").is_file():
        # The second pass is reported, because in the first pass numba loads each function from its file.
        for _ in range(2):
            pictures = [photograph(photographs, *each) for each in _shown(photographs)]
    else:
        sys.stderr.write(f"{photographs}: no truth.json: give --photographs; going on without\n")
    rows = [row_of(length, _OBLIQUE, frames) for length in _STREAKS_PX]
    rows += [row_of(length, _ACROSS, frames) for length in _STREAKS_PX if length]
    others, ratios = peer_rows(photographs, frames, peer_python, pictures) if peers else ([], [])
    right = sum(one.solved and one.arcsec <= RIGHT_ARCSEC for one in pictures)
    wrong = sum(one.solved for one in pictures) - right
    facts = {"photographs": [asdict(one) for one in pictures], "right": right, "wrong": wrong}
    show(facts | {"frames": rows, "peers": others, "ratios": ratios}, json)
    return 0
