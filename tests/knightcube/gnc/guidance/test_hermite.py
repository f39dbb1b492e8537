"""Cubic Hermite interpolation against scipy's, and exact on cubics."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from knightcube.gnc.guidance.three_axes.slew_model import HermiteCubic


def test_values_and_slopes_agree_with_scipy_inside_and_outside() -> None:
    rng = np.random.default_rng(1)
    times = np.sort(rng.uniform(0.0, 9.0, 12))
    values, slopes = rng.normal(size=(2, 12, 3))
    at = np.linspace(-1.0, 10.0, 333)
    scipys, ours = CubicHermiteSpline(times, values, slopes), HermiteCubic(times, values, slopes)
    np.testing.assert_allclose(ours(at), scipys(at), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(ours.derivative(at), scipys(at, 1), rtol=1e-12, atol=1e-12)


def test_a_cubic_is_exact() -> None:
    times = np.array([0.0, 0.5, 2.0])
    at = np.array([0.1, 0.5, 1.3, 2.0])
    curve = HermiteCubic(times, (times**3)[:, None], (3.0 * times**2)[:, None])
    np.testing.assert_allclose(curve(at)[:, 0], at**3, rtol=1e-13)
    np.testing.assert_allclose(curve.derivative(at)[:, 0], 3.0 * at**2, rtol=1e-13)
