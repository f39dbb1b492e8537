"""Reads configurations: from YAML to a validated `flight.schema.sections.Config`.

Each error is one line that names the file, the line, the value and its cure.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

import msgspec

from flight.schema.consistency import check_consistency
from flight.schema.devices import Camera
from flight.schema.document import ConfigError, convert, read_document, read_text
from flight.schema.orbit import OrbitConfig
from flight.schema.sections import Config
from flight.schema.testbed import TestbedConfig, as_testbed
from knightcube.errors import UsageError

T = TypeVar("T")
S = TypeVar("S", bound=msgspec.Struct)

_FIELDS = {*TestbedConfig.__struct_fields__, *OrbitConfig.__struct_fields__}
"""Names of the top-level sections of all bodies."""


def load(path: Path) -> Config:
    """Read and validate a configuration file. Raises ConfigError."""
    return parse(read_text(path), str(path))


def parse(text: str, name: str = "configuration") -> Config:
    """Validate a configuration text. Error messages name the file `name`. Raises ConfigError."""
    document = read_document(text, name)
    for optional in ("camera", "power_monitor", "gps", "solar_strings"):
        if document.values.get(optional) == "none":
            document.values[optional] = None
    # A body defined outside this repository uses the sections of the testbed.
    shape = OrbitConfig if document.values.get("body") == "orbit" else TestbedConfig
    config: Config = convert(document, shape)
    check_consistency(config, document)
    return config


def load_testbed(path: Path) -> TestbedConfig:
    """Read and validate a configuration of the testbed.

    Raises ConfigError, also for the configuration of another body.
    """
    try:
        return as_testbed(load(path))
    except ConfigError as error:
        raise placed(error, read_text(path), str(path)) from error


def load_camera(path: Path) -> Camera:
    """Read the camera of a configuration, or of a file with only a `camera` section.

    Raises ConfigError, also if there is no camera.
    """
    text = read_text(path)
    document = read_document(text, str(path))
    if set(document.values) == {"camera"} and document.values["camera"] != "none":
        return convert(document, Camera, "camera")
    camera = parse(text, str(path)).camera
    if camera is None:
        raise ConfigError(str(path), "`camera` is none: give a configuration with a camera")
    return camera


def placed(error: UsageError, text: str, name: str) -> UsageError:
    """Add file and line to an error that begins with a value's dotted name; return other errors unchanged."""
    where, _, problem = str(error).partition(": ")
    if where.partition(".")[0].partition("[")[0] not in _FIELDS:
        return error
    return read_document(text, name).error(where, problem)


def simulation_section(text: str, name: str, shape: type[T]) -> T | None:
    """Return the `simulation` section of a configuration text as `shape`, or None if there is none.

    The type `shape` of the `simulation` section is defined by the simulator, which this package does not
    import. Raises ConfigError.
    """
    document = read_document(text, name)
    return None if document.values.get("simulation") is None else convert(document, shape, "simulation")


def replace(section: S, **changes: Any) -> S:
    """Return a copy of a section with some values changed."""
    return msgspec.structs.replace(section, **changes)
