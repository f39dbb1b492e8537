"""Keeps the accepted configurations that flew, the newest and two older ones, in a service's state folder.

Each is one file whose name holds its number and its SHA-256, put in place by one rename: there is no moment
at which a configuration stands without its sum.
"""

from __future__ import annotations

import hashlib
import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from flight.loop.state.files import LinuxFiles, replace_file
from hal.interfaces.wires import Clock, Ticker

FOLDER = "flown"
KEPT = 3
GOOD_START_NS = 10_000_000_000
"""After this flight time a configuration is kept."""

_NAME = re.compile(r"(\d{6,})-([0-9a-f]{64})\.yaml")


@dataclass(frozen=True, slots=True)
class Kept:
    """A configuration that flew."""

    number: int
    path: Path
    text: str


def kept_configs(folder: Path) -> list[Kept]:
    """Return the whole configurations kept in a state folder, the newest first. Raises OSError."""
    found = []
    for number, path, digest in _named(folder):
        with suppress(OSError, UnicodeDecodeError):
            data = LinuxFiles().read(path)
            if data is not None and hashlib.sha256(data).hexdigest() == digest:
                found.append(Kept(number, path, data.decode("utf-8")))
    return sorted(found, key=lambda kept: kept.number, reverse=True)


class FlownConfig:
    """Keeps the configuration of a flight that has started well."""

    def __init__(self, text: str, folder: Path) -> None:
        """Take the configuration's text as read, and the state folder."""
        self._data = text.encode()
        self._folder = folder
        self._kept = False

    def serve(self, clock: Clock) -> Ticker:
        """Return the ticker that keeps the configuration, outside the loop, after `GOOD_START_NS`."""
        return clock.ticker("configuration", GOOD_START_NS, self.keep)

    def keep(self) -> None:
        """Write the copy, unless it is the newest already; a failed write is retried next time."""
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
            self._drop_others(kept)
            self._kept = True

    def _drop_others(self, kept: list[Kept]) -> None:
        """Remove damaged copies, and all but the newest of each text; the newest `KEPT` texts stay."""
        texts: dict[str, Path] = {}
        for one in kept:
            texts.setdefault(one.text, one.path)
        staying = set(list(texts.values())[:KEPT])
        for _, path, _ in _named(self._folder):
            if path not in staying:
                path.unlink(missing_ok=True)


def _named(folder: Path) -> list[tuple[int, Path, str]]:
    """Return number, path and digest of whatever has the name of a kept configuration. Raises OSError."""
    place = folder / FOLDER
    try:
        paths = list(place.iterdir())
    except FileNotFoundError:
        return []
    matches = ((_NAME.fullmatch(path.name), path) for path in paths)
    return [(int(match[1]), path, match[2]) for match, path in matches if match]
