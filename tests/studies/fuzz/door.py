"""A door: a reader of a file or a stream, fed with damaged examples of its own kind."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from tests.studies.fuzz.harness import Finding
from tests.studies.fuzz.mutation import Draw, chance, damage, integer

Files = Mapping[str, bytes]
"""Content by name: what stands in a folder, or one stretch of bytes."""


@dataclass(frozen=True, slots=True)
class Door:
    """A reader and what it promises.

    Attributes:
        examples: what it accepts.
        enter: reads; raises one of `refusals`, or returns the outcome's name. Raises Finding for a broken
            promise. The second argument says whether the example was not damaged.
        refusals: its own errors.
        reseal: makes the checksum right again, so that what lies behind it is reached.
    """

    examples: Sequence[Files]
    enter: Callable[[Files, bool], str]
    refusals: tuple[type[Exception], ...] = ()
    reseal: Callable[[str, bytes], bytes] | None = None


class DoorTarget:
    """The target made of a door."""

    def __init__(self, door: Door) -> None:
        self._door = door
        self._fed: Files = {}

    def last(self) -> str:
        """Return the last input."""
        return repr(dict(self._fed))

    def attempt(self, draw: Draw) -> Counter[str]:
        """Feed one example, most of them damaged. Raises Finding."""
        door = self._door
        files = dict(door.examples[integer(draw, 0, len(door.examples) - 1)])
        whole = chance(draw, 0.03)
        resealed = not whole and door.reseal is not None and chance(draw, 0.5)
        for name, data in files.items():
            if not whole and (len(files) == 1 or chance(draw, 0.7)):
                files[name] = _damaged(draw, door, name, data, resealed)
        self._fed = files
        kind = "whole" if whole else "resealed" if resealed else "cut or flipped"
        try:
            outcome = door.enter(files, whole)
        except door.refusals as error:
            if whole:
                raise Finding(f"a good example was refused: {error}") from error
            if not str(error) or "\n" in str(error).strip():
                raise Finding(f"a refusal that is not one line: {str(error)[:200]!r}") from error
            outcome = "refused"
        return Counter([kind, outcome])


def _damaged(draw: Draw, door: Door, name: str, data: bytes, resealed: bool) -> bytes:
    for _ in range(integer(draw, 1, 3)):
        data = damage(draw, data) if chance(draw, 0.7) else _swapped(draw, data)
    return door.reseal(name, data) if resealed and door.reseal is not None else data


def _swapped(draw: Draw, data: bytes) -> bytes:
    """Return text with one of its numbers or words replaced by a hostile one."""
    pieces = data.replace(b",", b" , ").split(b" ")
    at = integer(draw, 0, len(pieces) - 1)
    pieces[at] = _HOSTILE[integer(draw, 0, len(_HOSTILE) - 1)]
    return b" ".join(pieces)


_HOSTILE = (
    b"-1", b"0", b"1e999", b"-1e999", b"NaN", b"Infinity", b"null", b"true", b"{}", b"[]", b'""', b"9" * 5000,
    b"9" * 20, b"-9" * 9, b"[" * 5000, b'{"a":' * 2000, b"\xc2\xb2", b"\xd9\xa3", b"\xff\xfe", b"\0" * 8,
    b"../../etc/passwd", b"/dev/zero", b"0x10", b"1_000", b"\n\n", b"\r\n", b"+5", b"1.5", b"-0",
)  # fmt: skip
