"""Tests that the compiled and the numpy implementations of the streak fit's functions agree.

The functions are called with arguments that are recorded from fits of simulated frames.
"""

from __future__ import annotations

import copy
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from knightcube.vision.streaks import (
    faint_stars,
    first_guess,
    fit_windows,
    joint_fit,
    normal_equations,
    polar_grid,
    streak_model,
    vibration,
)
from knightcube.vision.streaks import frame as streak_frame
from knightcube.vision.streaks.estimate import estimate_motion
from knightcube.vision.streaks.streak_result import LikelihoodSettings
from sim_hal.star_camera import StarCameraModel
from tests.knightcube.vision.streaks.scenes import CAMERA, SATURATION, taken, turn_of
from tests.support.compiled_forms import assert_forms_agree

_FUNCTIONS = (
    (fit_windows, "_block_lines", 1e-9),
    (fit_windows, "_strip_pixels", 1e-9),
    (fit_windows, "_numbered", 1e-9),
    (fit_windows, "_frame_values", 1e-6),
    (streak_frame, "_significant", 1e-9),
    (streak_frame, "_region_pixels", 1e-9),
    (streak_frame, "_fluxes", 1e-9),
    (streak_frame, "_autocorrelations", 1e-6),
    (streak_frame, "_filter_sums", 1e-9),
    (first_guess, "_likeliest_axis", 1e-9),
    (first_guess, "_arcs", 1e-7),
    (first_guess, "_best_boxes", 1e-9),
    (joint_fit, "_band_means", 1e-6),
    (polar_grid, "_sum_along", 1e-6),
    (faint_stars, "_unshaded", 1e-9),
    (faint_stars, "_scales", 1e-6),
    (faint_stars, "_second_differences", 1e-6),
    (faint_stars, "_refined", 1e-6),
    (faint_stars, "_summits", 1e-9),
    (faint_stars, "_subtract_responses", 1e-5),
    (faint_stars, "_overlaps", 1e-9),
    (faint_stars, "_solved", 1e-4),
    (normal_equations, "_sum_products", 2e-5),
    (normal_equations, "_eliminated", 1e-6),
    (streak_model, "_mixtures", 1e-9),
    (normal_equations, "_matrices", 1e-12),
    (normal_equations, "at_pixels", 1e-9),
    (vibration, "_chosen_residuals", 1e-5),
    (vibration, "_line_sums", 1e-5),
    (vibration, "_binned_equations", 1e-9),
    (fit_windows, "_summed", 1e-6),
    (faint_stars, "less_boxes", 2e-6),
    (normal_equations, "solution", 1e-4),
)
_SMALL = replace(CAMERA, columns=300, rows=260)
# Streak length (px) and relative change of the rate of each frame: streaks that cross, a motion from rest,
# and streaks without ends in the frame.
_FRAMES = ((60.0, 0.0), (60.0, 1.95), (220.0, 0.0))
_MOST_CALLS = 30


def _size(arguments: tuple[Any, ...]) -> int:
    return sum(each.size for each in arguments if isinstance(each, np.ndarray))


class _AllCalled(Exception):
    """Exception that ends a fit in which all functions were called."""


def _record(patch: pytest.MonkeyPatch, most: int) -> dict[str, list[tuple[Any, ...]]]:
    """Record the arguments of the first `most` calls of each function of `_FUNCTIONS`.

    When all functions have been called `most` times, the next call raises _AllCalled.
    """
    calls: dict[str, list[tuple[Any, ...]]] = {name: [] for _, name, _ in _FUNCTIONS}
    for module, name, _ in _FUNCTIONS:
        function = getattr(module, name)

        def called(*arguments: Any, function: Any = function, held: Any = calls[name]) -> Any:
            if len(held) < most:
                held.append(copy.deepcopy(arguments))
                if all(len(each) == most for each in calls.values()):
                    raise _AllCalled
            return function(*arguments)

        patch.setattr(module, name, called)
    return calls


def _fit(camera: StarCameraModel, length: float, growth: float) -> None:
    """Fit the motion of a frame with streaks of `length` px, whose rate grows by the fraction `growth`."""
    turn = turn_of(1.1, length, 0.4, camera)
    one = taken(np.random.default_rng(8), turn, growth * turn, 0.2, camera)
    settings = LikelihoodSettings(saturation=SATURATION)
    found = estimate_motion(one.pixels, camera.pinhole, one.exposure, settings, one.rate, 1e-3)
    assert found.stars.size


def test_the_compiled_forms_equal_those_in_numpy(monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch, suppress(_AllCalled):
        calls = _record(patch, _MOST_CALLS)
        for length, growth in _FRAMES:
            _fit(_SMALL, length, growth)
    for module, name, relative in _FUNCTIONS:
        assert calls[name], f"the fit does not call {name}"
        smallest, *_, largest = sorted(calls[name], key=_size) * 2
        hot = getattr(module, name)
        assert_forms_agree(hot, *largest, relative=relative, interpreted=False)
        assert_forms_agree(hot, *smallest, relative=relative, interpreted=_size(smallest) < 60_000)


def test_the_loops_return_the_same_as_numpy_without_compilation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without compilation, the loops of all functions return the same values as numpy.

    All functions are called in the first steps of a fit of streaks without ends.
    """
    with monkeypatch.context() as patch, suppress(_AllCalled):
        calls = _record(patch, 1)
        _fit(replace(CAMERA, columns=160, rows=140), 160.0, 0.0)
    for module, name, relative in _FUNCTIONS:
        assert calls[name], f"the fit does not call {name}"
        assert_forms_agree(getattr(module, name), *calls[name][0], relative=relative, compiled=False)
