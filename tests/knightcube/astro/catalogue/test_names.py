"""Tests of proper names against the positions of the named stars."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro import catalogue
from knightcube.astro.catalogue import PROPER_NAMES


def test_every_named_star_is_in_the_catalogue_and_names_are_not_shared() -> None:
    assert set(PROPER_NAMES) <= set(catalogue.load().hip.tolist())
    assert len(set(PROPER_NAMES.values())) == len(PROPER_NAMES)


@pytest.mark.parametrize(
    ("name", "right_ascension_h", "declination_deg", "magnitude"),
    [
        # Right ascension (h), declination (deg) and V of the Bright Star Catalogue, 5th edition, J2000.
        ("Sirius", 6.7525, -16.716, -1.46),
        ("Vega", 18.6156, 38.784, 0.03),
        ("Polaris", 2.5303, 89.264, 2.02),
        ("Antares", 16.4901, -26.432, 1.09),
        ("Fomalhaut", 22.9608, -29.622, 1.16),
        ("Mizar", 13.3988, 54.925, 2.27),
    ],
)
def test_well_known_stars_bear_their_names(
    name: str, right_ascension_h: float, declination_deg: float, magnitude: float
) -> None:
    stars = catalogue.load()
    hip = next(number for number, given in PROPER_NAMES.items() if given == name)
    index = int(np.flatnonzero(stars.hip == hip)[0])
    ra, dec = np.radians(15.0 * right_ascension_h), np.radians(declination_deg)
    there = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    assert np.arccos(min(1.0, float(stars.direction[index] @ there))) < np.radians(0.02)
    assert stars.magnitude[index] == pytest.approx(magnitude, abs=0.15)
