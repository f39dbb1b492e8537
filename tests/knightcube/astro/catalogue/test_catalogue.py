"""Tests of the star table against published numbers and positions of stars."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from knightcube.astro import catalogue
from knightcube.astro.arrays import FloatArray
from knightcube.errors import InputError
from tests.pace import ordinary_seconds

STARS = catalogue.load()

# Number of Hipparcos entries with V below each limit (hardware notes, 0.1), and number of these entries
# without a position.
PUBLISHED = {6.0: (4_995, 3), 6.5: (8_789, 4), 7.0: (15_404, 7), 8.0: (41_074, 17), 8.5: (61_320, 27)}

# Positions of SIMBAD (ICRS, epoch J2000) by van Leeuwen 2007; 61 Cygni A is from Gaia. The old and the new
# reduction of Hipparcos differ by some mas/yr for the brightest stars, and by 13 mas/yr for 61 Cygni.
POSITIONS = {
    "Sirius": (32349, "06 45 08.91728", "-16 42 58.0171", -1.44, 0.002),
    "Canopus": (30438, "06 23 57.10988", "-52 41 44.3810", -0.62, 0.005),
    "Arcturus": (69673, "14 15 39.67207", "+19 10 56.6730", -0.05, 0.006),
    "Vega": (91262, "18 36 56.33635", "+38 47 01.2802", 0.03, 0.012),
    "Betelgeuse": (27989, "05 55 10.30536", "+07 24 25.4304", 0.45, 0.006),
    "Polaris": (11767, "02 31 49.09456", "+89 15 50.7923", 1.97, 0.004),
    "Groombridge 1830": (57939, "11 52 58.76870", "+37 43 07.2402", 6.42, 0.006),
    "61 Cygni A": (104214, "21 06 53.9396", "+38 44 57.902", 5.20, 0.15),
    "Xi Ursae Majoris": (55203, "11 18 10.902", "+31 31 44.98", 3.79, 0.1),
    "Xi Scorpii": (78727, "16 04 22.191", "-11 22 22.60", 4.16, 0.1),
}


def _unit_vector(right_ascension: str, declination: str) -> FloatArray:
    hours, minutes, seconds = (float(part) for part in right_ascension.split())
    ra = np.radians(15.0 * (hours + minutes / 60.0 + seconds / 3600.0))
    degrees, minutes, seconds = (float(part) for part in declination[1:].split())
    dec = np.radians(degrees + minutes / 60.0 + seconds / 3600.0) * (-1.0 if declination[0] == "-" else 1.0)
    return np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])


def _arcseconds(a: FloatArray, b: FloatArray) -> float:
    return float(np.degrees(2.0 * np.arcsin(0.5 * np.linalg.norm(a - b))) * 3600.0)


def _index(hip: int) -> int:
    (found,) = np.flatnonzero(STARS.hip == hip)
    return int(found)


@pytest.mark.parametrize(("limit", "published", "unplaced"), [(k, *v) for k, v in PUBLISHED.items()])
def test_counts_are_the_published_ones_less_the_entries_without_a_position(
    limit: float, published: int, unplaced: int
) -> None:
    """The numbers of stars equal the published numbers, without the entries that have no position.

    The table contains three stars without a position. HIP 115125 has V = 6.97, so it counts only for the
    limit 7.
    """
    added = 2 if limit < 6.97 else 3
    assert len(STARS.brighter_than(limit)) == published - unplaced + added


@pytest.mark.parametrize("name", POSITIONS)
def test_position_at_j2000_is_the_published_one(name: str) -> None:
    hip, ra, dec, magnitude, tolerance = POSITIONS[name]
    star = _index(hip)
    assert _arcseconds(STARS.directions_at(2000.0)[star], _unit_vector(ra, dec)) < tolerance
    assert STARS.magnitude[star] == pytest.approx(magnitude, abs=1e-9)


def test_61_cygni_moves_as_measured() -> None:
    """61 Cygni moves by 5.28" per year towards the position angle 51.9 deg, as was measured."""
    star = _index(104214)
    a, b = STARS.directions_at(2000.0)[star], STARS.directions_at(2010.0)[star]
    assert _arcseconds(a, b) == pytest.approx(52.81, abs=0.02)
    mu_east, mu_north = STARS.proper_motion[star]
    assert np.degrees(np.arctan2(mu_east, mu_north)) == pytest.approx(51.9, abs=0.1)


def test_94_aquarii_b_is_13_6_arcseconds_from_a() -> None:
    a, b = _index(115126), _index(115125)
    assert _arcseconds(STARS.direction[a], STARS.direction[b]) == pytest.approx(13.6, abs=0.2)


def test_barnards_star_is_too_faint() -> None:
    assert 87937 not in STARS.hip


def test_stars_are_sorted_by_magnitude_and_occur_once() -> None:
    assert np.all(np.diff(STARS.magnitude) >= 0.0)
    assert len(np.unique(STARS.hip)) == len(STARS)
    assert STARS.hip[0] == 32349
    assert STARS.magnitude[-1] == 8.5


def test_arrays_have_the_declared_types_and_unit_length() -> None:
    assert STARS.hip.dtype == np.int32
    for array, shape in ((STARS.direction, (3,)), (STARS.proper_motion, (2,)), (STARS.magnitude, ())):
        assert array.dtype == np.float64
        assert array.shape == (len(STARS), *shape)
        assert np.all(np.isfinite(array))
    assert np.allclose(np.linalg.norm(STARS.direction, axis=1), 1.0, rtol=0.0, atol=1e-15)


def test_the_catalogue_cannot_be_changed_by_a_reader() -> None:
    with pytest.raises(ValueError, match="read-only"):
        STARS.direction[0, 0] = 1.0


@given(st.floats(1900.0, 2100.0))
def test_directions_at_any_year_are_unit_vectors(year: float) -> None:
    few = STARS.brighter_than(2.0)
    assert np.allclose(np.linalg.norm(few.directions_at(year), axis=1), 1.0, rtol=0.0, atol=1e-14)


def test_directions_at_the_epoch_are_those_of_the_table() -> None:
    assert np.allclose(STARS.directions_at(catalogue.EPOCH), STARS.direction, rtol=0.0, atol=1e-15)


def test_a_year_that_is_not_a_number_is_refused() -> None:
    with pytest.raises(ValueError, match="finite Julian year"):
        STARS.directions_at(float("nan"))


def test_brighter_than_is_strict_and_may_be_empty() -> None:
    assert len(STARS.brighter_than(-1.44)) == 0
    assert STARS.brighter_than(-1.43).hip.tolist() == [32349]


def test_loads_in_well_under_a_tenth_of_a_second() -> None:
    assert ordinary_seconds(catalogue.load.__wrapped__, 5) < 0.05


def test_a_damaged_table_is_refused_with_its_cure(tmp_path: Path) -> None:
    whole = catalogue.TABLE.read_bytes()
    for name, content in (("empty", b""), ("text", b"not a table"), ("cut", whole[: len(whole) // 2])):
        damaged = tmp_path / f"{name}.npz"
        damaged.write_bytes(content)
        with pytest.raises(InputError, match=r"python -m knightcube\.astro\.catalogue\.build"):
            catalogue.load(damaged)
    with pytest.raises(InputError, match=r"missing\.npz"):
        catalogue.load(tmp_path / "missing.npz")
