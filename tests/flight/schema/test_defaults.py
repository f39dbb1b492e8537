"""Tests that settings classes have the same defaults as the sections of the configuration."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import json
import pkgutil
from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from types import ModuleType

import msgspec
import numpy as np

import flight
import hal
import knightcube
import sim_hal
from flight.schema import bodies, devices, sections
from hal.interfaces.wires import SECOND_NS
from tests.support.section_defaults import defaults_of

OF_CAMERA = (devices.Camera, devices.StarTrackerSection)
SERVES: dict[str, tuple[type[msgspec.Struct], ...]] = {
    "AdaptiveSettings": (bodies.Control,),
    "AravisSettings": (devices.AravisDevice, devices.Camera),
    "CoilDriveSettings": (devices.Coils,),
    "CoilSettings": (devices.Coils,),
    "CoilMonitorSettings": (devices.Coils, devices.PowerMonitorSection),
    "DetumblerSettings": (bodies.BdotDetumble, bodies.Plant),
    "ExcitationSettings": (bodies.Identification,),
    "FieldDetumblerSettings": (bodies.FieldDetumble,),
    "FieldRateSettings": (bodies.FieldDetumble, bodies.Craft),
    "AttitudeFilterSettings": (bodies.ThreadEstimation,),
    "ImagingSettings": OF_CAMERA,
    "LikelihoodSettings": OF_CAMERA,
    "NavigationSettings": (devices.InertialUnitSection, sections.Estimation),
    "OrbitFilterSettings": (bodies.OrbitEstimation, bodies.Craft),
    "PidSettings": (bodies.PidGains,),
    "PlanningSettings": (bodies.Guidance,),
    "ResponseSettings": (bodies.Plant, devices.InertialUnitSection),
    "SelfTestSettings": (bodies.PointingSection, devices.Coils),
    "ObjectMeasurementSettings": (devices.ObjectTracking,),
    "SolveSettings": OF_CAMERA,
    "StationSettings": (sections.Link,),
    "StreakSettings": OF_CAMERA,
    "SunAcquisitionSettings": (bodies.PointingSection, bodies.Craft),
    "TrackSettings": (devices.ObjectTracking,),
    "TrackerSettings": OF_CAMERA,
    "V4l2Settings": (devices.V4l2Device, devices.Camera),
    "UnitSettings": (devices.SensorsSection,),
    "Vn100Settings": (devices.InertialUnitSection,),
    "HorizonCameraSettings": (devices.WideCamera,),
}
"""Configuration sections whose values a flight copies into each settings class."""

FILLED = {"DetectionSettings"}
"""Settings classes in which None means a value measured from the frame; a flight uses the camera's value."""

OTHERS = {
    "ClassicalSettings": "the thesis's star tracker, for comparison",
    "EdgeSettings": "horizon cameras",
    "EndpointSettings": "limits of the method; gain and saturation come from the star tracker's settings",
    "HorizonSettings": "horizon cameras",
    "FreeFilterSettings": "slow noises of a satellite's torques; the rest is compared as OrbitFilterSettings",
    "IdentificationSettings": "limits of the method",
    "IndexSettings": "an index is built on the ground",
    "ObjectSettings": "limits of the method",
    "SunSettings": "Sun cameras",
    "VerificationSettings": "limits of the method",
    "Vn100EmulatorSettings": "the emulated unit: truth, not belief",
}
"""Settings classes that no configuration section fills, with the reasons."""


def _modules(package: ModuleType) -> Iterator[ModuleType]:
    for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        # Basilisk is an optional dependency. The simulated world of Basilisk reads its values from the
        # configuration.
        if not found.name.endswith("__main__") and ".basilisk" not in found.name:
            yield importlib.import_module(found.name)


def _settings() -> dict[str, type]:
    """Return the settings classes of the flight software and the simulator, by name."""
    return {
        name: kind
        for package in (knightcube, flight, hal, sim_hal)
        for module in _modules(package)
        for name, kind in inspect.getmembers(module, inspect.isclass)
        if name.endswith("Settings") and dataclasses.is_dataclass(kind)
    }


def _default(field: dataclasses.Field[object]) -> object:
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return field.default


def _disagreements(kind: type, section: type[msgspec.Struct]) -> list[str]:
    """Return the values whose two defaults differ. Times in s are converted to ns for the comparison.

    Values without a default, and values whose default in the section is None, are not compared.
    """
    of_section = {field.name: field.default for field in msgspec.structs.fields(section)}
    found = []
    for field in dataclasses.fields(kind):
        key = field.name.removesuffix("_ns")
        own, configured = _default(field), of_section.get(key, msgspec.NODEFAULT)
        if own is dataclasses.MISSING or configured in {None, msgspec.NODEFAULT}:
            continue
        own = own.value if isinstance(own, Enum) else own
        if key != field.name and isinstance(configured, float):
            configured = round(configured * SECOND_NS)
        if not np.array_equal(np.asarray(own), np.asarray(configured)):
            found.append(f"{kind.__name__}.{field.name} = {own}, {section.__name__}.{key} = {configured}")
    return found


def test_no_default_is_defined_twice_with_different_values() -> None:
    kinds = _settings()
    found = [
        line
        for name, filled_from in SERVES.items()
        for section in filled_from
        for line in _disagreements(kinds[name], section)
    ]
    assert found == []


def test_every_settings_class_is_compared_or_has_a_reason() -> None:
    assert sorted(_settings()) == sorted({*SERVES, *FILLED, *OTHERS})


def test_a_default_that_differs_is_found() -> None:
    @dataclasses.dataclass
    class Other:
        stale_after: float = 0.3
        resistance: float = 1.0

    assert _disagreements(Other, devices.Coils) == ["Other.stale_after = 0.3, Coils.stale_after = 0.25"]


def test_the_defaults_are_the_published_ones() -> None:
    """The defaults are unchanged, because a configuration that omits a key depends on its default."""
    published = json.loads(Path(__file__).with_name("published_defaults.json").read_text(encoding="utf-8"))
    assert json.loads(json.dumps(defaults_of(devices, sections, bodies))) == published
