"""Contents of a solved picture: coordinates of centre and axis, Sun, Moon and planets, and a FITS header.

The positions of Sun, Moon and planets are geocentric and come from ERFA's series plan94, moon98 and epv00.
From 1800 to 2050, plan94 (Simon et al. 1994) has errors of a few arcseconds, or of up to 80" for Jupiter and
Saturn. The error of moon98 (Meeus 1998) is 10". The series need no ephemeris file. For an observer on the
ground the Moon's direction differs by up to 1 deg from the geocentric direction.

The FITS header describes a tangent plane with distortion polynomials (TAN-SIP: Calabretta & Greisen 2002,
section 5.1.3, and Shupe et al. 2005). FITS counts pixels from 1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import erfa
import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT, DAY, earth_from_sun
from knightcube.vision.startracker.sky_map import SkyMap

_ORDER = 5  # order of the distortion polynomials; it is odd because a radial distortion has no even terms
_GRID = 25  # number of points per axis at which the distortion is fitted
_CARD, _BLOCK = 80, 2880

Card = tuple[str, str | int | float | bool]


@dataclass(frozen=True, slots=True, eq=False)
class _TangentPlane:
    """Tangent plane at a direction (3,) on the sky, with the unit vectors east and north (3,)."""

    middle: FloatArray
    east: FloatArray
    north: FloatArray

    @classmethod
    def at(cls, middle: FloatArray) -> _TangentPlane:
        east = np.array([-middle[1], middle[0], 0.0])
        east /= np.linalg.norm(east)
        return cls(middle, east, np.cross(middle, east))

    def degrees(self, directions: FloatArray) -> FloatArray:
        """Return the tangent-plane coordinates xi and eta (n, 2) of directions (n, 3)."""
        along = directions @ self.middle
        return np.degrees(directions @ np.stack([self.east, self.north], axis=1) / along[:, None])


def world_coordinates(sky: SkyMap, reversed_rows: bool = False) -> dict[str, str | int | float | bool]:
    """Return the values of the FITS header by key.

    The polynomials A and B map pixels to the sky, and the polynomials AP and BP map the sky to pixels. If
    `reversed_rows` is true, the first row of the file is the bottom row of the image.
    """
    camera = sky.camera

    def sky_of(points: FloatArray) -> FloatArray:
        return sky.directions(_in_file(points, camera.rows) if reversed_rows else points)

    centre = np.array([camera.centre])
    centre = (_in_file(centre, camera.rows) if reversed_rows else centre)[0]
    middle = sky_of(centre[None])[0]
    plane = _TangentPlane.at(middle)
    step = np.array([[0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])
    right, left, down, up = plane.degrees(sky_of(centre + step))
    cd = np.stack([right - left, down - up], axis=1)
    x, y = np.meshgrid(np.linspace(0, camera.columns - 1, _GRID), np.linspace(0, camera.rows - 1, _GRID))
    points = np.stack([x.ravel(), y.ravel()], axis=-1)
    directions = sky_of(points)
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


def _in_file(points: FloatArray, rows: int) -> FloatArray:
    """Return image points (n, 2), px, in the coordinates of a file with the opposite order of rows."""
    return np.asarray(points * np.array([1.0, -1.0]) + np.array([0.0, rows - 1.0]))


def _polynomials(
    names: tuple[str, str], places: FloatArray, shift: FloatArray, least: int
) -> dict[str, str | int | float | bool]:
    """Return the FITS coefficients of polynomials in `places` (n, 2) that fit `shift` (n, 2).

    The terms have orders from `least` to `_ORDER`.
    """
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


def header_text(sky: SkyMap, reversed_rows: bool = False) -> str:
    """Return a FITS file, as text, that has the header from `world_coordinates` and no data."""
    values = world_coordinates(sky, reversed_rows)
    cards: list[Card] = [("SIMPLE", True), ("BITPIX", 8), ("NAXIS", 0), *values.items()]
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


PLANETS = {"Mercury": 1, "Venus": 2, "Mars": 4, "Jupiter": 5, "Saturn": 6, "Uranus": 7, "Neptune": 8}
_LIGHT_DAY_PER_UNIT = ASTRONOMICAL_UNIT / 299_792_458.0 / DAY


@dataclass(frozen=True, slots=True, eq=False)
class SkyBody:
    """Sun, Moon or planet in a picture: direction (3,), ICRS without aberration, and position (2,), px."""

    name: str
    direction: FloatArray
    point: FloatArray


def bodies_in(sky: SkyMap, julian_date: float) -> list[SkyBody]:
    """Return the Sun, Moon and planets in a picture at a Julian date (TT)."""
    names, directions = zip(*directions_of_bodies(julian_date).items(), strict=True)
    places = sky.pixels(np.array(directions))
    inside = np.isfinite(places).all(axis=1) & sky.camera.contains(places)
    return [SkyBody(names[k], directions[k], places[k]) for k in np.flatnonzero(inside)]


def directions_of_bodies(julian_date: float) -> dict[str, FloatArray]:
    """Return the unit vectors (3,), ICRS, from the Earth's centre to each body, corrected for light time."""
    earth = earth_from_sun(julian_date)[0] / ASTRONOMICAL_UNIT
    found = {"Sun": -earth, "Moon": np.asarray(erfa.moon98(julian_date, 0.0)["p"], dtype=float)}
    for name, number in PLANETS.items():
        away = np.zeros(3)
        for _ in range(3):
            then = julian_date - _LIGHT_DAY_PER_UNIT * float(np.linalg.norm(away))
            away = np.asarray(erfa.plan94(then, 0.0, number)["p"], dtype=float) - earth
        found[name] = away
    return {name: away / np.linalg.norm(away) for name, away in found.items()}


_SAME_PX = 0.1  # distance (px) between optical axis and image centre above which both points are reported


def sky_facts(sky: SkyMap | None, bodies: Sequence[SkyBody], reversed_rows: bool = False) -> dict[str, Any]:
    """Return image centre, optical axis, bodies and world coordinates as JSON data.

    If `reversed_rows` is true, the first row of the file is the bottom row of the image.
    """
    if sky is None:
        return {}
    camera = sky.camera
    middle = 0.5 * (camera.columns - 1), 0.5 * (camera.rows - 1)
    return {
        "image_centre": _place_facts(sky, middle),
        "axis": _place_facts(sky, camera.centre),
        "bodies": [
            {"name": body.name, **_coordinates(body.direction), "point_px": body.point.tolist()}
            for body in bodies
        ],
        "wcs": world_coordinates(sky, reversed_rows),
    }


def _place_facts(sky: SkyMap, point: tuple[float, float]) -> dict[str, Any]:
    return {**_coordinates(sky.directions(np.array([point]))[0]), "point_px": list(point)}


def _coordinates(direction: FloatArray) -> dict[str, float]:
    # The remainder of a tiny negative angle is rounded to 360 deg; the second remainder is then 0.
    right_ascension = math.degrees(math.atan2(direction[1], direction[0])) % 360.0 % 360.0
    declination = math.degrees(math.atan2(direction[2], math.hypot(direction[0], direction[1])))
    return {"right_ascension_deg": right_ascension, "declination_deg": declination}


def sky_text(sky: SkyMap | None, bodies: Sequence[SkyBody]) -> str:
    """Return lines of text about the axis, the image centre and the bodies; empty without a solution."""
    if sky is None:
        return ""
    values, lines = sky_facts(sky, bodies), []
    if math.dist(values["axis"]["point_px"], values["image_centre"]["point_px"]) > _SAME_PX:
        # The text of the solution, which is printed first, already contains the axis's coordinates.
        centre, (x, y) = values["image_centre"], values["axis"]["point_px"]
        lines.append(f"axis:             at pixel {x:.1f}, {y:.1f}")
        place = f"{centre['right_ascension_deg']:.4f} {centre['declination_deg']:+.4f} deg"
        lines.append(f"image centre:     {place}")
    for body in bodies:
        x, y = body.point
        lines.append(f"in the picture:   {body.name} at pixel {x:.1f}, {y:.1f}")
    return "".join(line + "\n" for line in lines)
