"""Tests of the Earth's shadow against tangents of two spheres, and against rays from the Sun's disc."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.figure import EARTH_RADIUS
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT, SUN_RADIUS, sunlit_share

SUN = np.array([ASTRONOMICAL_UNIT, 0.0, 0.0])


def _behind(depth: float, aside: float) -> FloatArray:
    """Return a position `depth` m behind the Earth's centre and `aside` m from the shadow's axis."""
    return np.array([-depth, 0.6 * aside, 0.8 * aside])


@pytest.mark.parametrize("depth", [3000e3, 6500e3, 42_164e3, 384_400e3])
def test_umbra_and_penumbra_end_at_the_common_tangents(depth: float) -> None:
    """Umbra and penumbra have the widths that follow from the radii by similar triangles.

    The widths are computed to first order in the cone angle.
    """
    inner = np.arcsin((SUN_RADIUS - EARTH_RADIUS) / ASTRONOMICAL_UNIT)
    outer = np.arcsin((SUN_RADIUS + EARTH_RADIUS) / ASTRONOMICAL_UNIT)
    umbra = EARTH_RADIUS / np.cos(inner) - depth * np.tan(inner)
    penumbra = EARTH_RADIUS / np.cos(outer) + depth * np.tan(outer)
    for edge, inside, outside in ((umbra, 0.0, 1e-9), (penumbra, 1.0 - 1e-9, 1.0)):
        assert sunlit_share(_behind(depth, edge - 200.0), SUN) == pytest.approx(inside, abs=2e-3)
        assert sunlit_share(_behind(depth, edge + 200.0), SUN) == pytest.approx(outside, abs=2e-3)
    assert sunlit_share(_behind(depth, umbra - 200.0), SUN) == 0.0
    assert sunlit_share(_behind(depth, umbra + 200.0), SUN) > 0.0
    assert sunlit_share(_behind(depth, penumbra - 200.0), SUN) < 1.0
    assert sunlit_share(_behind(depth, penumbra + 200.0), SUN) == 1.0


def test_the_umbra_ends_1_38_million_km_behind_the_earth() -> None:
    """The umbra ends 1.38 million km behind the Earth.

    Farther away, the visible part of the Sun is a ring, whose area is the difference of both discs.
    """
    tip = EARTH_RADIUS * ASTRONOMICAL_UNIT / (SUN_RADIUS - EARTH_RADIUS)
    assert tip == pytest.approx(1.384e9, rel=2e-3)
    assert sunlit_share(_behind(0.999 * tip, 0.0), SUN) == 0.0
    share = sunlit_share(_behind(2.0 * tip, 0.0), SUN)
    earth, whole = EARTH_RADIUS / (2.0 * tip), SUN_RADIUS / (ASTRONOMICAL_UNIT + 2.0 * tip)
    assert share == pytest.approx(1.0 - (earth / whole) ** 2, rel=1e-4)


@pytest.mark.parametrize("share_of_way", [0.1, 0.3, 0.5, 0.8])
@pytest.mark.parametrize("depth", [2500e3, 42_164e3])
def test_in_penumbra_the_share_is_that_of_rays_that_pass_the_earth(depth: float, share_of_way: float) -> None:
    """In penumbra, the sunlit fraction equals the part of 200,000 rays from the Sun that pass the Earth."""
    width = depth * 2.0 * SUN_RADIUS / ASTRONOMICAL_UNIT
    middle = EARTH_RADIUS + depth * EARTH_RADIUS / ASTRONOMICAL_UNIT
    position = _behind(depth, middle + (share_of_way - 0.5) * width)
    rng = np.random.default_rng(2)
    radius, angle = SUN_RADIUS * np.sqrt(rng.uniform(size=200_000)), rng.uniform(0.0, 2.0 * np.pi, 200_000)
    points = SUN + np.stack([np.zeros_like(radius), radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    rays = points - position
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    missed = np.linalg.norm(np.cross(position, rays), axis=1) > EARTH_RADIUS
    share = sunlit_share(position, SUN)
    assert share == pytest.approx(np.mean(missed), abs=0.006)
    assert 0.0 < share < 1.0


def test_between_earth_and_sun_it_is_day_everywhere() -> None:
    rng = np.random.default_rng(3)
    positions = rng.normal(size=(500, 3)) * 8e6
    positions = positions[np.linalg.norm(positions, axis=1) > 1.001 * EARTH_RADIUS]
    day = positions[positions[:, 0] > 0.0]
    for shadow in ("conical", "cylindrical"):
        assert np.all(sunlit_share(day, SUN, shadow) == 1.0)


def test_the_cylinder_is_as_wide_as_the_earth() -> None:
    """The edge of the cylindrical shadow is one Earth radius from its axis, at any distance behind the Earth.

    According to the errata, equation 2.15 contains the position of the object.
    """
    for depth in (1000e3, 42_164e3):
        assert sunlit_share(_behind(depth, EARTH_RADIUS - 10.0), SUN, "cylindrical") == 0.0
        assert sunlit_share(_behind(depth, EARTH_RADIUS + 10.0), SUN, "cylindrical") > 0.0


def test_cone_and_cylinder_agree_outside_the_penumbra() -> None:
    """Cone and cylinder agree outside the penumbra, which covers 0.42 % of a sphere of 7078 km.

    The penumbra is a ring with a width of 28.5 km, at 6378 km from the axis.
    """
    rng = np.random.default_rng(4)
    positions = rng.normal(size=(20_000, 3))
    positions *= 7078e3 / np.linalg.norm(positions, axis=1, keepdims=True)
    cone, cylinder = sunlit_share(positions, SUN), sunlit_share(positions, SUN, "cylindrical")
    penumbra = (cone > 0.0) & (cone < 1.0)
    assert np.mean(penumbra) == pytest.approx(0.0042, abs=5.0 * np.sqrt(0.0042 / len(positions)))
    assert np.array_equal(cone[~penumbra], cylinder[~penumbra])
    assert 0.1 < np.mean(cylinder) < 0.9


def test_an_unknown_shadow_is_refused() -> None:
    with pytest.raises(ValueError, match="conical or cylindrical"):
        sunlit_share(_behind(7e6, 0.0), SUN, "spherical")  # type: ignore[arg-type] # wrong on purpose
