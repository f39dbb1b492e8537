"""Surroundings of a flight for the console: orbit, Sun, magnetic field, and camera frames."""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from flight.schema.reader import load
from ground.documentation import Body
from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.earth.geomagnetism import field
from knightcube.astro.earth.orbit_knowledge import OrbitError, OrbitState, TwoLineElements
from knightcube.astro.earth.orientation import celestial_to_terrestrial, geodetic, terrestrial_time
from knightcube.astro.earth.sun import DAY, UNIX_EPOCH, earth_from_sun, sunlit_share
from knightcube.errors import KnightCubeError
from knightcube.vision.camera.images import facts_of

Object = dict[str, Any]
_TRACK_STEP, _TRACK_HALF = 60.0, 5700.0
"""Step (s) of the ground track, and the duration (s) that the track covers before and after the present."""
_MAX_SIDE = 640  # maximum width and height (px) of a picture on the page
_DARK, _BRIGHT = 50.0, 99.9
"""Percentiles of the pixel values that are shown as black (first) and as white (second)."""


@dataclass(frozen=True, slots=True)
class FlightSurroundings:
    """Orbit and devices from the configuration of a flight.

    Attributes:
        elements: two-line elements, or None if the configuration has none.
        lines: text of the two-line elements, or None if the configuration has none.
        camera: mounting (4,) of the star camera, body into camera, and its field of view, rad.
        coil_dipole: largest dipole moment along a body axis, A m^2.
        body: kind of body, or None if the configuration cannot be read.
        resistance: resistance of each coil, ohm.
        currents: matrix (3, 3) from a dipole moment in body axes, A m^2, to coil currents, A; None unless the
            body is a satellite with three coils.
    """

    elements: TwoLineElements | None
    camera: tuple[list[float], float] | None
    coil_dipole: float | None = None
    body: Body | None = None
    resistance: tuple[float, ...] = ()
    currents: list[list[float]] | None = None
    lines: tuple[str, str] | None = None

    @classmethod
    def of(cls, path: Path) -> FlightSurroundings:
        """Return orbit and devices from a configuration file, or `UNKNOWN` if the file cannot be read."""
        try:
            config: Any = load(path)
        except KnightCubeError:
            return UNKNOWN
        lines, camera, dipole = getattr(config, "elements", None), getattr(config, "camera", None), None
        view = None if camera is None else (list(camera.mounting), math.radians(camera.field_of_view_deg))
        body: Body = "testbed"
        currents = None
        if getattr(config, "craft", None) is not None:
            coils = config.coils.map()
            body, dipole = "orbit", float(coils.limits.max())
            currents = np.linalg.inv(coils.dipoles).tolist() if coils.dipoles.shape[1] == 3 else None
        elif (plant := getattr(config, "plant", None)) is not None:
            dipole = float(plant.coil_turns * plant.coil_area * config.coils.current_limit)
        elements = TwoLineElements(*lines) if lines else None
        return cls(elements, view, dipole, body, config.coils.resistance, currents, lines)

    def at(self, utc_ns: int) -> Object | None:
        """Return subsatellite and subsolar points (deg), height (km), field (T), and directions (3,) in ICRS.

        Returns None if the orbit at this time is unknown.
        """
        state = self._state(_julian_date(utc_ns))
        if state is None:
            return None
        sun_position = -earth_from_sun(float(terrestrial_time(state.julian_date)))[0]
        latitude, longitude, height = _below(state)
        to_ground = celestial_to_terrestrial(state.julian_date)
        sun_ground = to_ground @ (sun_position / np.linalg.norm(sun_position))
        return {
            "latitude": latitude,
            "longitude": longitude,
            "altitude_km": height * 1e-3,
            "sun_latitude": math.degrees(math.asin(sun_ground[2])),
            "sun_longitude": math.degrees(math.atan2(sun_ground[1], sun_ground[0])),
            "sunlit": float(sunlit_share(state.position[None], sun_position[None])[0]),
            "sun": _direction(sun_position - state.position),
            "nadir": _direction(-state.position),
            "velocity": _direction(state.velocity),
            "field_t": field(state.julian_date, state.position).tolist(),
        }

    def track(self, utc_ns: int) -> list[list[float]]:
        """Return the ground track [[latitude, longitude], ...], deg, 95 min before and after `utc_ns`."""
        if self.elements is None:
            return []
        dates = _julian_date(utc_ns) + np.arange(-_TRACK_HALF, _TRACK_HALF, _TRACK_STEP) / DAY
        states = [self._state(float(date)) for date in dates]
        return [list(_below(state)[:2]) for state in states if state is not None]

    def _state(self, date: float) -> OrbitState | None:
        try:
            return None if self.elements is None else self.elements.at(date)
        except OrbitError:
            return None


UNKNOWN = FlightSurroundings(None, None)
"""Value without orbit and camera mounting, for a flight whose configuration cannot be read."""


def _julian_date(utc_ns: int) -> float:
    return UNIX_EPOCH + utc_ns * 1e-9 / DAY


def _below(state: OrbitState) -> tuple[float, float, float]:
    """Return latitude, deg, longitude, deg, and height, m, of a satellite."""
    longitude, latitude, height = geodetic(celestial_to_terrestrial(state.julian_date) @ state.position)
    return math.degrees(float(latitude)), math.degrees(float(longitude)), float(height)


def _direction(vector: FloatArray) -> list[float]:
    unit: list[float] = (vector / np.linalg.norm(vector)).tolist()
    return unit


class FrameFolder:
    """Camera frames that a flight has kept in a folder, which is None if the flight keeps no frames."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder

    def facts(self, sequence: int) -> Object | None:
        """Return the results of a frame with its `columns` and `rows`, or None if the frame was not kept."""
        data = self._read(sequence)
        if data is None:
            return None
        try:
            rows, columns = pixels_of(data).shape
            return {**facts_of(data), "columns": columns, "rows": rows}
        except ValueError:
            return None

    def picture(self, sequence: int) -> bytes | None:
        """Return a frame as PNG, binned for the page, with stretched contrast, or None if it was not kept."""
        data = self._read(sequence)
        try:
            return None if data is None else png(stretched(binned(pixels_of(data))))
        except ValueError:
            return None

    def _read(self, sequence: int) -> bytes | None:
        if self._folder is None:
            return None
        try:
            return (self._folder / f"frame-{sequence:08d}.pgm").read_bytes()
        except OSError:
            return None


def pixels_of(data: bytes) -> Image:
    """Return a view of the pixels (rows, columns) of a kept frame.

    Raises ValueError if the number of pixels does not agree with the file's header.
    """
    parts = data.split(b"\n", 4)
    if len(parts) != 5 or parts[0] != b"P5":
        raise ValueError("not a kept frame")
    columns, rows = (int(word) for word in parts[2].split())
    kind = np.dtype(">u2") if int(parts[3]) > 255 else np.dtype(np.uint8)
    if columns < 1 or rows < 1 or len(parts[4]) != rows * columns * kind.itemsize:
        raise ValueError(f"{len(parts[4])} bytes are not a frame of {columns} x {rows} pixels")
    return np.frombuffer(parts[4], kind).reshape(rows, columns)


def binned(pixels: Image) -> Image:
    """Return the means of square blocks of pixels, so that the picture fits on the page."""
    step = -(-max(pixels.shape) // _MAX_SIDE)
    rows, columns = (side // step for side in pixels.shape)
    squares = pixels[: rows * step, : columns * step].reshape(rows, step, columns, step)
    return np.asarray(squares.mean(axis=(1, 3), dtype=np.float32))


def stretched(pixels: Image) -> npt.NDArray[np.uint8]:
    """Return the pixels as grey levels on a nonlinear scale on which faint stars are visible."""
    dark, bright = np.percentile(pixels, [_DARK, _BRIGHT])
    scale = max(float(bright - dark), 1e-9)
    levels = np.arcsinh(10.0 * np.clip((pixels - dark) / scale, 0.0, 1.0)) / np.arcsinh(10.0)
    return np.asarray(np.round(255.0 * levels), dtype=np.uint8)


def png(levels: npt.NDArray[np.uint8]) -> bytes:
    """Return grey levels (rows, columns) as the bytes of a PNG (ISO/IEC 15948) with 8 bits."""
    rows, columns = levels.shape
    lines = np.hstack([np.zeros((rows, 1), np.uint8), levels]).tobytes()
    head = struct.pack(">IIBBBBB", columns, rows, 8, 0, 0, 0, 0)
    data = b"\x89PNG\r\n\x1a\n"
    for kind, body in ((b"IHDR", head), (b"IDAT", zlib.compress(lines, 6)), (b"IEND", b"")):
        data += struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
    return data
