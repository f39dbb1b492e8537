"""Attitude sensors of a satellite and their mounting. Each satellite has a YAML file in `config/sensors`.

In the nominal attitude, the body axes are z down to nadir, x forward along the orbit, and y to the right
(Meller et al., Fig. 2). Units are SI unless the name states another unit.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta

from flight.schema.document import (
    ConfigError,
    NotNegative,
    Positive,
    Quaternion,
    Section,
    convert,
    read_document,
    read_text,
)
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix

_UNIT_TOLERANCE = 1e-6


class WideCamera(Section, frozen=True, kw_only=True):
    """A camera for horizon and Sun.

    `mounting` rotates body axes to camera axes (boresight z, columns x, rows y). `field_of_view_deg` is the
    angle across the columns. As pixels are square, `field_of_view_deg` also determines the angle across the
    rows.
    """

    name: Annotated[str, Meta(min_length=1, max_length=32)]
    mounting: Quaternion
    field_of_view_deg: Annotated[float, Meta(gt=1.0, lt=175.0)] = 67.0
    columns: Annotated[int, Meta(ge=64, le=8192)] = 512
    rows: Annotated[int, Meta(ge=64, le=8192)] = 512
    sun: bool = True

    @property
    def to_camera(self) -> FloatArray:
        """Matrix (3, 3) that rotates body vectors to camera axes."""
        return attitude_matrix(np.array(self.mounting))


class SolarString(Section, frozen=True, kw_only=True):
    """A string of solar cells on one face.

    The current is proportional to the cosine of the Sun's incidence angle.
    """

    name: Annotated[str, Meta(min_length=1, max_length=32)]
    normal: tuple[float, float, float]
    noise: Positive = 0.02


class Gyros(Section, frozen=True, kw_only=True):
    """Three rate gyros along the body axes.

    `noise` is in rad/s per sqrt(Hz), `bias_start` in rad/s, and `bias_walk` in rad/s per sqrt(s). `rate_hz`
    is the sample rate. Each sample is the mean rate over one sample period.
    """

    noise: Positive
    bias_start: Positive
    bias_walk: Positive
    rate_hz: Annotated[float, Meta(gt=0.0, le=200.0)] = 2.0

    @property
    def sample_sigma(self) -> float:
        """Standard deviation (rad/s) of one gyro sample."""
        return self.noise * math.sqrt(self.rate_hz)


class Magnetometer(Section, frozen=True, kw_only=True):
    """A three-axis magnetometer along the body axes.

    `noise` (T) is the noise of a sample, and `bias_start` (T) the hard-iron error after ground calibration.
    `bias_walk` (T per sqrt(s)) is the combined random walk of the hard iron and of the field model's error in
    orbit.
    """

    noise: Positive
    bias_start: NotNegative
    bias_walk: NotNegative
    rate_hz: Annotated[float, Meta(gt=0.0, le=100.0)] = 1.0


class SensorSuite(Section, frozen=True, kw_only=True):
    """All sensors of a satellite, and its inertia (kg m^2, body axes)."""

    name: Annotated[str, Meta(min_length=1, max_length=64)]
    inertia: tuple[Positive, Positive, Positive]
    cameras: Annotated[tuple[WideCamera, ...], Meta(min_length=1)]
    camera_rate_hz: Annotated[float, Meta(gt=0.0, le=50.0)] = 2.0
    solar_strings: tuple[SolarString, ...] = ()
    magnetometer: Magnetometer | None = None
    gyros: Gyros | None = None


def load(path: Path) -> SensorSuite:
    """Read and check a sensor suite. Raises ConfigError."""
    suite = convert(read_document(read_text(path), str(path)), SensorSuite)
    for kind, named in (("cameras", suite.cameras), ("solar_strings", suite.solar_strings)):
        names = [entry.name for entry in named]
        for index, name in enumerate(names):
            if name in names[:index]:
                raise ConfigError(str(path), f"`{kind}[{index}].name` is {name!r}, which stands twice")
    for index, camera in enumerate(suite.cameras):
        _refuse_length(path, f"cameras[{index}].mounting", camera.mounting, "a quaternion")
    for index, string in enumerate(suite.solar_strings):
        _refuse_length(path, f"solar_strings[{index}].normal", string.normal, "a normal")
    return suite


def _refuse_length(path: Path, dotted: str, vector: tuple[float, ...], kind: str) -> None:
    length = math.sqrt(sum(part * part for part in vector))
    if abs(length - 1.0) > _UNIT_TOLERANCE:
        raise ConfigError(str(path), f"`{dotted}` has length {length:.6g}: {kind} must have length 1")
