"""The VN-100 driver: sets the unit up over its own protocol, reads its output, recovers a lost unit."""

from __future__ import annotations

import contextlib

from hal.drivers.vn100.ascii import AsciiLine
from hal.drivers.vn100.codec import BinaryPacket
from hal.drivers.vn100.readings import ReadingConverter
from hal.drivers.vn100.recovery import Recovery
from hal.drivers.vn100.set_up import PASSING_ERRORS, Question, set_up
from hal.drivers.vn100.settings import DEVICE, OUTPUT_SET, Vn100Settings, check
from hal.drivers.vn100.stream import StreamParser
from hal.interfaces.errors import CorruptData, DeviceError, NotResponding, Refused
from hal.interfaces.readings import ImuLink, ImuReading
from hal.interfaces.wires import Clock, SerialPort

__all__ = ["OUTPUT_SET", "Vn100", "Vn100Settings"]

_LONGEST_PACKET = 128  # above any output set that 40 Hz needs; bounds the wait on a false start
_POLL_STEP_NS = 1_000_000


class Vn100:
    """A VN-100 on a serial port; implements `hal.interfaces.devices.InertialUnit`."""

    def __init__(self, port: SerialPort, clock: Clock, settings: Vn100Settings) -> None:
        """Use the port. Raises Refused or OutOfRange for settings beyond the unit or the line."""
        check(settings, port.baud_rate)
        self._unit_error = ""
        self._port = port
        self._clock = clock
        self._settings = settings
        byte_ns = 10e9 / port.baud_rate
        self._parser = StreamParser(byte_ns, _LONGEST_PACKET)
        self._recovery = Recovery(port, settings)
        self._converter = ReadingConverter(settings, byte_ns, self._recovery.reset)
        self._last_byte_ns = -1
        self._last_packet_ns = -1

    def configure(self) -> None:
        """Set the unit up in its volatile memory; its flash is not written.

        Raises NotResponding on silence, CorruptData when the answers make no sense, Refused when the unit
        refuses, is no VN-100, or does not keep what was written.
        """
        if not self._settings.configure:
            return
        # Its output is switched off first, so that answers are not lost in it.
        self._ask(Question("ASY", (0,)))
        dialogue = set_up(self._settings)
        question = next(dialogue)
        with contextlib.suppress(StopIteration):
            while True:
                question = dialogue.send(self._ask(question))

    def model(self) -> str:
        """Return what the unit calls itself; nothing is changed in it. Raises as `configure`."""
        return ",".join(self._ask(Question("RRG", (1,))))

    def poll(self) -> list[ImuReading]:
        """Return the samples since the last call, oldest first. Never blocks.

        A unit that sends none is searched for and set up again, one question per call. Raises NotResponding
        when the line itself is gone. Corrupt and implausible packets are counted in `link`.
        """
        items = self._receive()
        found = (self._converter.reading(item) for item in items)
        readings = [reading for reading in found if reading is not None]
        if self._settings.configure:
            self._converter.check_for_lines(items)
            sentences = [item.sentence for item in items if not isinstance(item, BinaryPacket)]
            parser = self._parser
            self._recovery.advance(
                self._clock.now_ns(), len(readings), sentences, parser.packets, parser.bytes_received
            )
        return readings

    def link(self) -> ImuLink:
        """Return the line's counters; `packets` are all packets and lines whose checksum held."""
        parser = self._parser
        return ImuLink(
            parser.bytes_received,
            parser.packets,
            parser.bad_checksum,
            parser.discarded_bytes,
            self._converter.out_of_range,
            self._converter.not_finite,
            self._last_byte_ns,
            self._last_packet_ns,
        )

    @property
    def resets(self) -> int:
        """How often the unit restarted: its own time went backwards."""
        return self._converter.resets

    @property
    def recoveries(self) -> int:
        """How often a lost unit was found and set up again."""
        return self._recovery.completed

    def close(self) -> None:
        """Release the line."""
        self._port.close()

    def _receive(self) -> list[BinaryPacket | AsciiLine]:
        items: list[BinaryPacket | AsciiLine] = []
        for arrival_ns, data in self._port.receive():
            self._last_byte_ns = arrival_ns
            items += self._parser.feed(arrival_ns, data)
        if items:
            self._last_packet_ns = items[-1].arrival_ns
        return items

    def _ask(self, question: Question) -> tuple[str, ...]:
        """Send a command until its answer comes; return the answer's fields after the first."""
        before = self.link()
        self._unit_error = ""
        for _ in range(self._settings.tries):
            self._port.send(question.message())
            answer = self._await(question)
            if answer is not None:
                return answer
        raise self._no_answer(question.text(), before)

    def _await(self, question: Question) -> tuple[str, ...] | None:
        """Return the answer, or None when the time is up or the try failed."""
        deadline_ns = self._clock.now_ns() + self._settings.response_timeout_ns
        while True:
            for item in self._receive():
                if isinstance(item, BinaryPacket):
                    continue
                answer = question.answer(item.sentence)
                if answer is not None:
                    return answer
                complaint = question.complaint(item.sentence)
                if complaint is not None:
                    code, self._unit_error = complaint
                    if code in PASSING_ERRORS:
                        return None
                    raise Refused(DEVICE, f"{question.text()} was answered with {self._unit_error}")
            now_ns = self._clock.now_ns()
            if now_ns >= deadline_ns:
                return None
            self._clock.sleep_until_ns(min(deadline_ns, now_ns + _POLL_STEP_NS))

    def _no_answer(self, command: str, before: ImuLink) -> DeviceError:
        link = self.link()
        received = link.bytes_received - before.bytes_received
        tried = (
            f"no answer to {command} in {self._settings.tries} tries of "
            f"{self._settings.response_timeout_ns / 1e6:.0f} ms at {self._port.baud_rate} baud"
        )
        if received == 0:
            return NotResponding(
                DEVICE, f"{tried}, not one byte: check power, the cable, the port's name, and the baud rate"
            )
        if self._unit_error:
            return CorruptData(DEVICE, f"{tried} but {self._unit_error}: the line to the unit is noisy")
        if link.packets == before.packets:
            return CorruptData(
                DEVICE, f"{tried}; {received} bytes came, none made sense: check the baud rate (register 5)"
            )
        return NotResponding(
            DEVICE, f"{tried}, though its output arrives: check the wire from the host's TX to the unit's RX"
        )
