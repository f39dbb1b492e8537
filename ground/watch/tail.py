"""Follows the flight log of a run's folder: the packets that came since the last look."""

from __future__ import annotations

import time
from pathlib import Path

from flight.link.telemetry.log import find_segments
from flight.link.telemetry.packets import PacketArray
from ground.telemetry import scan
from knightcube.errors import UsageError

_STEM = "flight"


class LogTail:
    """Reads a log that may still grow, segment by segment; a packet cut short waits for its end."""

    def __init__(self, folder: Path) -> None:
        """Begin at the log's oldest segment. Raises UsageError for a folder without a flight log."""
        if not folder.is_dir():
            raise UsageError(f"{folder}: no such folder; give the folder of a run, or a flight's socket")
        segments = find_segments(folder, _STEM)
        if not segments:
            raise UsageError(f"{folder}: no flight log ({_STEM}-0001.ccsds) in this folder")
        self._folder = folder
        self._path = segments[0]
        self._offset = 0
        self._rest = b""
        self._grew = time.monotonic() - _age(segments[-1])

    @property
    def silence(self) -> float:
        """How long the log has not grown, s; of a log that is looked at first, by its file's time."""
        return time.monotonic() - self._grew

    def new(self) -> dict[str, PacketArray]:
        """Return the packets by name that came since the last call. Raises UsageError."""
        data = self._rest + self._read()
        while (following := self._following()) is not None:
            # The segment is finished: its last packets may have come since it was read.
            data += self._read()
            self._path, self._offset = following, 0
            data += self._read()
        found = scan(data)
        self._rest = data[len(data) - found.truncated_bytes :] if found.truncated_bytes else b""
        return found.packets

    def _read(self) -> bytes:
        try:
            with self._path.open("rb") as file:
                file.seek(self._offset)
                data = file.read()
        except FileNotFoundError:  # dropped to keep the log's budget
            data = b""
        except OSError as error:
            raise UsageError(f"{self._path}: cannot be read: {error.strerror or error}") from error
        if data and self._offset:
            self._grew = time.monotonic()
        self._offset += len(data)
        return data

    def _following(self) -> Path | None:
        """Return the next segment, None while this one is the last."""
        later = (path for path in find_segments(self._folder, _STEM) if _number(path) > _number(self._path))
        return next(later, None)


def _number(path: Path) -> int:
    return int(path.stem.rpartition("-")[2])


def _age(path: Path) -> float:
    """Return how long ago a file was written, s; 0 for one of the future or one that has gone."""
    try:
        return max(0.0, time.time() - path.stat().st_mtime)
    except OSError:
        return 0.0
