"""Compares the logs of two revisions' flights packet by packet, and their command results value by value.

Each log is read with the packet table of the software that wrote it. Packets whose APID the old table lacks
are counted as added and otherwise ignored. Sequence counts are per APID, so these packets do not affect the
others. If a new packet definition only appends fields and has a higher version, the old fields are compared.
All other bytes must be equal, in the same order. Three labels of the RUN packet are not compared: UTC, the
version of the software, and the checksum of the configuration's text, because comments may change.

In the command results, these labels and times of the machine are not compared. Keys that only the new result
has are counted as added. Texts that differ are accepted if the table of renamed texts converts the old into
the new text (`renamed_texts.yaml`).
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from flight.link.telemetry.definitions import Field, Packet
from flight.link.telemetry.log import find_segments
from flight.link.telemetry.packets import HEADER_BYTES, Layout, compile_layouts, to_text
from knightcube.errors import UsageError
from tests.studies.same_bytes.runs import ANSWERS_FILE, TABLE_FILE

STEMS = ("flight", "truth")
LABELS = {"run": ("utc_ns", "software", "config_crc")}
# Keys of command results that are not compared: the labels, and times of the machine.
UNCOMPARED = frozenset(
    {
        *LABELS["run"],
        *("elapsed_s", "execution_s", "max_s", "mean_s", "overruns", "processor_s", "seconds", "solved_s"),
    }
)
RENAMED = Path(__file__).with_name("renamed_texts.yaml")
_PLACEHOLDER = re.compile(r"\{(\w+)\}")
_APID_BITS = 0x7FF
Table = Mapping[int, Layout]
_NONE = type("NoSuchValue", (), {"__repr__": lambda _: "missing"})()
_SHORT = 100  # number of displayed characters of a value


class Texts:
    """Converter of renamed texts."""

    def __init__(self, pairs: Iterable[Mapping[str, str]] = ()) -> None:
        """Create the table from pairs of `old` and `new`.

        Raises UsageError for a pair with other keys or placeholders.
        """
        self._pairs = [_compiled(pair) for pair in pairs]

    @classmethod
    def read(cls, path: Path = RENAMED) -> Texts:
        """Return the table of a file. Raises UsageError if it is not a list of pairs."""
        pairs = yaml.safe_load(path.read_text(encoding="utf-8"))
        if not isinstance(pairs, list):
            raise UsageError(f"{path}: not a list of pairs of old and new")
        return cls(pairs)

    def renamed(self, text: str) -> str:
        """Convert a text of the old revision to the wording of the new revision."""
        for old, new in self._pairs:
            found = old.fullmatch(text)
            if found is not None:
                words = found.groupdict()
                text = _PLACEHOLDER.sub(lambda place, words=words: words[place[1]], new)  # type: ignore[misc]  # mypy infers no type for a lambda with a default
        return text

    def cut(self, field: bytes) -> bytes:
        """Return the bytes of a text field in the wording of the new revision, cut to the field's size."""
        text = self.renamed(to_text(field)).encode()
        return text[: len(field) - 1].decode("utf-8", "ignore").encode().ljust(len(field), b"\0")


def _compiled(pair: Mapping[str, str]) -> tuple[re.Pattern[str], str]:
    """Return the pattern of the old text, and the new text."""
    if not isinstance(pair, dict) or set(pair) != {"old", "new"}:
        raise UsageError(f"renamed text {pair!r}: a pair has the keys old and new")
    pieces = _PLACEHOLDER.split(pair["old"])  # texts alternate with placeholder names
    if set(_PLACEHOLDER.findall(pair["new"])) - set(pieces[1::2]):
        raise UsageError(f"renamed text {pair['new']!r}: a placeholder is not in the old text")
    pattern = "".join(
        f"(?P<{piece}>.*)" if number % 2 else re.escape(piece) for number, piece in enumerate(pieces)
    )
    return re.compile(pattern, re.DOTALL), pair["new"]


@dataclass(frozen=True, slots=True)
class Difference:
    """First position at which two logs or command results differ.

    Attributes:
        log: "flight", "truth" or "answers", or "run" if a run failed.
        packet: name of the packet, of the command, or of the run.
        time: mission time (s) of the old packet, or None without a packet.
    """

    log: str
    packet: str
    time: float | None
    field: str
    old: str
    new: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """Result of the comparison of one flight, or of the command results of one group.

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
            if a != b:
                found, longer = _difference(stem, a, b, old_table, new_table, texts)
                extended += longer
                difference = difference or found
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


def _difference(
    stem: str, a: bytes, b: bytes, old: Table, new: Table, texts: Texts
) -> tuple[Difference | None, bool]:
    """Return the first difference of two packets or None, and whether the new definition only adds fields."""
    first, second, time = old.get(_apid(a)), new.get(_apid(b)), _time(a)
    if first is None or second is None or _apid(a) != _apid(b):
        return Difference(stem, _name(a, old), time, "packet", _name(a, old), _name(b, new)), False
    longer = _extends(first, second)
    if len(a) != first.length or len(b) != second.length or not (longer or len(a) == len(b)):
        found: tuple[str, str, str] | None = ("length", str(len(a)), str(len(b)))
    else:
        found = _different_field(a, b, first, longer, texts)
    kinds = [_kinds(layout.packet.fields) for layout in (first, second)]
    if found and kinds[0] != kinds[1] and not longer:
        before, after = (" ".join(name for name, _, _ in fields) for fields in kinds)
        found = ("definition", before, after)
    return (Difference(stem, first.packet.name, time, *found) if found else None), longer


def _different_field(
    a: bytes, b: bytes, layout: Layout, longer: bool, texts: Texts
) -> tuple[str, str, str] | None:
    """Return the first field whose value differs, and both values; labels and checksums are not compared.

    If `longer`, the new packet has more fields, and length and version differ too.
    """
    one, two = (np.frombuffer(packet, layout.dtype, 1)[0] for packet in (a, b))
    for name, begin in layout.offsets.items():
        kind = layout.dtype[name]
        before, after = (packet[begin : begin + kind.itemsize] for packet in (a, b))
        if kind.kind == "S" and before != after:
            before = texts.cut(before)
        if before != after and name not in LABELS.get(layout.packet.name, ()):
            return name, *_values(one[name], two[name])
    header = slice(4 if longer else HEADER_BYTES + 1)
    return None if a[header] == b[header] else ("header", a[header].hex(), b[header].hex())


def _extends(first: Layout, second: Layout) -> bool:
    """Return whether the second definition has a higher version and only appends fields to the first."""
    shared = second.packet.fields[: len(first.packet.fields)]
    more = len(second.packet.fields) > len(shared) == len(first.packet.fields)
    raised = second.packet.version > first.packet.version
    return more and raised and _kinds(first.packet.fields) == _kinds(shared)


def _kinds(fields: Iterable[Field]) -> list[tuple[str, str, int]]:
    return [(field.name, field.kind, field.count) for field in fields]


def _one_ended(stem: str, a: bytes | None, b: bytes | None, old: Table, new: Table) -> Difference:
    """Return the difference of two logs if one of them ends before the other."""
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
