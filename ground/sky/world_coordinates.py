"""A FITS header of world coordinates: tangent plane with polynomials for the distortion (TAN-SIP).

Calabretta & Greisen 2002, section 5.1.3; Shupe et al. 2005 (SIP). FITS counts pixels from 1, and rows as they
stand in the file. Written by hand: sixty lines against a library larger than this repository.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.vision.startracker.sky_map import SkyMap

# Odd: a radial distortion has no even terms, and a cubic leaves 2" of one of 1 % at the corner of 18 deg.
_ORDER = 5
_GRID = 25
_CARD, _BLOCK = 80, 2880

Card = tuple[str, str | int | float | bool]


@dataclass(frozen=True, slots=True, eq=False)
class _Plane:
    """The tangent plane at a direction of the sky (3,), with east and north (3,)."""

    middle: FloatArray
    east: FloatArray
    north: FloatArray

    @classmethod
    def at(cls, middle: FloatArray) -> _Plane:
        east = np.array([-middle[1], middle[0], 0.0])
        east /= np.linalg.norm(east)
        return cls(middle, east, np.cross(middle, east))

    def degrees(self, directions: FloatArray) -> FloatArray:
        """Return xi, eta (n, 2) of directions (n, 3)."""
        along = directions @ self.middle
        return np.degrees(directions @ np.stack([self.east, self.north], axis=1) / along[:, None])


def world_coordinates(sky: SkyMap) -> dict[str, str | int | float | bool]:
    """Return the header's values by key; A and B from pixels to the sky, AP and BP back."""
    camera = sky.camera
    centre = np.array(camera.centre)
    middle = sky.directions(centre[None])[0]
    plane = _Plane.at(middle)
    step = np.array([[0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])
    right, left, down, up = plane.degrees(sky.directions(centre + step))
    cd = np.stack([right - left, down - up], axis=1)
    x, y = np.meshgrid(np.linspace(0, camera.columns - 1, _GRID), np.linspace(0, camera.rows - 1, _GRID))
    points = np.stack([x.ravel(), y.ravel()], axis=-1)
    directions = sky.directions(points)
    seen = np.isfinite(directions).all(axis=1) & (directions @ middle > 0.0)
    off = points[seen] - centre
    straight = plane.degrees(directions[seen]) @ np.linalg.inv(cd).T
    header: dict[str, str | int | float | bool] = {
        "WCSAXES": 2,
        "CTYPE1": "RA---TAN-SIP",
        "CTYPE2": "DEC--TAN-SIP",
        "CUNIT1": "deg",
        "CUNIT2": "deg",
        "RADESYS": "ICRS",
        "CRVAL1": float(np.degrees(np.arctan2(middle[1], middle[0])) % 360.0),
        "CRVAL2": float(np.degrees(np.arcsin(np.clip(middle[2], -1.0, 1.0)))),
        "CRPIX1": float(centre[0] + 1.0),
        "CRPIX2": float(centre[1] + 1.0),
        "CD1_1": float(cd[0, 0]),
        "CD1_2": float(cd[0, 1]),
        "CD2_1": float(cd[1, 0]),
        "CD2_2": float(cd[1, 1]),
        "IMAGEW": camera.columns,
        "IMAGEH": camera.rows,
    }
    header |= _polynomials(("A", "B"), off, straight - off, least=2)
    return header | _polynomials(("AP", "BP"), straight, off - straight, least=1)


def _polynomials(
    names: tuple[str, str], places: FloatArray, shift: FloatArray, least: int
) -> dict[str, str | int | float | bool]:
    """Return the coefficients that make `shift` (n, 2) of `places` (n, 2), px, terms of `least` order on."""
    powers = [(i, j) for i in range(_ORDER + 1) for j in range(_ORDER + 1 - i) if least <= i + j]
    size = float(np.abs(places).max())
    x, y = (places / size).T
    terms = np.stack([x**i * y**j for i, j in powers], axis=1)
    found: dict[str, str | int | float | bool] = {}
    for name, values in zip(names, np.linalg.lstsq(terms, shift, rcond=None)[0].T, strict=True):
        found[f"{name}_ORDER"] = _ORDER
        for (i, j), value in zip(powers, values, strict=True):
            found[f"{name}_{i}_{j}"] = float(value / size ** (i + j))
    return found


def header_text(sky: SkyMap) -> str:
    """Return a FITS file of a header alone, ASCII."""
    cards: list[Card] = [("SIMPLE", True), ("BITPIX", 8), ("NAXIS", 0), *world_coordinates(sky).items()]
    text = "".join(_card(key, value) for key, value in cards) + "END".ljust(_CARD)
    return text.ljust(-(-len(text) // _BLOCK) * _BLOCK)


def _card(key: str, value: str | int | float | bool) -> str:
    if isinstance(value, bool):
        shown = f"{'T' if value else 'F':>20s}"
    elif isinstance(value, str):
        shown = f"'{value:8s}'"
    else:
        shown = f"{value:>20d}" if isinstance(value, int) else f"{value:>20.13E}"
    return f"{key:8s}= {shown}".ljust(_CARD)
