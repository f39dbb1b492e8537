"""The packets of a flight by name, in files that go with the console; asked by time.

Hours of a 40 Hz flight do not fit into the memory that a ground computer spares, so the packets lie in a
temporary folder, and only their times stay in memory (8 bytes each).
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import numpy.typing as npt

from flight.link.telemetry.packets import LAYOUTS, Layout, PacketArray
from knightcube.astro.arrays import FloatArray

_FIRST_CAPACITY = 1024


class History:
    """Owns the files. Use as a context manager: leaving removes them."""

    def __init__(self) -> None:
        """Begin empty."""
        self._folder = tempfile.TemporaryDirectory(prefix="knightcube-console-")
        self._tracks = {name: _Track(layout, Path(self._folder.name)) for name, layout in LAYOUTS.items()}

    def __enter__(self) -> Self:
        """Return this history."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Remove the files."""
        self._folder.cleanup()

    def append(self, packets: Mapping[str, PacketArray]) -> None:
        """Keep packets, those of a name in order of arrival."""
        for name, rows in packets.items():
            if len(rows):
                self._tracks[name].append(rows)

    @property
    def span_ns(self) -> tuple[int, int]:
        """The times of the first and the newest packet, ns; (0, 0) without any."""
        times = [track.times for track in self._tracks.values() if len(track.times)]
        first, last = min((t[0] for t in times), default=0), max((t[-1] for t in times), default=0)
        return int(first), int(last)

    def count(self, name: str, until_ns: int) -> int:
        """Return how many packets of a name came until a time."""
        return int(np.searchsorted(self._tracks[name].times, until_ns, side="right"))

    def rows(self, name: str, first: int, stop: int) -> PacketArray:
        """Return the packets `first` to `stop` of a name, counted from 0 in order of arrival."""
        return self._tracks[name].rows(first, stop)

    def series(
        self, name: str, field: str, component: int, span_ns: tuple[int, int], points: int
    ) -> tuple[FloatArray, FloatArray]:
        """Return times (n,) s and values (n,) of a field, or of one component of an array, in a span of time.

        At most `points` values: of more, the least and the greatest of each stretch in their order, so that
        no peak is lost. NaN stands only where a whole stretch has no number.
        """
        first, stop = (self.count(name, time) for time in (span_ns[0] - 1, span_ns[1]))
        rows = self.rows(name, first, stop)
        values = rows[field].astype(float)
        values = values[:, component] if values.ndim > 1 else values
        times = rows["time_ns"].astype(float) * 1e-9
        return (times, values) if len(times) <= points else _extremes(times, values, max(points // 2, 1))


def _extremes(times: FloatArray, values: FloatArray, stretches: int) -> tuple[FloatArray, FloatArray]:
    """Return of each stretch its least and greatest value at their own times, in the order of time."""
    begins = np.linspace(0, len(values), stretches, endpoint=False).astype(np.intp)
    sizes = np.diff(np.append(begins, len(values)))
    table = np.full((stretches, int(sizes.max())), np.nan)
    inside = np.arange(table.shape[1]) < sizes[:, None]
    table[inside] = values
    least = np.argmin(np.where(np.isnan(table), np.inf, table), axis=1)
    greatest = np.argmax(np.where(np.isnan(table), -np.inf, table), axis=1)
    chosen = begins[:, None] + np.sort(np.stack([least, greatest], axis=1), axis=1)
    return times[chosen].ravel(), values[chosen].ravel()


class _Track:
    """The packets of one name: their bytes in a file, their times in memory."""

    def __init__(self, layout: Layout, folder: Path) -> None:
        self._layout = layout
        self._path = folder / f"{layout.packet.name}.packets"
        self._kept: npt.NDArray[np.int64] = np.zeros(_FIRST_CAPACITY, dtype=np.int64)
        self._count = 0

    @property
    def times(self) -> npt.NDArray[np.int64]:
        """Times in ns that never fall: a search needs their order even where a log is damaged."""
        return self._kept[: self._count]

    def append(self, rows: PacketArray) -> None:
        with self._path.open("ab") as file:
            file.write(rows.tobytes())
        stop = self._count + len(rows)
        if stop > len(self._kept):
            grown = np.zeros(max(stop, 2 * len(self._kept)), dtype=np.int64)
            grown[: self._count] = self.times
            self._kept = grown
        times = rows["time_ns"].astype(np.int64)
        times[0] = max(times[0], self._kept[self._count - 1] if self._count else times[0])
        self._kept[self._count : stop] = np.maximum.accumulate(times)
        self._count = stop

    def rows(self, first: int, stop: int) -> PacketArray:
        first, stop = max(first, 0), min(stop, self._count)
        if stop <= first:
            return self._layout.array(b"")
        with self._path.open("rb") as file:
            file.seek(first * self._layout.length)
            return self._layout.array(file.read((stop - first) * self._layout.length))
