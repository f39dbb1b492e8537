"""Compares the logs of two revisions' flights packet by packet, and their command results value by value.

Each log is read with the packet table of the software that wrote it. Packets whose APID the old table lacks
are counted as added and otherwise ignored. Sequence counts are per APID, so these packets do not affect the
others. If a new packet definition only appends fields and has a higher version, the old fields are compared.
All other bytes must be equal, in the same order. Three labels of the RUN packet are not compared: UTC, the
version of the software, and the checksum of the configuration's text, in which a comment may change.

In the command results, these labels and times of the machine are not compared. Keys that only the new result
has are counted as added. Texts that differ are accepted if the table of renamed texts converts the old into
the new text.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from flight.link.telemetry.fields import Field, Packet
from flight.link.telemetry.log import find_segments
from flight.link.telemetry.packets import CRC_BYTES, HEADER_BYTES, Layout, compile_layouts, to_text
from tests.studies.same_bytes.answers import ANSWERS_FILE
from tests.studies.same_bytes.flights import TABLE_FILE
from tests.studies.same_bytes.texts import Texts

STEMS = ("flight", "truth")
LABELS = {"run": ("utc_ns", "software", "config_crc")}
# Keys of command results that are not compared: the labels, and times of the machine.
UNCOMPARED = frozenset(
    {
        *LABELS["run"],
        *("elapsed_s", "execution_s", "max_s", "mean_s", "overruns", "processor_s", "seconds", "solved_s"),
    }
)
_APID_BITS = 0x7FF
Table = Mapping[int, Layout]
_NONE = type("NoSuchValue", (), {"__repr__": lambda _: "missing"})()
_SHORT = 100  # number of displayed characters of a value


@dataclass(frozen=True, slots=True)
class Difference:
    """First position at which two logs or command results differ.

    Attributes:
        log: "flight", "truth" or "answers", or "run" if a run failed.
        packet: name of the packet, of the command, or of the run.
        time: mission time (s) of the old packet, or None without one.
    """

    log: str
    packet: str
    time: float | None
    field: str
    old: str
    new: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """Result of the comparison of one flight, or of one group of command results.

    Attributes:
        compared: number of compared packets and values.
        added: numbers of packets and of keys of command results that only the new side has, by name.
        extended: packets whose new definition has more fields.
        difference: the first difference, or None.
    """

    name: str
    compared: int
    added: dict[str, int]
    extended: int
    difference: Difference | None

    def as_json(self) -> dict[str, Any]:
        """Return the result of the comparison as plain values."""
        return {**asdict(self), "equal": self.difference is None}


def compare(name: str, old: Path, new: Path, texts: Texts) -> Verdict:
    """Compare the command results in two folders, and the logs if the folders contain a flight."""
    logs = compare_logs(name, old, new, texts) if (old / TABLE_FILE).is_file() else None
    answers = compare_answers(name, old, new, texts) if (old / ANSWERS_FILE).is_file() else None
    if logs is None or answers is None:
        return logs or answers or Verdict(name, 0, {}, 0, None)
    return Verdict(
        name,
        logs.compared + answers.compared,
        logs.added | answers.added,
        logs.extended,
        logs.difference or answers.difference,
    )


def compare_answers(name: str, old: Path, new: Path, texts: Texts) -> Verdict:
    """Compare the command results in two folders."""
    first, second = (json.loads((folder / ANSWERS_FILE).read_text(encoding="utf-8")) for folder in (old, new))
    pairs = list(_pairs((), first, second, texts))
    added = Counter(f"key {place[-1]}" for place, a, _ in pairs if a is _NONE)
    compared = [pair for pair in pairs if pair[1] is not _NONE]
    difference = next(
        (
            Difference("answers", place[0], None, ".".join(place[1:]), _short(a), _short(b))
            for place, a, b in compared
            if repr(a) != repr(b)
        ),
        None,
    )
    return Verdict(name, len(compared), dict(added), 0, difference)


def _pairs(
    place: tuple[str, ...], a: Any, b: Any, texts: Texts
) -> Iterator[tuple[tuple[str, ...], Any, Any]]:
    """Yield each key path of two results with the old and the new value; a missing value is _NONE."""
    if isinstance(a, dict) and isinstance(b, dict):
        names = {key: key if key in b else texts.renamed(key) for key in a}
        for key, name in names.items():
            if key not in UNCOMPARED:
                yield from _pairs((*place, key), a[key], b.get(name, _NONE), texts)
        for key in b.keys() - names.values() - UNCOMPARED:
            yield (*place, key), _NONE, b[key]
    elif isinstance(a, list) and isinstance(b, list):
        yield (*place, "length"), len(a), len(b)
        for number, (first, second) in enumerate(zip(a, b, strict=False)):
            yield from _pairs((*place, str(number)), first, second, texts)
    elif isinstance(a, str) and isinstance(b, str) and texts.renamed(a) == b:
        yield place, b, b
    else:
        yield place, a, b


def _short(value: Any) -> str:
    """Return a value as text of at most one line."""
    text = repr(value)
    return text if len(text) <= _SHORT else f"{text[:_SHORT]}..."


def compare_logs(name: str, old: Path, new: Path, texts: Texts) -> Verdict:
    """Compare the logs in two folders."""
    old_table, new_table = read_table(old), read_table(new)
    compared = extended = 0
    added: Counter[str] = Counter()
    difference = None
    for stem in STEMS:
        kept = []
        for packet in split(read_log(new, stem)):
            if _apid(packet) in old_table:
                kept.append(packet)
            else:
                added[_name(packet, new_table)] += 1
        for a, b in zip_longest(split(read_log(old, stem)), kept):
            if a is None or b is None:
                difference = difference or _one_ended(stem, a, b, old_table, new_table)
                break
            compared += 1
            same, longer = _same(a, b, old_table, new_table, texts)
            extended += longer
            if not same and difference is None:
                difference = _explain(stem, a, b, old_table, new_table, texts)
    return Verdict(name, compared, dict(added), extended, difference)


def read_table(folder: Path) -> dict[int, Layout]:
    """Return the layouts of the packet table beside a log, by APID."""
    raw = json.loads((folder / TABLE_FILE).read_text(encoding="utf-8"))
    packets = [Packet(**{**entry, "fields": tuple(Field(**f) for f in entry["fields"])}) for entry in raw]
    return {layout.packet.apid: layout for layout in compile_layouts(packets).values()}


def read_log(folder: Path, stem: str) -> bytes:
    """Return the bytes of all segments of a log."""
    return b"".join(path.read_bytes() for path in find_segments(folder, stem))


def split(data: bytes) -> Iterator[bytes]:
    """Yield the packets of an undamaged log, by the lengths in their headers."""
    position = 0
    while position < len(data):
        header = data[position : position + HEADER_BYTES]
        length = int.from_bytes(header[4:], "big") + HEADER_BYTES + 1
        yield data[position : position + length]
        position += length


def _apid(packet: bytes) -> int:
    return int.from_bytes(packet[:2], "big") & _APID_BITS


def _same(a: bytes, b: bytes, old: Table, new: Table, texts: Texts) -> tuple[bool, bool]:
    """Return whether two packets are equal except for labels, and whether the new one only adds fields."""
    if a == b:
        return True, False
    first, second = old.get(_apid(a)), new.get(_apid(b))
    if first is None or second is None or first.packet.apid != second.packet.apid:
        return False, False
    longer = _extends(first, second)
    if len(a) != first.length or len(b) != second.length or not (longer or len(a) == len(b)):
        return False, False
    return _core(_renamed(a, b, first, texts), first, longer) == _core(b, first, longer), longer


def _renamed(a: bytes, b: bytes, layout: Layout, texts: Texts) -> bytes:
    """Return the old packet with its differing texts in the wording of the new packet."""
    raw = bytearray(a)
    for field in layout.packet.fields:
        begin, size = layout.offsets[field.name], layout.dtype[field.name].itemsize
        place = slice(begin, begin + size)
        if field.kind.startswith("S") and field.count == 1 and a[place] != b[place]:
            text = texts.renamed(to_text(a[place])).encode()
            raw[place] = text[: size - 1].decode("utf-8", "ignore").encode().ljust(size, b"\0")
    return bytes(raw)


def _extends(first: Layout, second: Layout) -> bool:
    """Return whether the second definition is the first one with appended fields and a higher version."""
    shared = second.packet.fields[: len(first.packet.fields)]
    more = len(second.packet.fields) > len(shared) == len(first.packet.fields)
    raised = second.packet.version > first.packet.version
    return more and raised and _kinds(first.packet.fields) == _kinds(shared)


def _kinds(fields: Iterable[Field]) -> list[tuple[str, str, int]]:
    return [(field.name, field.kind, field.count) for field in fields]


def _core(packet: bytes, layout: Layout, longer: bool) -> bytes:
    """Return a packet without checksum and with zeros as labels.

    If `longer`, the packet has new fields at its end. They are omitted, and length and version are zeros too.
    """
    raw = bytearray(packet[: layout.length - CRC_BYTES])
    for label in LABELS.get(layout.packet.name, ()):
        if label in layout.offsets:
            begin = layout.offsets[label]
            raw[begin : begin + layout.dtype[label].itemsize] = bytes(layout.dtype[label].itemsize)
    if longer:
        raw[4 : HEADER_BYTES + 1] = bytes(3)
    return bytes(raw)


def _explain(stem: str, a: bytes, b: bytes, old: Table, new: Table, texts: Texts) -> Difference:
    """Return the first field in which two packets differ."""
    first, second = old.get(_apid(a)), new.get(_apid(b))
    time = _time(a)
    if first is None or second is None or first.packet.name != second.packet.name:
        return Difference(stem, _name(a, old), time, "packet", _name(a, old), _name(b, new))
    name = first.packet.name
    kinds = [_kinds(layout.packet.fields) for layout in (first, second)]
    if kinds[0] != kinds[1] and not _extends(first, second):
        return Difference(stem, name, time, "definition", _brief(kinds[0]), _brief(kinds[1]))
    if len(a) != first.length or len(b) != second.length:
        return Difference(stem, name, time, "length", str(len(a)), str(len(b)))
    one, two = first.array(_renamed(a, b, first, texts))[0], second.array(b)[0]
    labels = LABELS.get(name, ())
    for field in first.offsets:
        if field not in labels and one[field].tobytes() != two[field].tobytes():
            return Difference(stem, name, time, field, *_values(one[field], two[field]))
    return Difference(stem, name, time, "header", a[: HEADER_BYTES + 1].hex(), b[: HEADER_BYTES + 1].hex())


def _one_ended(stem: str, a: bytes | None, b: bytes | None, old: Table, new: Table) -> Difference:
    """Return the difference between two logs of which one ends first."""
    name, time = (_name(a, old), _time(a)) if a is not None else (_name(b or b"", new), _time(b or b""))
    return Difference(
        stem, name, time, "packet", "end of log" if a is None else name, "end of log" if b is None else name
    )


def _name(packet: bytes, table: Table) -> str:
    apid = _apid(packet)
    return table[apid].packet.name if apid in table else f"APID {apid:#x}"


def _time(packet: bytes) -> float:
    return int.from_bytes(packet[HEADER_BYTES + 1 : HEADER_BYTES + 9], "big", signed=True) * 1e-9


def _values(a: Any, b: Any) -> tuple[str, str]:
    """Return two values of a field as text; for arrays, the first elements that differ."""
    if isinstance(a, np.ndarray):
        index = next(i for i in range(len(a)) if a[i].tobytes() != b[i].tobytes())
        return f"[{index}] {a[index].item()!r}", f"[{index}] {b[index].item()!r}"
    if isinstance(a, bytes):
        return repr(to_text(a)), repr(to_text(b))
    return repr(a.item()), repr(b.item())


def _brief(fields: list[tuple[str, str, int]]) -> str:
    return " ".join(name for name, _, _ in fields)
