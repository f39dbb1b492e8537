"""Which terms of a lens the stars fix: a lens is fitted without the others, and says how well it is known.

A term goes, one at a time and k2 first, when the stars leave it little better known than it was assumed to
be, or when it is a distortion smaller than its own error. It then stays what is assumed without any stars,
and the other terms are fitted again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ground.calibration.calibration import DETERMINED, Calibration, LensPrior, calibrate
from ground.calibration.lens_fit import MatchedFrame, parameters_of
from knightcube.vision.camera.lens import CameraModel, Lens

_HELD = {"k2": 1e-7, "k1": 1e-7, "centre": 1e-3}
"""Each term that may go, in this order; the prior's standard deviation that holds it, px for the centre."""


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A term that the stars do not fix: its values and errors as last fitted, one for k1 and k2, x and y."""

    values: tuple[float, ...]
    sigmas: tuple[float, ...]
    assumed: tuple[float, ...]


@dataclass(frozen=True, slots=True, eq=False)
class FixedTerms:
    """A calibration with those terms only that the stars fix.

    Attributes:
        calibration: the lens; terms left out are at what is assumed, their sigmas next to nothing.
        left_out: by "k1", "k2", "centre".
        accuracy: of the lens, by the keys of a configuration's `camera.accuracy`; a key that the stars do not
            fix is left out.
    """

    calibration: Calibration
    left_out: dict[str, LeftOut]
    accuracy: dict[str, float]


def fit_terms(frames: Sequence[MatchedFrame], initial: CameraModel) -> FixedTerms:
    """Return the lens of the frames, begun from `initial`. Raises CalibrationError."""
    prior = LensPrior()
    whole = found = calibrate(frames, initial, prior)
    left_out: dict[str, LeftOut] = {}
    while (term := _poorest(found, left_out)) is not None:
        left_out[term] = _as_fitted(found, term)
        prior = replace(prior, **{term: _HELD[term]})
        # Begun from what is assumed, which a term that is held does not leave.
        found = calibrate(frames, _without(found.lens, left_out), prior)
    return FixedTerms(found, left_out, _accuracy(whole, found, left_out))


def _poorest(found: Calibration, left_out: dict[str, LeftOut]) -> str | None:
    """Return the next term to leave out, None when the stars fix all that are left."""
    fitted = [term for term in _HELD if term not in left_out]
    for term in fitted:
        if any(name.startswith(term) for name in found.undetermined):
            return term
    # A polynomial goes from its highest term.
    highest = next((term for term in ("k2", "k1") if term in fitted), None)
    if highest is not None and abs(getattr(found.lens, highest)) < found.sigma[highest]:
        return highest
    return None


def _as_fitted(found: Calibration, term: str) -> LeftOut:
    ideal, sigma = found.lens.ideal, found.sigma
    if term == "centre":
        return LeftOut(found.lens.centre, (sigma["centre_x"], sigma["centre_y"]), ideal.centre)
    return LeftOut((getattr(found.lens, term),), (sigma[term],), (0.0,))


def _without(lens: Lens, left_out: dict[str, LeftOut]) -> Lens:
    """Return a lens with terms left out at what is assumed."""
    values: dict[str, Any] = {
        term: gone.assumed if term == "centre" else gone.assumed[0] for term, gone in left_out.items()
    }
    return replace(lens, **values)


def _accuracy(whole: Calibration, found: Calibration, left_out: dict[str, LeftOut]) -> dict[str, float]:
    """Return how well the lens is known; `whole` has all terms.

    Focal length and centre are as sure as the fit without the terms left out says; what these change of the
    focal length adds to its error. A corner may be displaced by what all terms together leave open there, and
    by what the lens lacks without those left out.
    """
    lens, sigma = found.lens, found.sigma
    changed = whole.lens.focal_length - lens.focal_length
    accuracy = {"focal_length": math.hypot(sigma["focal_length"], changed) / lens.focal_length}
    if "centre" not in left_out:
        accuracy["centre"] = math.hypot(sigma["centre_x"], sigma["centre_y"]) / math.sqrt(2.0)
    square = (math.hypot(*lens.ideal.centre) / lens.focal_length) ** 2
    by_terms = np.array([1.0 / lens.focal_length, 0.0, 0.0, square, square**2])
    open_there = float(by_terms @ whole.covariance @ by_terms)
    lacking = float(by_terms @ (parameters_of(whole.lens) - parameters_of(lens)))
    distortion, assumed = math.hypot(math.sqrt(open_there), lacking), LensPrior()
    if distortion < DETERMINED * math.hypot(assumed.k1 * square, assumed.k2 * square**2):
        accuracy["distortion"] = distortion
    return accuracy
