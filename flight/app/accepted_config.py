"""Chooses the configuration to fly: the accepted file or, if damaged, the last configuration that flew.

`deploy/install.sh` writes the SHA-256 of an accepted configuration beside the file. A flight verifies its
file against the sum, and a service keeps a copy of a configuration that flew, with its own sum, in its state
folder: a flipped bit on the disk makes 1.05e-3 a 1.05e-7, which validation would not detect. A file without a
sum is not verified.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from flight.loop.state.files import LinuxFiles, replace_file
from flight.loop.state.opening import service_folder
from flight.schema.errors import ConfigError
from hal.interfaces.wires import Clock, Ticker

KEPT = "flown.yaml"
GOOD_START_NS = 10_000_000_000
"""After this flight time a configuration is kept."""

_CURE = "was it edited? Then accept it: deploy/install.sh --accept; else put back what was there"


def sum_file(path: Path) -> Path:
    """Return the path of a configuration's checksum, as written by sha256sum."""
    return path.parent / f"{path.name}.sha256"  # `with_name` would fail on `.`


def accepted_config(path: Path, environment: Mapping[str, str]) -> tuple[Path, str]:
    """Return the configuration to fly and, if another than `path`, the problem of `path`.

    Raises ConfigError, with the cure, when `path` is damaged and no configuration that flew is kept.
    """
    problem = _problem(path)
    if not problem:
        return path, ""
    folder = service_folder(environment)
    kept = folder / KEPT if folder is not None else None
    if kept is None or not sum_file(kept).exists() or _problem(kept):
        raise ConfigError(str(path), f"{problem}, and no copy of one that flew is kept; {_CURE}")
    return kept, f"{path}: {problem}: the last one that flew is flown; {_CURE}"


class FlownConfig:
    """Keeps the configuration of a flight that has started well."""

    def __init__(self, text: str, folder: Path) -> None:
        """Take the configuration's text as read, and the folder to keep the copy in."""
        self._data = text.encode()
        self._path = folder / KEPT
        self._kept = False

    def serve(self, clock: Clock) -> Ticker:
        """Return the ticker that keeps the configuration, outside the loop, after `GOOD_START_NS`."""
        return clock.ticker("configuration", GOOD_START_NS, self.keep)

    def keep(self) -> None:
        """Write the copy, unless the same one is kept already; a failed write is retried next time."""
        if self._kept:
            return
        with suppress(OSError):
            held = LinuxFiles().read(self._path)
            if held != self._data or _problem(self._path) or not sum_file(self._path).exists():
                line = f"{hashlib.sha256(self._data).hexdigest()}  {KEPT}\n"
                # Between the two writes the sum does not match, and the copy would not be flown.
                replace_file(LinuxFiles(), self._path, self._data)
                replace_file(LinuxFiles(), sum_file(self._path), line.encode())
            self._kept = True


def _problem(path: Path) -> str:
    """Verify a file by its sum; return the problem, empty for a valid file or a file without a sum."""
    try:
        expected = LinuxFiles().read(sum_file(path))
        if expected is None:
            return ""
        found = hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        return f"cannot be read: {error.strerror}"
    return "" if expected.split()[:1] == [found.encode()] else "is not what was accepted (sha256)"
