"""Chooses the configuration to fly: the accepted file or, if damaged, the last configuration that flew.

`deploy/install.sh` writes the SHA-256 of an accepted configuration beside the file. A flight reads its file
once, verifies these bytes against the sum and flies them: a flipped bit on the disk makes 1.05e-3 a 1.05e-7,
which validation would not detect. A service keeps the accepted configurations that flew in its state folder
(`kept_configs`). A file without a sum is flown as it stands, unless an accepted configuration is kept: then
there was a sum.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from flight.app.kept_configs import kept_configs
from flight.loop.state.files import LARGEST_FILE, LinuxFiles
from flight.loop.state.opening import service_folder
from flight.schema import reader as configuration
from flight.schema.document import checked_length, no_such_file
from flight.schema.errors import ConfigError, UnreadConfigError

_CURE = "was it edited? Then accept it: deploy/install.sh --accept; else put back what was there"
_TRIES = 3
"""To read: one failed access of a disk is no damage. What lasts longer is waited for by the start."""


@dataclass(frozen=True, slots=True)
class Chosen:
    """A configuration to fly.

    Attributes:
        path: the file that `text` was read from.
        problem: why `path` is not the requested file, empty where it is.
        accepted: whether its bytes are those of a checksum beside the requested file.
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
        except ConfigError:  # it flew with another version of the software
            continue
        return Chosen(one.path, one.text, f"{path}: {problem}: the last one that flew is flown; {_CURE}")
    if os.path.lexists(sum_file(path)) or folder is not None:
        problem += f", and no copy of one that flew is kept; {_CURE}"
    raise UnreadConfigError(str(path), problem)


def _verified(path: Path, read: Callable[[Path], bytes | None]) -> tuple[bytes | None, str, bool]:
    """Return a file's bytes, the problem, empty for none, and whether a sum confirms them."""
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
    """Read a file, again after an error. Raises OSError."""
    for _ in range(_TRIES - 1):
        with suppress(OSError):
            return read(path)
    return read(path)


def _read_any(path: Path) -> bytes | None:
    """Return what any kind of file gives, a bounded number of bytes: by hand one may fly a pipe."""
    try:
        with path.open("rb") as file:
            return file.read(4 * LARGEST_FILE + 1)
    except FileNotFoundError:
        return None


def _text(path: Path, data: bytes) -> str:
    """Return a configuration's text. Raises ConfigError for bytes that are none."""
    try:
        return checked_length(data.decode("utf-8"), path)
    except UnicodeDecodeError as error:
        raise ConfigError(str(path), f"cannot be read: {error}") from error
