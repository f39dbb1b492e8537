"""Measure the corner detectors' constant shift of endpoints: `python -m tests.studies.bench.endpoint_bias`.

Sease, end of chapter 3: "it is possible to characterize the effect experimentally". Random star fields turn
at random axes; every localised endpoint is compared with the true one. Prints, for each detector and point
spread, the outward correction that `endpoint_bias` needs, its error, the scatter along and across the streak,
and how far the correction itself moves with length and direction, which no constant can take away;
`--bins` its spread over brightness, length and direction.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.reference.corner_streaks.detectors import cornerness
from knightcube.reference.corner_streaks.settings import DETECTOR_NAMES, DetectorName, StreakSettings
from knightcube.vision.objects.streak_ends import measure_streaks, segment_frame
from tests.support.streak_frames import (
    Camera,
    expose,
    random_stars,
    rate_at,
    read_out,
    star_camera,
    true_endpoints,
)

_SEED = 31_415
_MATCH_PX = 4.0
_EXPOSURE = 1.0


@dataclasses.dataclass(frozen=True)
class EndpointErrors:
    """Errors of localised endpoints (n,): along (outward positive) and across the streak, px."""

    along: FloatArray
    across: FloatArray
    expected: FloatArray
    length: FloatArray
    direction: FloatArray

    def select(self, keep: BoolArray) -> EndpointErrors:
        """Return the endpoints of a mask (n,)."""
        return EndpointErrors(*(getattr(self, field.name)[keep] for field in dataclasses.fields(self)))


def endpoint_errors(
    camera: Camera, settings: StreakSettings, frames: int, seed: int = _SEED
) -> EndpointErrors:
    """Return the errors of all endpoints that lie within 4 px of a true one, over `frames` random frames.

    Streaks of 25 to 100 px, the axis normal to the boresight and rolled at random, so that all directions
    occur.
    """
    rows: list[FloatArray] = []
    for frame in range(frames):
        rng = np.random.default_rng([seed, frame])
        length = rng.uniform(25.0, 100.0)
        rotation = rate_at(0.5 * np.pi, length / camera.pinhole.focal_length, rng.uniform(0.0, 2.0 * np.pi))
        directions, magnitudes = random_stars(rng, camera.pinhole, 0.05, 7.5)
        electrons = expose(camera, directions, magnitudes, rotation, _EXPOSURE)
        pixels = read_out(camera, electrons, _EXPOSURE, rng)
        streaks = measure_streaks(segment_frame(pixels, settings), settings, cornerness)
        rows.append(_compare(streaks.endpoints, streaks.sigma, true_endpoints(camera, directions, rotation)))
    return EndpointErrors(*np.concatenate(rows).T)


def _compare(found: FloatArray, sigma: FloatArray, true: FloatArray) -> FloatArray:
    """Return rows of along, across, expected sigma, length, direction for the ends that match a star's."""
    both_orders = np.concatenate([true, true[:, ::-1]])
    difference = found[:, None] - both_orders[None]
    worst = np.linalg.norm(difference, axis=-1).max(axis=-1)
    star = worst.argmin(axis=1)
    matched = np.flatnonzero(worst[np.arange(len(found)), star] < _MATCH_PX)
    truth = both_orders[star[matched]]
    chord = truth[:, 1] - truth[:, 0]
    length = np.linalg.norm(chord, axis=-1)
    outward = chord / length[:, None]
    error = found[matched] - truth
    side = np.stack([-outward[:, 1], outward[:, 0]], axis=-1)
    direction = np.arctan2(outward[:, 1], outward[:, 0])
    ends = [
        np.stack(
            [
                sign * np.sum(error[:, end] * outward, axis=-1),
                np.sum(error[:, end] * side, axis=-1),
                sigma[matched],
                length,
                direction,
            ],
            axis=-1,
        )
        for end, sign in ((0, -1.0), (1, 1.0))
    ]
    return np.concatenate(ends)


def robust_mean(values: FloatArray) -> tuple[float, float, float]:
    """Return mean, standard deviation and error of the mean without what lies beyond 4 robust sigma."""
    median = np.median(values)
    spread = 1.4826 * np.median(np.abs(values - median))
    kept = values[np.abs(values - median) <= 4.0 * spread]
    return float(kept.mean()), float(kept.std()), float(kept.std() / np.sqrt(kept.size))


def summary(errors: EndpointErrors, detector: DetectorName, psf_sigma: float) -> dict[str, object]:
    """Return the constants of one detector at one point spread, px."""
    mean, along, of_mean = robust_mean(errors.along)
    return {
        "detector": detector,
        "psf_sigma": psf_sigma,
        "ends": errors.along.size,
        "endpoint_bias": -mean,
        "endpoint_bias_error": of_mean,
        "scatter_along": along,
        "scatter_across": robust_mean(errors.across)[1],
        "bias_spread": float(np.std(_bin_means(errors))),
        "bins": {title: _bins(errors, of(errors), edges) for title, of, edges in _BINS},
    }


_BINS: tuple[tuple[str, Callable[[EndpointErrors], FloatArray], FloatArray], ...] = (
    (
        "expected sigma, px",
        lambda e: e.expected,
        np.array([0.03, 0.05, 0.07, 0.1, 0.14, 0.2, 0.3, 0.5, 1.0]),
    ),
    ("length, px", lambda e: e.length, np.array([20.0, 40.0, 60.0, 80.0, 110.0])),
    ("direction, deg", lambda e: np.rad2deg(e.direction) % 90.0, np.arange(0.0, 91.0, 15.0)),
)


def _bins(errors: EndpointErrors, values: FloatArray, edges: FloatArray) -> list[dict[str, float]]:
    """Return correction and scatter of the ends whose `values` fall into each bin, ten ends or more."""
    rows = []
    for low, high in itertools.pairwise(edges):
        part = errors.select((values >= low) & (values < high))
        if part.along.size < 10:
            continue
        mean, along, of_mean = robust_mean(part.along)
        rows.append(
            {
                "from": float(low),
                "to": float(high),
                "ends": part.along.size,
                "bias": -mean,
                "error": of_mean,
                "along": along,
                "across": robust_mean(part.across)[1],
                "expected": float(np.median(part.expected)),
            }
        )
    return rows


def _bin_means(errors: EndpointErrors) -> list[float]:
    """Return the corrections of all bins of length and direction."""
    return [row["bias"] for _, of, edges in _BINS[1:] for row in _bins(errors, of(errors), edges)]


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def _print_bins(result: dict[str, Any]) -> None:
    for title, rows in result["bins"].items():
        _say(f"\n{title:>18}  ends  correction +- of mean   scatter along / across / expected, px")
        for row in rows:
            _say(
                f"{row['from']:8.3f} .. {row['to']:6.3f} {row['ends']:5d}"
                f"  {row['bias']:8.3f} +- {row['error']:.3f}"
                f"          {row['along']:.3f} / {row['across']:.3f} / {row['expected']:.3f}"
            )
    _say("")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--detector", choices=DETECTOR_NAMES, nargs="+", default=DETECTOR_NAMES)
    parser.add_argument("--psf-sigma", type=float, nargs="+", default=[0.7, 1.0, 1.5], help="px")
    parser.add_argument("--frames", type=int, default=20, help="default %(default)s")
    parser.add_argument("--seed", type=int, default=_SEED, help="default %(default)s")
    parser.add_argument("--derivative-sigma", type=float, help="px; the detector's own without")
    parser.add_argument("--window-sigma", type=float, help="px; the detector's own without")
    parser.add_argument("--half-width", type=int, help="px; the detector's own without")
    parser.add_argument("--centre-of", choices=("response", "image"), default="response")
    parser.add_argument("--bins", action="store_true", help="also by brightness, length and direction")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of the table")
    options = parser.parse_args()
    asked = {
        "derivative_sigma": options.derivative_sigma,
        "window_sigma": options.window_sigma,
        "intensity_half_width": options.half_width,
        "centre_of": options.centre_of,
    }
    changes = {name: value for name, value in asked.items() if value is not None}
    results = []
    if not options.json:
        _say(f"{options.frames} frames a row, seed {options.seed}; px")
        _say(
            "detector            PSF   ends  endpoint_bias        scatter along / across  spread of the bias"
        )
    for psf_sigma, detector in itertools.product(options.psf_sigma, options.detector):
        settings = StreakSettings.of(detector, **changes)
        errors = endpoint_errors(star_camera(psf_sigma=psf_sigma), settings, options.frames, options.seed)
        result: dict[str, Any] = summary(errors, detector, psf_sigma)
        results.append(result)
        if options.json:
            continue
        _say(
            f"{detector:18} {psf_sigma:4.1f} {result['ends']:6d}"
            f"  {result['endpoint_bias']:6.3f} +- {result['endpoint_bias_error']:.3f}"
            f"         {result['scatter_along']:.3f} / {result['scatter_across']:.3f}"
            f"          {result['bias_spread']:.3f}"
        )
        if options.bins:
            _print_bins(result)
    if options.json:
        _say(json.dumps({"frames": options.frames, "seed": options.seed, "results": results}))


if __name__ == "__main__":
    main()
