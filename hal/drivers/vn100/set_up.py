"""The dialogue that sets a VN-100 up, as a generator of questions; the caller decides how to wait."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass

from hal.drivers.vn100.ascii import Sentence, build, error_meaning
from hal.drivers.vn100.settings import DEVICE, IMU_RATE_HZ, OUTPUT_SET, Vn100Settings
from hal.interfaces.errors import Refused

# Transient errors, worth another try. All other codes are refusals.
PASSING_ERRORS = frozenset({-1, 0x01, 0x02, 0x03, 0x0A, 0x0B, 0xFF})


@dataclass(frozen=True, slots=True)
class Question:
    """A command and its fields; the first field identifies its answer."""

    command: str
    fields: tuple[object, ...]

    def message(self) -> bytes:
        """Return the bytes for the wire."""
        return build(self.command, *self.fields)

    def text(self) -> str:
        """Return the text for messages."""
        return f"$VN{self.command},{','.join(map(str, self.fields))}"

    def answer(self, sentence: Sentence) -> tuple[str, ...] | None:
        """Return the fields after the first if `sentence` is the answer; numbers may be zero-padded."""
        if sentence.command != self.command or not sentence.fields:
            return None
        return sentence.fields[1:] if _same(str(self.fields[0]), sentence.fields[0], False) else None

    def complaint(self, sentence: Sentence) -> tuple[int, str] | None:
        """Return (code, text) of an error that the unit reports; None for other sentences."""
        error = error_meaning(sentence)
        return None if error is None else (error[0], f"error {error[0]:02X}, {error[1]}")


Dialogue = Generator[Question, tuple[str, ...], None]
"""Yields questions and receives the fields of their answers. Raises Refused when the unit refuses."""


def set_up(settings: Vn100Settings) -> Dialogue:
    """Set the unit up in its volatile memory; its flash is not written."""
    model = yield Question("RRG", (1,))
    if not model or not model[0].startswith("VN-100"):
        raise Refused(DEVICE, f"the unit calls itself {','.join(model)!r}: this line needs a VN-100")
    yield from _write(6, 0)
    # The unit's own hard and soft iron estimation would mistake the coils' field for the unit's.
    yield from _write(44, 0, 1, 5)
    # Boxcar filters of one 40 Hz period (magnetometer, accelerometer, gyro), on both outputs.
    yield from _write(85, 20, 20, 20, 4, 0, 3, 3, 3, 3, 0)
    yield from _switch_off(76)
    yield from _switch_off(77)
    if settings.output == "binary":
        groups = f"{sum(1 << bit for bit in OUTPUT_SET):02X}"
        words = (f"{OUTPUT_SET[bit]:04X}" for bit in sorted(OUTPUT_SET))
        divisor = IMU_RATE_HZ // settings.rate_hz
        yield from _write(75, settings.unit_port, divisor, groups, *words)
    else:
        yield from _switch_off(75)
        # CRC16 on the lines too: XOR of 8 bits misses two flips in one column.
        yield from _write(30, 0, 0, 0, 0, 3, 0, 1)
        yield from _write(7, settings.rate_hz)
        yield from _write(6, 8)
    yield Question("ASY", (1,))


def _write(register: int, *values: object) -> Dialogue:
    echo = yield Question("WRG", (register, *values))
    asked = [str(value) for value in values]
    base16 = 75 <= register <= 77
    if len(echo) != len(asked) or not all(_same(a, b, base16) for a, b in zip(asked, echo, strict=True)):
        wanted, found = ",".join(asked), ",".join(echo)
        raise Refused(DEVICE, f"register {register} was to be {wanted}, the unit answered {found}")


def _switch_off(register: int) -> Dialogue:
    """Switch a binary output off; the remaining fields do not matter then."""
    echo = yield Question("WRG", (register, 0, 20, "01", "0001"))
    if not echo or not _same("0", echo[0], True):
        raise Refused(DEVICE, f"register {register} was to be off, the unit answered {','.join(echo)}")


def _same(asked: str, echoed: str, base16: bool) -> bool:
    if asked == echoed:
        return True
    try:
        return int(asked, 16) == int(echoed, 16) if base16 else float(asked) == float(echoed)
    except ValueError:
        return False
