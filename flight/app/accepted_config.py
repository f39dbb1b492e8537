"""Which configuration flies: the one that was accepted or, where that was damaged since, the last that flew.

`deploy/install.sh` writes the SHA-256 of an accepted configuration beside it. A service's flight holds its
file against that, and keeps a copy of what has flown for a while in its state folder, with a sum of its own:
a bit that flips on the disk makes 1.05e-3 a 1.05e-7, which no reading of the file alone would find. Without
such a sum, as when flying by hand, the file is taken as it stands.
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
"""What has flown for so long is worth flying again."""

_CURE = "was it edited? Then accept it: deploy/install.sh --accept; else put back what was there"


def sum_file(path: Path) -> Path:
    """Return where the checksum of a configuration stands, as sha256sum writes it."""
    return path.parent / f"{path.name}.sha256"  # a folder may be given, and has perhaps no name


def accepted_config(path: Path, environment: Mapping[str, str]) -> tuple[Path, str]:
    """Return the configuration to fly and, where it is not `path`, what is wrong with that.

    Raises ConfigError, with the cure, for a damaged one where none has flown before.
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
        """Take the configuration's text as it was read, and the folder that it is kept in."""
        self._data = text.encode()
        self._path = folder / KEPT
        self._kept = False

    def serve(self, clock: Clock) -> Ticker:
        """Return the ticker that keeps it, beside the loop, after a good start."""
        return clock.ticker("configuration", GOOD_START_NS, self.keep)

    def keep(self) -> None:
        """Write it, unless that very one is kept already; a disk that fails is tried again the next time."""
        if self._kept:
            return
        with suppress(OSError):
            held = LinuxFiles().read(self._path)
            if held != self._data or _problem(self._path) or not sum_file(self._path).exists():
                line = f"{hashlib.sha256(self._data).hexdigest()}  {KEPT}\n"
                # Between the two neither belongs to the other, and nothing is flown from here.
                replace_file(LinuxFiles(), self._path, self._data)
                replace_file(LinuxFiles(), sum_file(self._path), line.encode())
            self._kept = True


def _problem(path: Path) -> str:
    """Return what is wrong with a file by the sum beside it; nothing where there is no sum."""
    try:
        told = LinuxFiles().read(sum_file(path))
        if told is None:
            return ""
        found = hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        return f"cannot be read: {error.strerror}"
    return "" if told.split()[:1] == [found.encode()] else "is not what was accepted (sha256)"
