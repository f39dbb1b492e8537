"""Chooses the configuration to fly: the accepted file or, if damaged, the last configuration that flew.

`deploy/install.sh` writes the SHA-256 of an accepted configuration beside the file. A flight reads its file
once, verifies these bytes against the sum and flies them: a flipped bit on the disk makes 1.05e-3 a 1.05e-7,
which validation would not detect. A file without a sum is flown as it stands, unless an accepted
configuration is kept: then there was a sum.

A service keeps the accepted configurations that flew, the newest and two older ones, in its state folder.
Each is one file whose name holds its number and its SHA-256, put in place by one rename: a configuration
never stands without its sum.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flight.app.devices import corrupted_text
from flight.app.run import RunRequest
from flight.loop.state import LARGEST_FILE, LinuxFiles, replace_file, service_folder
from flight.schema import reader as configuration
from flight.schema.document import ConfigError, UnreadConfigError, checked_length, no_such_file, read_text
from flight.schema.sections import Config
from hal.interfaces.wires import Clock, Ticker
from knightcube.errors import UsageError

FOLDER = "flown"
KEPT = 3
GOOD_START_NS = 10_000_000_000
"""After this flight time a configuration is kept."""

_NAME = re.compile(r"(\d{6,})-([0-9a-f]{64})\.yaml")


@dataclass(frozen=True, slots=True)
class KeptConfig:
    """A configuration that flew."""

    number: int
    path: Path
    text: str


def kept_configs(folder: Path) -> list[KeptConfig]:
    """Return the undamaged configurations kept in a state folder, the newest first. Raises OSError."""
    found = []
    for number, path, digest in _named(folder):
        with suppress(OSError, UnicodeDecodeError):
            data = LinuxFiles().read(path)
            if data is not None and hashlib.sha256(data).hexdigest() == digest:
                found.append(KeptConfig(number, path, data.decode("utf-8")))
    return sorted(found, key=lambda kept: kept.number, reverse=True)


class FlownConfig:
    """Stores the configuration of a flight that has started well."""

    def __init__(self, text: str, folder: Path) -> None:
        """Prepare the storage of `text`, the configuration as read, in a state folder."""
        self._data = text.encode()
        self._folder = folder
        self._kept = False

    def serve(self, clock: Clock) -> Ticker:
        """Return the ticker that keeps the configuration, outside the loop, after `GOOD_START_NS`."""
        return clock.ticker("configuration", GOOD_START_NS, self.keep)

    def keep(self) -> None:
        """Write the copy unless the newest copy is the same; a failed write is retried at the next call."""
        if self._kept:
            return
        with suppress(OSError):
            place = self._folder / FOLDER
            place.mkdir(exist_ok=True)
            kept = kept_configs(self._folder)
            if not kept or kept[0].text.encode() != self._data:
                number = max((number for number, _, _ in _named(self._folder)), default=0) + 1
                name = f"{number:06d}-{hashlib.sha256(self._data).hexdigest()}.yaml"
                replace_file(LinuxFiles(), place / name, self._data)
                kept = kept_configs(self._folder)
            # The newest copies of `KEPT` different texts stay; damaged and older copies go.
            texts: dict[str, Path] = {}
            for copy in kept:
                texts.setdefault(copy.text, copy.path)
            staying = set(list(texts.values())[:KEPT])
            for _, path, _ in _named(self._folder):
                if path not in staying:
                    path.unlink(missing_ok=True)
            self._kept = True


def _named(folder: Path) -> list[tuple[int, Path, str]]:
    """Return number, path and digest of the files named like a kept configuration. Raises OSError."""
    place = folder / FOLDER
    try:
        paths = list(place.iterdir())
    except FileNotFoundError:
        return []
    matches = ((_NAME.fullmatch(path.name), path) for path in paths)
    return [(int(match[1]), path, match[2]) for match, path in matches if match]


_CURE = "was it edited? Then accept it: deploy/install.sh --accept; else put back what was there"
_TRIES = 3
"""Number of attempts to read a file, because a single failed disk access is not damage."""


@dataclass(frozen=True, slots=True)
class Chosen:
    """A configuration to fly.

    Attributes:
        path: the file that `text` was read from.
        problem: why `path` is not the requested file; empty if it is.
        accepted: whether a checksum beside the requested file confirms the bytes.
    """

    path: Path
    text: str
    problem: str = ""
    accepted: bool = False


def sum_file(path: Path) -> Path:
    """Return the path of a configuration's checksum, as written by sha256sum."""
    return path.parent / f"{path.name}.sha256"  # `with_name` would fail on `.`


def accepted_config(path: Path, environment: Mapping[str, str]) -> Chosen:
    """Return the configuration to fly, read once.

    Raises UnreadConfigError, with the cure, when `path` is damaged and no configuration that flew is kept.
    """
    folder = service_folder(environment)
    read = _read_any if folder is None else LinuxFiles().read
    data, problem, accepted = _verified(path, read)
    kept = kept_configs(folder) if folder is not None and not accepted else []
    if kept and not problem:
        problem = f"{sum_file(path).name} is missing"
    if data is not None and not problem:
        return Chosen(path, _text(path, data), "", accepted)
    for one in kept:
        try:
            configuration.parse(one.text, str(one.path))
        except ConfigError:  # the copy flew with another version of the software
            continue
        return Chosen(one.path, one.text, f"{path}: {problem}: the last one that flew is flown; {_CURE}")
    if os.path.lexists(sum_file(path)) or folder is not None:
        problem += f", and no copy of one that flew is kept; {_CURE}"
    raise UnreadConfigError(str(path), problem)


def _verified(path: Path, read: Callable[[Path], bytes | None]) -> tuple[bytes | None, str, bool]:
    """Return a file's bytes, its problem or an empty text, and whether a checksum confirms the bytes."""
    try:
        data = _persistently(read, path)
        expected = _persistently(LinuxFiles().read, sum_file(path))
    except OSError as error:
        return None, f"cannot be read: {error.strerror or error}", False
    if data is None:
        return None, f"cannot be read: {no_such_file()}", False
    if expected is None:
        dangling = os.path.lexists(sum_file(path))
        return data, f"{sum_file(path).name} leads nowhere" if dangling else "", False
    accepted = expected.split()[:1] == [hashlib.sha256(data).hexdigest().encode()]
    return data, "" if accepted else "is not what was accepted (sha256)", accepted


def _persistently(read: Callable[[Path], bytes | None], path: Path) -> bytes | None:
    """Read a file with retries. Raises OSError."""
    for _ in range(_TRIES - 1):
        with suppress(OSError):
            return read(path)
    return read(path)


def _read_any(path: Path) -> bytes | None:
    """Return a bounded number of bytes of any kind of file, for example a pipe."""
    try:
        with path.open("rb") as file:
            return file.read(4 * LARGEST_FILE + 1)
    except FileNotFoundError:
        return None


def _text(path: Path, data: bytes) -> str:
    """Return a configuration's text. Raises ConfigError for bytes that are not UTF-8."""
    try:
        return checked_length(data.decode("utf-8"), path)
    except UnicodeDecodeError as error:
        raise ConfigError(str(path), f"cannot be read: {error}") from error


def requested_config(request: RunRequest, text: str | None = None) -> tuple[str, Config]:
    """Return the configuration as text and as values, with the request's changes in the values.

    `text` is the content of the file; if None, the file is read. Raises ConfigError for a mistake in the
    file, UsageError for a mistake in the request.
    """
    text = read_text(request.config_path) if text is None else text
    config = configuration.parse(text, str(request.config_path))
    if request.faults and config.simulation is None:
        raise UsageError("--fault: this configuration flies real devices, which break by themselves")
    if request.faults:
        spoiled = corrupted_text(request, text)
        if spoiled != text:
            text, config = spoiled, configuration.parse(spoiled, str(request.config_path))
    if request.duration is not None:
        if not (np.isfinite(request.duration) and request.duration > 0.0):
            raise UsageError(f"--duration {request.duration}: must be a positive number of seconds")
        config = config.shortened(request.duration)
    return text, config
