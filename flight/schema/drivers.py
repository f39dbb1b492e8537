"""The drivers of devices, by the section and name with which a configuration chooses them.

Our drivers are entries of the same table of registrations (`hal.interfaces.driver`) in which a driver of
another package is found as `module:object`. Functions are named by text, because the schema imports neither
drivers nor simulator.
"""

from __future__ import annotations

import os
from collections.abc import Hashable, Mapping, Sequence
from functools import lru_cache
from typing import Any, cast

import msgspec
import numpy as np

from flight.schema.devices import (
    AravisDevice,
    Camera,
    Coils,
    Gps,
    InertialUnitSection,
    PowerMonitorSection,
    SensorsSection,
    SolarStringsSection,
    V4l2Device,
    WideCamera,
)
from flight.schema.document import ConfigError, Document, imported
from hal.interfaces.driver import Driver, later
from knightcube.astro.arrays import FloatArray


def _ours(kind: str, section: type[Any], name: str, **more: Any) -> Driver:
    """Return the registration of a driver of ours, with functions in `flight.app.drivers`."""
    functions = {word: later(f"flight.app.drivers:{word}_{name}") for word in ("open", "probe", "files")}
    emulate = None if kind == "camera" else later(f"sim_hal.devices:emulate_{name}")
    return Driver(kind, section, emulate=emulate, **functions, **more)


VN100 = _ours(
    "inertial_unit",
    InertialUnitSection,
    "vn100",
    check=later("flight.app.drivers:unit_settings"),
)
SENSORS = _ours("inertial_unit", SensorsSection, "sensors")
PCA9685 = _ours(
    "coils",
    Coils,
    "pca9685",
    check=later("flight.app.drivers:coil_settings"),
    off=later("flight.app.drivers:off_pca9685"),
)
DRV8830 = _ours(
    "coils",
    Coils,
    "drv8830",
    check=later("flight.app.drivers:coil_settings"),
    off=later("flight.app.drivers:off_drv8830"),
)
INA219 = _ours("power_monitor", PowerMonitorSection, "ina219")
UBLOX = _ours("gps", Gps, "ublox")
NMEA = _ours("gps", Gps, "nmea")
ADS1115 = _ours("solar_strings", SolarStringsSection, "ads1115")
V4L2 = _ours("camera", V4l2Device, "v4l2")
ARAVIS = _ours("camera", AravisDevice, "aravis")

DRIVERS: Mapping[str, Mapping[str, str]] = {
    "inertial_unit": {"vn100": f"{__name__}:VN100", "sensors": f"{__name__}:SENSORS"},
    "coils": {"pca9685": f"{__name__}:PCA9685", "drv8830": f"{__name__}:DRV8830"},
    "power_monitor": {"ina219": f"{__name__}:INA219"},
    "gps": {"ublox": f"{__name__}:UBLOX", "nmea": f"{__name__}:NMEA"},
    "solar_strings": {"ads1115": f"{__name__}:ADS1115"},
    "camera": {"v4l2": f"{__name__}:V4L2", "aravis": f"{__name__}:ARAVIS"},
}
"""Registrations (`module:object`) of each section by built-in name; the first name is the default."""


SENSOR_PARTS: Mapping[str, str] = {
    "icm20948": "adafruit_icm20x:ICM20948",
    "lis3mdl": "adafruit_lis3mdl:LIS3MDL",
    "adis16470": "hal.drivers.adis16470:Adis16470",
}
"""Classes (`module:class`) of the sensors with an emulator, by name."""


def axis_matrix(names: Sequence[str]) -> FloatArray:
    """Return the matrix (3, 3) from sensor axes to the axes whose sensor axes are named, such as "-x"."""
    return np.array([[(1.0, -1.0)[name[0] == "-"] * (name[-1] == axis) for axis in "xyz"] for name in names])


def driver_of(kind: str, section: Any, key: str = "") -> Driver:
    """Return the registration of the driver that a section names. Raises ConfigError.

    On a board, only built-in drivers and permitted objects are imported (`flight.schema.document.imported`).
    """
    named = getattr(section, "driver", None) or section.__struct_config__.tag
    return _named(kind, named, key or f"{kind}.driver")


def _named(kind: str, named: str, key: str) -> Driver:
    driver = imported(key, named, DRIVERS[kind], os.environ)
    if not isinstance(driver, Driver) or driver.kind != kind:
        raise ConfigError(
            key, f"is {named!r}: this object is not a Driver (hal.interfaces.driver) of `{kind}`"
        )
    return driver


def with_drivers(shape: type[Any], document: Document) -> type[Any]:
    """Return the type of a configuration whose sections have the types that their drivers registered.

    Raises ConfigError for a driver that cannot be imported.
    """

    def section_of(kind: str, named: Any, key: str) -> type[Any]:
        try:
            return _named(kind, named, key).section
        except ConfigError as error:
            raise document.error(error.where, error.problem) from error

    fields: list[tuple[str, Any]] = []
    for kind in DRIVERS:
        section = document.values.get(kind)
        named = section.get("driver") if isinstance(section, dict) else None
        if isinstance(named, str) and kind != "camera" and named != next(iter(DRIVERS[kind])):
            fields.append((kind, section_of(kind, named, f"{kind}.driver")))
            _drop_inherited(kind, fields[-1][1], document)
    others: dict[str, type[Any]] = {}
    for key, camera in _cameras(document.values):
        device = camera.get("device")
        named = device.get("driver") if isinstance(device, dict) else None
        if isinstance(named, str) and ":" in named:
            others[named] = section_of("camera", named, f"{key}.device.driver")
    if others:
        fields += _camera_fields(tuple(sorted(others.items())))
    return _shape(cast(Hashable, shape), tuple(fields)) if fields else shape


def _drop_inherited(kind: str, section: type[Any], document: Document) -> None:
    """Remove the keys of another driver that an extended file gives, because they do not apply."""
    known = {field.encode_name for field in msgspec.structs.fields(section)}
    for key in set(document.values[kind]) - known:
        if f"{kind}.{key}" in document.files:
            del document.values[kind][key]


def _cameras(values: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    wide = values.get("wide_cameras")
    named = [("camera", values.get("camera"))]
    named += [(f"wide_cameras[{n}]", one) for n, one in enumerate(wide if isinstance(wide, list) else ())]
    return [(key, camera) for key, camera in named if isinstance(camera, dict)]


@lru_cache(maxsize=32)
def _camera_fields(others: tuple[tuple[str, type[Any]], ...]) -> list[tuple[str, Any]]:
    """Return the fields of the cameras, whose `device` may also be of the tagged types `others`."""
    device: Any = V4l2Device | AravisDevice | None
    for named, section in others:
        name, bases = section.__name__, (section,)
        device |= msgspec.defstruct(
            name, [], bases=bases, tag_field="driver", tag=named, frozen=True, kw_only=True
        )
    camera, wide = (_shape(kind, (("device", device),)) for kind in (Camera, WideCamera))
    return [("camera", camera | None), ("wide_cameras", tuple[wide, ...])]  # type: ignore[valid-type]


@lru_cache(maxsize=64)
def _shape(shape: Hashable, fields: tuple[tuple[str, Any], ...]) -> type[Any]:
    """Return a struct type derived from `shape` in which fields have other types, and its defaults."""
    assert isinstance(shape, type)
    defaults = {one.name: one.default for one in msgspec.structs.fields(shape)}
    given = [
        (name, kind) if defaults[name] is msgspec.NODEFAULT else (name, kind, defaults[name])
        for name, kind in fields
    ]
    return msgspec.defstruct(shape.__name__, given, bases=(shape,), frozen=True, kw_only=True)
