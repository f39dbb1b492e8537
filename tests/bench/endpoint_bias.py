"""Measure the corner detector's constant shift of endpoints: `python -m tests.bench.endpoint_bias`.

Sease, end of chapter 3: "it is possible to characterize the effect experimentally". Random star fields turn
at random axes; every localised endpoint is compared with the true one. Prints the outward correction that
`endpoint_bias` needs, its spread over brightness, length and direction, and the scatter along and across the
streak.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import sys
from collections.abc import Callable

import numpy as np

from flight.arrays import BoolArray, FloatArray
from flight.vision.settings import StreakSettings
from flight.vision.streaks import measure_streaks, segment_frame
from tests.vision.frames import Camera, expose, random_stars, rate_at, read_out, star_camera, true_endpoints

_SEED = 31_415
_MATCH_PX = 2.5
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
    """Return the errors of all endpoints that lie within 2.5 px of a true one, over `frames` random frames.

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
        streaks = measure_streaks(segment_frame(pixels, settings), settings)
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


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")


def _print_bins(errors: EndpointErrors, title: str, values: FloatArray, edges: FloatArray) -> None:
    _say(f"\n{title:>18}  ends  correction +- of mean   scatter along / across / expected, px")
    for low, high in itertools.pairwise(edges):
        part = errors.select((values >= low) & (values < high))
        if part.along.size < 10:
            continue
        mean, along, of_mean = robust_mean(part.along)
        across = robust_mean(part.across)[1]
        _say(
            f"{low:8.3f} .. {high:6.3f} {part.along.size:5d}  {-mean:8.3f} +- {of_mean:.3f}"
            f"          {along:.3f} / {across:.3f} / {np.median(part.expected):.3f}"
        )


def main() -> None:
    """Print the table for one point spread."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--psf-sigma", type=float, default=1.0, help="px (default %(default)s)")
    parser.add_argument("--frames", type=int, default=20, help="default %(default)s")
    parser.add_argument("--seed", type=int, default=_SEED, help="default %(default)s")
    parser.add_argument("--derivative-sigma", type=float, default=StreakSettings().derivative_sigma)
    parser.add_argument("--window-sigma", type=float, default=StreakSettings().window_sigma)
    parser.add_argument("--half-width", type=int, default=StreakSettings().intensity_half_width)
    options = parser.parse_args()
    settings = StreakSettings(
        derivative_sigma=options.derivative_sigma,
        window_sigma=options.window_sigma,
        intensity_half_width=options.half_width,
    )
    errors = endpoint_errors(star_camera(psf_sigma=options.psf_sigma), settings, options.frames, options.seed)
    mean, along, of_mean = robust_mean(errors.along)
    across = robust_mean(errors.across)[1]
    _say(
        f"PSF sigma {options.psf_sigma} px, {options.frames} frames, seed {options.seed}:"
        f" {errors.along.size} ends"
    )
    _say(f"endpoint_bias = {-mean:.3f} +- {of_mean:.3f} px; scatter {along:.3f} along, {across:.3f} across")
    bins: tuple[tuple[str, Callable[[EndpointErrors], FloatArray], FloatArray], ...] = (
        (
            "expected sigma, px",
            lambda e: e.expected,
            np.array([0.03, 0.05, 0.07, 0.1, 0.14, 0.2, 0.3, 0.5, 1.0]),
        ),
        ("length, px", lambda e: e.length, np.array([20.0, 40.0, 60.0, 80.0, 110.0])),
        ("direction, deg", lambda e: np.rad2deg(e.direction) % 90.0, np.arange(0.0, 91.0, 15.0)),
    )
    for title, of, edges in bins:
        _print_bins(errors, title, of(errors), edges)


if __name__ == "__main__":
    main()
