"""Random damage to bytes, drawn by hypothesis, for tests of the readers of files and of serial lines.

A test draws a random generator, as in `@given(chances()) def test(chance): offer(chance, ...)`.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from random import Random

from hypothesis import strategies as st

Files = Mapping[str, bytes]
"""Contents of files by name, or the content of a single file under any name."""

_HOSTILE = (
    b"-1", b"0", b"1e999", b"-1e999", b"NaN", b"Infinity", b"null", b"true", b"{}", b"[]", b'""', b"9" * 5000,
    b"9" * 20, b"-9" * 9, b"[" * 5000, b'{"a":' * 2000, b"\xc2\xb2", b"\xd9\xa3", b"\xff\xfe", b"\0" * 8,
    b"../../etc/passwd", b"/dev/zero", b"0x10", b"1_000", b"\n\n", b"\r\n", b"+5", b"1.5", b"-0",
)  # fmt: skip


def chances() -> st.SearchStrategy[Random]:
    """Return a hypothesis strategy for random generators whose draws can be shrunk."""
    return st.randoms(use_true_random=False)


def damage(chance: Random, data: bytes) -> bytes:
    """Return a copy with some bytes flipped, overwritten, lost, doubled, inserted, zeroed or cut off."""
    if not data:
        return chance.randbytes(chance.randint(1, 8))
    start = chance.randrange(len(data))
    stop = min(len(data), start + chance.randint(1, 1 + len(data) // 4))
    kind = chance.randrange(9)
    if kind == 0:
        flipped = bytearray(data)
        for _ in range(chance.randint(1, 4)):
            flipped[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        return bytes(flipped)
    if kind == 1:
        return data[:start]
    if kind == 2:
        pieces = data.replace(b",", b" , ").split(b" ")
        pieces[chance.randrange(len(pieces))] = chance.choice(_HOSTILE)
        return b" ".join(pieces)
    middle = (
        chance.randbytes(min(stop - start, 64)),
        b"",
        data[start:stop] * 2,
        chance.randbytes(chance.randint(1, 40)) + data[start:stop],
        bytes(stop - start),
        b"\xff" * (stop - start),
    )
    return data[:start] + middle[kind - 3] + data[stop:]


def offer(
    chance: Random,
    examples: Sequence[Files],
    read: Callable[[Files, bool], object],
    refusals: tuple[type[Exception], ...] = (),
    reseal: Callable[[bytes], bytes] | None = None,
) -> None:
    """Call a reader with a damaged or undamaged example, and check the result or the refusal.

    Args:
        chance: random generator from `chances`.
        examples: contents that the reader accepts.
        read: function that reads and checks the result; its second argument is true for undamaged data.
        refusals: exceptions by which the reader may refuse a content; an undamaged example must be accepted.
        reseal: function that corrects checksums, so that damaged data pass the checksum test.
    """
    files = dict(chance.choice(examples))
    whole = chance.random() < 0.05
    resealed = not whole and reseal is not None and chance.random() < 0.5
    for name, data in files.items():
        if not whole and (len(files) == 1 or chance.random() < 0.7):
            for _ in range(chance.randint(1, 3)):
                data = damage(chance, data)  # noqa: PLW2901 - damaged several times
            files[name] = reseal(data) if resealed and reseal is not None else data
    try:
        read(files, whole)
    except refusals as error:
        if whole:
            raise AssertionError(f"a whole example was refused: {error}") from error
        assert_one_line(error)


def assert_one_line(error: Exception) -> None:
    """Assert that the message of a refusal is one line."""
    assert str(error)
    assert "\n" not in str(error).strip()


def fill(folder: Path, files: Files) -> Path:
    """Write files into a folder, replace earlier files with the same names, and return the folder."""
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return folder


def line_and_crc(data: bytes) -> bytes:
    """Return the first line of the data, with a corrected checksum."""
    line = data.rpartition(b"\n")[0].partition(b"\n")[0] + b"\n"
    return line + b"%08x\n" % zlib.crc32(line)
