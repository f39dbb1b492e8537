"""Reading a configuration: YAML in, a validated `flight.schema.sections.Config` out, or one clear line.

Every complaint names the file, the line, the value and what would be right.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

import msgspec

from flight.schema.consistency import check_consistency
from flight.schema.conversion import convert
from flight.schema.devices import Camera
from flight.schema.document import read_document, read_text
from flight.schema.errors import ConfigError
from flight.schema.orbit import OrbitConfig
from flight.schema.sections import Config
from flight.schema.testbed import TestbedConfig, as_testbed
from knightcube.errors import UsageError

T = TypeVar("T")
S = TypeVar("S", bound=msgspec.Struct)

_SHAPES: dict[str, type[Config]] = {"orbit": OrbitConfig}
"""The shape of a body's configuration; a body that is not here has the testbed's."""
_EVERY: tuple[type[Config], ...] = (TestbedConfig, *_SHAPES.values())
_FIELDS = {name for shape in _EVERY for name in shape.__struct_fields__}


def load(path: Path) -> Config:
    """Read and validate a configuration file. Raises ConfigError."""
    return parse(read_text(path), str(path))


def parse(text: str, name: str = "configuration") -> Config:
    """Validate configuration text; `name` stands for the file in complaints. Raises ConfigError."""
    document = read_document(text, name)
    for optional in ("camera", "power_monitor", "gps", "solar_strings"):
        if document.values.get(optional) == "none":
            document.values[optional] = None
    shape = _SHAPES.get(str(document.values.get("body")), TestbedConfig)
    config = convert(document, shape)
    check_consistency(config, document)
    return config


def load_testbed(path: Path) -> TestbedConfig:
    """Read and validate a configuration of the testbed. Raises ConfigError, also for another body's."""
    try:
        return as_testbed(load(path))
    except ConfigError as error:
        raise placed(error, read_text(path), str(path)) from error


def load_camera(path: Path) -> Camera:
    """Read the camera of a whole configuration, or of a file that holds nothing but a `camera` section.

    Raises ConfigError, also when there is no camera.
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
    """Return a complaint that begins with a value's dotted name with file and line; others as they are."""
    where, _, problem = str(error).partition(": ")
    if where.partition(".")[0].partition("[")[0] not in _FIELDS:
        return error
    return read_document(text, name).error(where, problem)


def simulation_section(text: str, name: str, shape: type[T]) -> T | None:
    """Return the `simulation` section of configuration text as `shape`, None when there is none.

    The section's shape belongs to the simulator, which this package does not know. Raises ConfigError.
    """
    document = read_document(text, name)
    return None if document.values.get("simulation") is None else convert(document, shape, "simulation")


def replace(section: S, **changes: Any) -> S:
    """Return a section with some values changed."""
    return msgspec.structs.replace(section, **changes)
