"""Units of file transfer (CFDP), damaged, repeated, lost, out of order, into both ends of transfers.

Accepted corruption is a file beside the folder of received ones, one that differs from what was sent though
its checksum was right, more transfers open than are allowed, or an error that is not the receiver's own.
"""

from __future__ import annotations

import shutil
import tempfile
import weakref
from collections import Counter
from pathlib import Path

from flight.link.files.store import FileError, Store
from flight.link.files.transfer import CRC32, GROUND, MOST_OPEN, SATELLITE, Entity, Origin
from flight.link.files.units import Metadata, PduError
from tests.studies.fuzz.harness import Finding
from tests.studies.fuzz.mutation import Draw, chance, damage, integer

_CONTENTS = {"elements/a": b"1 25544U\n2 25544\n" * 30, "star/b": bytes(range(256)) * 12, "empty": b""}
_MOST = 1 << 16
_TURNS = 12
_STEP_NS = 3_000_000_000
"""Long enough for timers to run out."""


class Units:
    """The target: two ends, whose units are spoilt between them."""

    def __init__(self) -> None:
        self._place = Path(tempfile.mkdtemp(prefix="knightcube-"))
        weakref.finalize(self, shutil.rmtree, self._place, ignore_errors=True)
        self._files = self._place / "files"
        for name, content in _CONTENTS.items():
            path = self._files / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        self._fed: list[str] = []

    def last(self) -> str:
        """Return the units that were fed last, in hexadecimal."""
        return repr(self._fed)

    def attempt(self, draw: Draw) -> Counter[str]:
        """Send a file each way while units are spoilt. Raises Finding."""
        self._fed.clear()
        for number in (SATELLITE, GROUND):
            shutil.rmtree(self._place / str(number), ignore_errors=True)
        ends = {number: self._end(number) for number in (SATELLITE, GROUND)}
        names = list(_CONTENTS)
        for number, other in ((SATELLITE, GROUND), (GROUND, SATELLITE)):
            name = names[integer(draw, 0, len(names) - 1)]
            ends[number].send(self._files / name, name, other, CRC32, 1, 0, Origin())
        tally: Counter[str] = Counter()
        old: list[bytes] = []
        for turn in range(_TURNS):
            for number, other in ((SATELLITE, GROUND), (GROUND, SATELLITE)):
                for _ in range(8):
                    unit = ends[number].unit(turn * _STEP_NS)
                    if unit is None:
                        break
                    old.append(unit)
                    for one in _spoilt(draw, unit, old):
                        tally[self._feed(ends[other], one, turn * _STEP_NS)] += 1
        for end in ends.values():
            end.close(_TURNS * _STEP_NS)
        self._judge(ends)
        return tally

    def _end(self, number: int) -> Entity:
        return Entity(number, Store(self._place / str(number)), _anything, _MOST, 0)

    def _feed(self, end: Entity, unit: bytes, now_ns: int) -> str:
        self._fed.append(unit.hex())
        try:
            end.take(unit, now_ns)
        except (PduError, FileError) as error:
            if not str(error) or "\n" in str(error):
                raise Finding(f"a refusal that is not one line: {str(error)[:200]!r}") from error
            return "refused"
        return "accepted"

    def _judge(self, ends: dict[int, Entity]) -> None:
        for number, end in ends.items():
            if len(end.transfers()) > 2 * MOST_OPEN:
                raise Finding(f"{len(end.transfers())} transfers are open")
            received = Store(self._place / str(number)).received
            for path in (path for path in received.rglob("*") if path.is_file()):
                name = path.relative_to(received).as_posix()
                if name in _CONTENTS and path.read_bytes() != _CONTENTS[name]:
                    raise Finding(f"{name} came as another file")
                if path.is_symlink() or path.stat().st_size > _MOST:
                    raise Finding(f"{name}: {path.stat().st_size} bytes")
        strays = {path.name for path in self._place.iterdir()} - {"files", str(SATELLITE), str(GROUND)}
        if strays:
            raise Finding(f"files beside the folders: {sorted(strays)}")


def _anything(_: Metadata) -> str:
    return ""


def _spoilt(draw: Draw, unit: bytes, old: list[bytes]) -> list[bytes]:
    """Return what comes in place of a unit: itself, damaged, lost, twice, or an older one."""
    fate = draw.random()
    if fate < 0.4:
        return [unit]
    if fate < 0.7:
        for _ in range(integer(draw, 1, 3)):
            unit = damage(draw, unit)
        return [unit]
    if fate < 0.8:
        return []
    again = old[integer(draw, 0, len(old) - 1)]
    return [unit, again] if chance(draw, 0.5) else [again, unit, unit]
