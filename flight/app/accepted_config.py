"""Chooses the configuration to fly: the accepted file or, if it is damaged, the last configuration that flew.

The script `deploy/install.sh` writes the SHA-256 checksum of an accepted configuration beside its file. A
flight reads its file once, verifies the bytes against the checksum, and flies these bytes. A flipped bit on
the disk can turn 1.05e-3 into 1.05e-7, which validation would not detect. A file without a checksum is flown
as it is, unless an accepted configuration is stored, which shows that there was a checksum.

A service stores the accepted configurations that flew in its state folder: the newest one and two older ones.
Each stored configuration is one file, created by a single rename, whose name contains a number and the
SHA-256 checksum, so that there is never a configuration without its checksum.
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
"""Flight time (ns) after which the configuration is stored."""

_NAME = re.compile(r"(\d{6,})-([0-9a-f]{64})\.yaml")


@dataclass(frozen=True, slots=True)
class KeptConfig:
    """A stored configuration that flew."""

    number: int
    path: Path
    text: str


def kept_configs(folder: Path) -> list[KeptConfig]:
    """Return the undamaged configurations stored in a state folder, newest first. Raises OSError."""
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
        """Prepare to store `text`, the configuration as it was read, in a state folder."""
        self._data = text.encode()
        self._folder = folder
        self._kept = False

    def serve(self, clock: Clock) -> Ticker:
        """Return the ticker that stores the configuration, outside the loop, after `GOOD_START_NS`."""
        return clock.ticker("configuration", GOOD_START_NS, self.keep)

    def keep(self) -> None:
        """Store the configuration unless it is the newest stored one; retry a failed write later."""
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
            # Keep the newest copies of `KEPT` different texts, and delete damaged and older copies.
            texts: dict[str, Path] = {}
            for copy in kept:
                texts.setdefault(copy.text, copy.path)
            staying = set(list(texts.values())[:KEPT])
            for _, path, _ in _named(self._folder):
                if path not in staying:
                    path.unlink(missing_ok=True)
            self._kept = True


def _named(folder: Path) -> list[tuple[int, Path, str]]:
    """Return number, path and checksum of the files that are named like a stored configuration.

    Raises OSError.
    """
    place = folder / FOLDER
    try:
        paths = list(place.iterdir())
    except FileNotFoundError:
        return []
    matches = ((_NAME.fullmatch(path.name), path) for path in paths)
    return [(int(match[1]), path, match[2]) for match, path in matches if match]


_CURE = "if it was edited, accept it by deploy/install.sh --accept, otherwise restore it"
_TRIES = 3
"""Number of attempts to read a file, because a single failed disk access does not mean damage."""


@dataclass(frozen=True, slots=True)
class Chosen:
    """A configuration to fly.

    Attributes:
        path: file from which `text` was read.
        problem: reason why `path` is not the requested file; empty if it is.
        accepted: whether a checksum beside the requested file confirms its bytes.
    """

    path: Path
    text: str
    problem: str = ""
    accepted: bool = False


def sum_file(path: Path) -> Path:
    """Return the path of a configuration's checksum file, as written by sha256sum."""
    return path.parent / f"{path.name}.sha256"  # unlike this, `with_name` would fail on `.`


def accepted_config(path: Path, environment: Mapping[str, str]) -> Chosen:
    """Return the configuration to fly, which is read only once.

    Raises UnreadConfigError, with the cure, if `path` is damaged and no configuration that flew is stored.
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
        except ConfigError:  # the stored configuration flew with another software version
            continue
        return Chosen(
            one.path, one.text, f"{path}: {problem}: the last configuration that flew is flown; {_CURE}"
        )
    if os.path.lexists(sum_file(path)) or folder is not None:
        problem += f", and no configuration that flew is stored; {_CURE}"
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
    """Return a limited number of bytes of any kind of file, for example of a pipe."""
    try:
        with path.open("rb") as file:
            return file.read(4 * LARGEST_FILE + 1)
    except FileNotFoundError:
        return None


def _text(path: Path, data: bytes) -> str:
    """Return the text of a configuration. Raises ConfigError for bytes that are not UTF-8."""
    try:
        return checked_length(data.decode("utf-8"), path)
    except UnicodeDecodeError as error:
        raise ConfigError(str(path), f"cannot be read: {error}") from error


def requested_config(request: RunRequest, text: str | None = None) -> tuple[str, Config]:
    """Return the configuration as text and as values; only the values include the changes of the request.

    If `text`, the content of the file, is None, the file is read. Raises ConfigError for a mistake in the
    file, and UsageError for a mistake in the request.
    """
    text = read_text(request.config_path) if text is None else text
    config = configuration.parse(text, str(request.config_path))
    if request.faults and config.simulation is None:
        raise UsageError("--fault: this configuration flies real devices, in which no fault can be injected")
    if request.faults:
        spoiled = corrupted_text(request, text)
        if spoiled != text:
            text, config = spoiled, configuration.parse(spoiled, str(request.config_path))
    if request.duration is not None:
        if not (np.isfinite(request.duration) and request.duration > 0.0):
            raise UsageError(f"--duration {request.duration}: must be a positive number of seconds")
        config = config.shortened(request.duration)
    return text, config
