"""Drivers of GPS receivers on serial lines: u-blox receivers (UBX) and receivers that send NMEA 0183.

UBX is the binary protocol of u-blox receivers (u-blox M8 interface description, UBX-13003221, chapter 32). A
UBX frame consists of the bytes B5 62, class, identifier, length (little endian), payload and checksum. The
checksum is an 8-bit Fletcher checksum over all bytes except the first two. One NAV-PVT message contains the
time, position, velocity and accuracies of one epoch. For a u-blox receiver the NMEA protocol is not used,
because NMEA distributes the values of a fix over several sentences, usually rounds the position to 2 m, and
lacks the vertical velocity.

A u-blox receiver loses its configuration at a power loss. The driver therefore requests NAV-PVT messages at
the start, and again whenever no NAV-PVT has arrived for three seconds. Receivers with protocol version 27 or
later (M9, M10, F9) are configured by CFG-VALSET (u-blox F9 interface description, UBX-22008968). Older
receivers (u-blox 7 and 8) are configured by CFG-PRT, CFG-RATE, CFG-MSG and CFG-NAV5. The receiver reports its
version in MON-VER. If the receiver refuses CFG-VALSET (ACK-NAK), the driver uses the older commands, and vice
versa. A CFG-VALSET with a key that the receiver does not have is refused as a whole, so only the keys of the
port in use are sent: UART 1, UART 2 or USB. The receiver reports its port in CFG-PRT; a receiver that does
not answer, such as an M10, has only UART 1. With the default dynamic model ("portable"), a receiver rejects
fixes above 12 km or 310 m/s, so the driver selects the model for the highest altitudes and speeds. No call
blocks. If bytes arrive but nothing can be decoded for ten seconds, the driver listens at other baud rates.
When it finds the receiver, it commands the configured baud rate. If the receiver refuses this rate, the
driver reports the refusal and keeps the receiver's present rate as long as fixes arrive. Consumer receivers
stop working above 18 km or 515 m/s, so that a satellite needs a receiver with firmware without this limit.

A receiver with the driver `nmea` sends sentences by itself, about once a second. The sentence RMC contains
date, time, ground speed and course, and the sentence GGA contains the position with altitude, quality and
number of satellites. A pair of sentences RMC and GGA with the same time gives one reading. NMEA does not
provide a vertical velocity; the driver computes it from the altitudes of two fixes. Until the second fix, the
vertical velocity is reported as zero with a large standard deviation. NMEA does not provide an accuracy; the
driver reports the horizontal dilution of precision times an assumed range error.
"""

from __future__ import annotations

import math
import re
import struct
from calendar import monthrange
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import reduce
from operator import xor

import numpy as np

from hal.interfaces.devices import FloatArray, GpsLink, GpsReading
from hal.interfaces.errors import NotResponding, OutOfRange
from hal.interfaces.wires import SECOND_NS, Clock, SerialPort

SYNC = b"\xb5\x62"
NAV_PVT = 0x01, 0x07
ACK_NAK, ACK_ACK = (0x05, 0x00), (0x05, 0x01)
CFG_PRT, CFG_MSG, CFG_RATE, CFG_VALSET = (0x06, 0x00), (0x06, 0x01), (0x06, 0x08), (0x06, 0x8A)
CFG_NAV5 = 0x06, 0x24
MON_VER = 0x0A, 0x04
VALSET_PROTOCOL = 27.0
"""Lowest u-blox protocol version that supports the command CFG-VALSET."""
NAMES = {CFG_PRT: "CFG-PRT", CFG_MSG: "CFG-MSG", CFG_RATE: "CFG-RATE", CFG_VALSET: "CFG-VALSET"}
NAMES[CFG_NAV5] = "CFG-NAV5"
UART1, UART2, USB = 1, 2, 3
"""Identifiers of the receiver's ports in CFG-PRT."""
BAUD_RATE_KEYS = {UART1: 0x40520001, UART2: 0x40530001}
PORT_KEYS = {
    UART1: (0x10730001, 0x10740001, 0x10740002, 0x20910007),
    UART2: (0x10750001, 0x10760001, 0x10760002, 0x20910008),
    USB: (0x10770001, 0x10780001, 0x10780002, 0x20910009),
}
"""CFG-VALSET keys of each port: input of UBX, output of UBX, output of NMEA, and rate of NAV-PVT."""
RATE_MEASUREMENT, RATE_SOLUTION, RATE_TIME, DYNAMIC_MODEL = 0x30210001, 0x30210002, 0x20210003, 0x20110021
"""Configuration keys of CFG-VALSET; the first hexadecimal digit of a key determines the size of its value."""
AIRBORNE_4G = 8
"""Dynamic model with the highest limits of altitude and speed, for accelerations up to 4 g."""
OVERHEAD = 8
PVT_LENGTH, OLD_PVT_LENGTH = 92, 84
"""Payload lengths (bytes) of NAV-PVT: 92 from protocol version 15 on, 84 from the older u-blox 7."""
_PVT = struct.Struct("<IHBBBBBBIiBBBBiiiiIIiiiiiIIHHIihH")
THREE_DIMENSIONS = 3
"""Value of the NAV-PVT field `fixType` for a three-dimensional fix."""
DATE_AND_TIME = 0b111
"""Bits of the NAV-PVT field `valid` for a valid date and time with known leap seconds (fullyResolved)."""
FIX_OK, INVALID_POSITION = 0b1, 0b1
"""Bit of the NAV-PVT field `flags` for a valid fix, and bit of the field `flags3` for an invalid position."""
UNKNOWN_ACCURACY = 0xFFFF_FFFF
"""Value of an accuracy that the receiver does not know; the value 0 also means unknown."""

Kind = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Pvt:
    """Content of a NAV-PVT message in the units of the receiver.

    Attributes:
        date: UTC year, month, day, hour, minute and second.
        nano: fraction of the second to be added to the date, ns; may be negative.
        valid: validity bits of date and time.
        fix: type of the fix.
        flags: status bits of the fix.
        satellites: number of satellites used in the solution.
        longitude, latitude: geodetic longitude and latitude, 1e-7 deg.
        height: height above the WGS 84 ellipsoid, mm.
        horizontal, vertical: horizontal and vertical accuracy of the position, mm.
        velocity: velocity to the north, to the east and downwards, mm/s.
        speed_accuracy: accuracy of the speed, mm/s.
        flags3: further status bits, of which the lowest one marks an invalid position.
    """

    date: tuple[int, int, int, int, int, int]
    nano: int
    valid: int
    fix: int
    flags: int
    satellites: int
    longitude: int
    latitude: int
    height: int
    horizontal: int
    vertical: int
    velocity: tuple[int, int, int]
    speed_accuracy: int
    flags3: int = 0

    def packed(self, time_of_week_ms: int = 0) -> bytes:
        """Return the payload of the NAV-PVT message."""
        north, east, _ = self.velocity
        ground = round((north * north + east * east) ** 0.5)
        return _PVT.pack(
            time_of_week_ms, *self.date, self.valid,
            30,  # time accuracy, ns
            self.nano, self.fix, self.flags, 0, self.satellites, self.longitude, self.latitude,
            self.height, self.height, self.horizontal, self.vertical, *self.velocity, ground, 0,
            self.speed_accuracy, 0,
            150,  # position dilution of precision, units of 0.01
            self.flags3, 0, 0, 0, 0,
        )  # fmt: skip


def unpack_pvt(payload: bytes) -> Pvt:
    """Return the content of a NAV-PVT payload of 92 bytes, or of 84 bytes from a u-blox 7."""
    old = len(payload) == OLD_PVT_LENGTH
    values = _PVT.unpack(payload.ljust(PVT_LENGTH, b"\0"))
    (_, year, month, day, hour, minute, second, valid, _, nano, fix, flags, _, satellites) = values[:14]
    longitude, latitude, height, _, horizontal, vertical, north, east, down, _, _, accuracy = values[14:26]
    return Pvt(
        (year, month, day, hour, minute, second), nano, valid, fix, flags, satellites, longitude, latitude,
        height, horizontal, vertical, (north, east, down), accuracy, 0 if old else values[28],
    )  # fmt: skip


def checksum(body: bytes) -> bytes:
    """Return the two checksum bytes of a frame body: class, identifier, length and payload."""
    a = b = 0
    for byte in body:
        a = (a + byte) & 0xFF
        b = (b + a) & 0xFF
    return bytes((a, b))


def frame(kind: Kind, payload: bytes = b"") -> bytes:
    """Return a complete UBX frame with the given class, identifier and payload."""
    body = bytes(kind) + len(payload).to_bytes(2, "little") + payload
    return SYNC + body + checksum(body)


LONGEST_FRAME = 8192
"""Maximum payload length (bytes); the longest known messages (NAV-SAT, RXM-RAWX, MON-VER) have 4 kB."""
_NMEA = re.compile(rb"\$([\x20-\x23\x25-\x29\x2b-\x7e]{5,90})\*([0-9A-Fa-f]{2})\r?\n")
_NMEA_TAIL = 100


class UbxParser:
    """Decoder that extracts UBX frames from received bytes, and counts NMEA sentences between them.

    If a candidate frame is invalid, the search continues two bytes after the candidate's start. An incomplete
    candidate with a long payload is discarded if a valid frame begins within it.

    Attributes:
        bytes_received: number of received bytes.
        frames: number of frames with a valid checksum.
        long_frames: number of frames with more than `longest` bytes of payload and a valid checksum.
        bad_checksum: number of frames with a wrong checksum.
        discarded_bytes: number of bytes outside valid frames.
        sentences: number of NMEA sentences with a valid checksum among the discarded bytes.
    """

    def __init__(self, longest: int = 256) -> None:
        """Create a decoder that waits for the end of frames with payloads of at most `longest` bytes.

        While a longer frame is incomplete, valid frames are searched for within its bytes.
        """
        self.bytes_received = 0
        self.frames = 0
        self.long_frames = 0
        self.bad_checksum = 0
        self.discarded_bytes = 0
        self.sentences = 0
        self._longest = longest
        self._buffer = b""
        self._text = b""

    def feed(self, data: bytes) -> list[tuple[Kind, bytes, int]]:
        """Return the frames that `data` completes.

        Each frame is a tuple of kind (class and identifier), payload, and number of bytes after the frame.
        """
        self.bytes_received += len(data)
        buffer, found, position = self._buffer + data, [], 0
        while True:
            start = buffer.find(SYNC, position)
            if start < 0:
                start = len(buffer) - buffer.endswith(SYNC[:1])
            self._discard(buffer[position:start])
            position = start
            if len(buffer) - start < OVERHEAD:
                break
            length = int.from_bytes(buffer[start + 4 : start + 6], "little")
            end = start + OVERHEAD + length
            if length <= LONGEST_FRAME and end > len(buffer):
                inner = self._inner_frame(buffer, start) if length > self._longest else -1
                if inner < 0:
                    break
                self._discard(buffer[start:inner])
                position = inner
                continue
            body = buffer[start + 2 : end - 2]
            if length > LONGEST_FRAME or checksum(body) != buffer[end - 2 : end]:
                self.bad_checksum += length <= LONGEST_FRAME
                self._discard(buffer[start : start + len(SYNC)])
                position = start + len(SYNC)
                continue
            self.frames += 1
            self.long_frames += length > self._longest
            found.append(((body[0], body[1]), body[4:], len(buffer) - end))
            position = end
        self._buffer = buffer[position:]
        return found

    def _inner_frame(self, buffer: bytes, start: int) -> int:
        """Return the offset of the first valid frame after `start`, or -1 if none follows."""
        inner = buffer.find(SYNC, start + len(SYNC))
        while inner >= 0:
            end = inner + OVERHEAD + int.from_bytes(buffer[inner + 4 : inner + 6], "little")
            complete = len(buffer) - inner >= OVERHEAD and end <= len(buffer)
            if complete and checksum(buffer[inner + 2 : end - 2]) == buffer[end - 2 : end]:
                return inner
            inner = buffer.find(SYNC, inner + len(SYNC))
        return -1

    def _discard(self, data: bytes) -> None:
        """Count bytes outside valid frames, and valid NMEA sentences among these bytes."""
        if not data:
            return
        self.discarded_bytes += len(data)
        text, end = self._text + data, 0
        for sentence in _NMEA.finditer(text):
            end = sentence.end()
            self.sentences += reduce(xor, sentence[1], 0) == int(sentence[2], 16)
        self._text = text[end:][-_NMEA_TAIL:]


DEVICE = "gps"
SILENCE_NS = 3 * SECOND_NS
BAUD_RATES = 9600, 38400, 115200, 57600, 230400, 460800
"""Baud rates at which the driver listens; the first two are factory settings."""
UNDECODED_NS = 10 * SECOND_NS
"""Time (ns) after which other baud rates are tried if bytes without a valid frame or sentence arrive."""
_RETURN_NS = SECOND_NS // 2
"""Time (ns) from the command of a new baud rate until the port changes to this rate."""
_RATE_COMMANDS = {CFG_PRT, CFG_VALSET}
"""Commands that set the baud rate, in older and newer receivers."""
_BITS = 10
_SEMI_MAJOR_AXIS, _FLATTENING = 6_378_137.0, 1.0 / 298.257223563  # WGS 84, NGA.STND.0036
_FASTEST = 12_000.0
_HIGHEST = 3e6
EARLIEST_NS = 1_767_225_600 * SECOND_NS
"""UTC (ns since 1970) of the start of 2026; no released software of this project flew earlier."""
ROLLOVER_NS = 1024 * 7 * 86_400 * SECOND_NS
"""Period (ns) after which the ten-bit week number of GPS repeats."""
_PROTOCOL = re.compile(rb"PROTVER[ =](\d+\.\d+)")


class UbloxReceiver:
    """Driver of a u-blox receiver, which implements `hal.interfaces.devices.GpsReceiver`."""

    def __init__(
        self, port: SerialPort, clock: Clock, period_ns: int = SECOND_NS, earliest_ns: int = EARLIEST_NS
    ) -> None:
        """Prepare the driver, which requests a fix every `period_ns` from the receiver on the open `port`.

        Dates before `earliest_ns` (ns since 1970) are moved forward by 1024 weeks. Raises OutOfRange for a
        period outside 0.1 to 60 s.
        """
        if not 0.1 <= period_ns / SECOND_NS <= 60.0:
            raise OutOfRange(DEVICE, "period", period_ns / SECOND_NS, 0.1, 60.0, "s")
        self._port, self._clock, self._period_ns = port, clock, period_ns
        self._earliest_ns = earliest_ns
        self._silence_ns = max(SILENCE_NS, 2 * period_ns)
        self._parser = UbxParser()
        self._requested_ns: int | None = None
        self._is_due = False
        self._uses_valset = False
        self._protocol = 0.0
        self._receiver_port = UART1
        self._refusal = ""
        self._cause = ""
        now_ns = clock.now_ns()
        self._fix_arrival_ns = now_ns
        self._arrivals_ns = {"frame": -1, "sentence": -1}
        self._last_byte_ns = -1
        self._own_rate = port.baud_rate
        self._others = [rate for rate in BAUD_RATES if rate != port.baud_rate]
        self._rate_ns = now_ns  # time of the last change of the baud rate
        self._return_ns: int | None = None  # time at which the port returns to the configured baud rate
        self._found_rate = 0
        self._rate_refusals: set[Kind] = set()  # refused commands for the baud rate
        self._refused = self._out_of_range = self._unresolved = self._no_fix = self._rolled_over = 0

    def poll(self) -> list[GpsReading]:
        """Return the readings since the last call, oldest first. Raises NotResponding if the port is lost."""
        readings = []
        parser = self._parser
        for arrival_ns, data in self._port.receive():
            self._last_byte_ns = arrival_ns
            sentences = parser.sentences
            for kind, payload, behind in parser.feed(data):
                self._arrivals_ns["frame"] = arrival_ns
                sent_ns = arrival_ns - behind * _BITS * SECOND_NS // self._port.baud_rate
                if (reading := self._reading(kind, payload, sent_ns)) is not None:
                    readings.append(reading)
            if parser.sentences > sentences:
                self._arrivals_ns["sentence"] = arrival_ns
        try:
            self._search_rate()
            if self._port.baud_rate == self._own_rate:
                self._set_up()
        except NotResponding:
            # If the port is lost, the next call raises the error again.
            if not readings:
                raise
        return readings

    def link(self) -> GpsLink:
        """Return the counters of the serial line."""
        parser = self._parser
        return GpsLink(
            bytes_received=parser.bytes_received,
            frames=parser.frames,
            long_frames=parser.long_frames,
            bad_checksum=parser.bad_checksum,
            discarded_bytes=parser.discarded_bytes,
            sentences=parser.sentences,
            out_of_range=self._out_of_range,
            unresolved=self._unresolved,
            no_fix=self._no_fix,
            rolled_over=self._rolled_over,
            refused=self._refused,
            refusal=self._refusal,
            protocol=self._protocol,
            condition=self._condition(),
            last_byte_ns=self._last_byte_ns,
        )

    def close(self) -> None:
        """Close the serial port."""
        self._port.close()

    def _condition(self) -> str:
        """Return the reason for a missing fix and the remedy, or an empty text if fixes arrive."""
        since_ns = self._clock.now_ns() - self._silence_ns
        if self._fix_arrival_ns >= since_ns and not self._found_rate:
            return self._cause
        is_configured = self._port.baud_rate == self._own_rate
        decoded_ns = max(since_ns, self._rate_ns) if is_configured else self._clock.now_ns() + 1
        if self._arrivals_ns["frame"] >= decoded_ns:
            return f"UBX frames but no NAV-PVT: {self._refusal or 'the request was not answered'}"
        if self._arrivals_ns["sentence"] >= decoded_ns:
            return (
                "NMEA sentences but no UBX frame: check the wire from the host's TX to the receiver's RX, "
                "and that the receiver is a u-blox 7 or newer"
            )
        if self._last_byte_ns >= since_ns and self._found_rate:
            return self._rate_problem()
        if self._last_byte_ns >= since_ns:
            return (
                f"bytes but neither UBX frames nor NMEA sentences at {self._own_rate} baud: check "
                "`gps.baud_rate` (factory settings: 9600 for u-blox 7 and 8, 38400 for M9, M10 and F9)"
            )
        return "no byte received: check power, the cable, and the port's name"

    def _rate_problem(self) -> str:
        return (
            f"the receiver sends at {self._found_rate} baud and does not change to {self._own_rate} baud: "
            f"set `gps.baud_rate: {self._found_rate}`, and check that it is a u-blox 7 or newer"
        )

    def _reading(self, kind: Kind, payload: bytes, arrival_ns: int) -> GpsReading | None:
        if kind == ACK_NAK and len(payload) >= 2:
            self._take_refusal((payload[0], payload[1]))
        if kind == MON_VER and (version := _PROTOCOL.search(payload)):
            self._protocol = float(version[1])
            self._use_valset(self._protocol >= VALSET_PROTOCOL)
        if kind == CFG_PRT and payload and payload[0] in PORT_KEYS:
            self._is_due = self._is_due or payload[0] != self._receiver_port
            self._receiver_port = payload[0]
        if kind != NAV_PVT or len(payload) not in {PVT_LENGTH, OLD_PVT_LENGTH}:
            return None
        self._fix_arrival_ns = self._clock.now_ns()
        if self._port.baud_rate == self._own_rate:
            self._found_rate = 0
        pvt = unpack_pvt(payload)
        try:
            reading = reading_of(pvt, arrival_ns, self._port.baud_rate, self._earliest_ns, len(payload))
        except OutOfRange as error:
            self._out_of_range += 1
            self._cause = error.message
            return None
        self._rolled_over += reading.rolled_over
        if pvt.valid & DATE_AND_TIME != DATE_AND_TIME:
            self._unresolved += 1
            self._cause = (
                f"the receiver has not yet determined date, time and leap seconds (valid {pvt.valid:#05b})"
            )
        elif not reading.valid:
            self._no_fix += 1
            self._cause = (
                f"the receiver has no valid fix (fixType {pvt.fix}, flags {pvt.flags:#04x}, flags3 "
                f"{pvt.flags3:#06x}, {pvt.satellites} satellites): check the antenna"
            )
        else:
            self._cause = ""
        return reading

    def _take_refusal(self, command: Kind) -> None:
        """Count a refused command, and switch between CFG-VALSET and the older configuration commands."""
        self._refused += 1
        name = NAMES.get(command, f"command {command[0]:02X} {command[1]:02X}")
        if not self._protocol and command in NAMES:
            self._use_valset(command != CFG_VALSET)
        version = f"{self._protocol:g}" if self._protocol else "unknown"
        cure = "versions from 27 on need CFG-VALSET, older versions CFG-PRT and CFG-MSG"
        self._refusal = f"the receiver refused {name} (ACK-NAK, protocol version {version}): {cure}"
        if self._return_ns is not None:
            self._rate_refusals.add(command)
            if self._rate_refusals >= _RATE_COMMANDS:
                self._refusal = self._rate_problem()

    def _use_valset(self, wanted: bool) -> None:
        """Select CFG-VALSET or the older commands, and configure at once after a change to CFG-VALSET.

        While a baud rate change is pending nothing is sent again, because the rate was sent by both kinds of
        commands.
        """
        self._is_due = self._is_due or (wanted > self._uses_valset and self._return_ns is None)
        self._uses_valset = wanted

    def _search_rate(self) -> None:
        """Listen at other baud rates while nothing can be decoded, and command the configured baud rate."""
        now_ns, port = self._clock.now_ns(), self._port
        decoded_ns = max(*self._arrivals_ns.values(), self._rate_ns)
        if self._return_ns is not None:
            if self._is_due:  # the receiver has reported that another of its ports is connected
                self._command_rate(now_ns)
            elif now_ns >= self._return_ns and not (
                self._rate_refusals >= _RATE_COMMANDS
                and now_ns - max(self._fix_arrival_ns, self._return_ns) < self._silence_ns
            ):
                self._return_ns, self._is_due = None, True
                self._change_rate(self._own_rate)
        elif port.baud_rate == self._own_rate:
            if now_ns - decoded_ns >= UNDECODED_NS and self._last_byte_ns > decoded_ns:
                # If the port rejects this baud rate, the next attempt uses another baud rate.
                self._others.append(self._others.pop(0))
                self._change_rate(self._others[-1])
        elif decoded_ns > self._rate_ns:
            self._found_rate = port.baud_rate
            self._command_rate(now_ns)
        elif now_ns - self._rate_ns >= self._silence_ns:
            self._change_rate(self._own_rate)

    def _command_rate(self, now_ns: int) -> None:
        """Command the configured baud rate at the receiver's connected port, and ask which port this is."""
        self._return_ns, self._is_due = now_ns + _RETURN_NS, False
        self._rate_refusals.clear()
        port = self._receiver_port if self._receiver_port in BAUD_RATE_KEYS else UART1
        rate = value_frame({BAUD_RATE_KEYS[port]: self._own_rate})
        # A receiver that has changed its baud rate would send the answer at the new one.
        self._port.send(frame(CFG_PRT) + port_set_up(self._own_rate, port) + rate)

    def _change_rate(self, baud_rate: int) -> None:
        self._port.set_baud_rate(baud_rate)
        self._rate_ns = self._clock.now_ns()

    def _set_up(self) -> None:
        """Configure the receiver to send only NAV-PVT.

        The configuration is repeated as long as no NAV-PVT arrives.
        """
        now_ns = self._clock.now_ns()
        silent = now_ns - max(self._fix_arrival_ns, self._requested_ns or 0) >= self._silence_ns
        # A receiver that sends at the start may still have the settings of an earlier flight.
        if not (silent or self._is_due or self._requested_ns is None):
            return
        self._requested_ns, self._is_due = now_ns, False
        request = b"" if self._protocol else frame(CFG_PRT) + frame(MON_VER)
        made = valset if self._uses_valset else legacy_set_up
        self._port.send(made(self._port.baud_rate, self._period_ns, self._receiver_port) + request)


def legacy_set_up(baud_rate: int, period_ns: int, port: int = UART1) -> bytes:
    """Return the frames that configure u-blox 7 and 8: only UBX on `port`, one NAV-PVT per period (ns)."""
    rate = (period_ns // 1_000_000).to_bytes(2, "little") + b"\x01\x00\x01\x00"  # time system GPS
    model = b"\x01\x00" + bytes((AIRBORNE_4G,)) + bytes(33)  # bit 0 of the mask selects the dynamic model
    message = frame(CFG_MSG, bytes((*NAV_PVT, 1)))  # applies to the port that receives the command
    return port_set_up(baud_rate, port) + frame(CFG_RATE, rate) + message + frame(CFG_NAV5, model)


def port_set_up(baud_rate: int, port: int = UART1) -> bytes:
    """Return the CFG-PRT frame that configures a port with UBX in both directions, without NMEA.

    A UART is configured as 8N1.
    """
    mode = b"\xd0\x08\x00\x00" + baud_rate.to_bytes(4, "little") if port in BAUD_RATE_KEYS else bytes(8)
    return frame(CFG_PRT, bytes((port, 0, 0, 0)) + mode + b"\x01\x00" * 2 + bytes(4))


def valset(baud_rate: int, period_ns: int, port: int = UART1) -> bytes:
    """Return the frames that configure `port` of M9, M10 and F9 in their volatile memory."""
    values = dict(zip(PORT_KEYS[port], (1, 1, 0, 1), strict=True))
    values |= {BAUD_RATE_KEYS[port]: baud_rate} if port in BAUD_RATE_KEYS else {}
    values |= {RATE_MEASUREMENT: period_ns // 1_000_000, RATE_SOLUTION: 1, RATE_TIME: 1}  # time system GPS
    return value_frame(values) + value_frame({DYNAMIC_MODEL: AIRBORNE_4G})


def value_frame(values: dict[int, int]) -> bytes:
    """Return the CFG-VALSET frame that sets values, by key, in the volatile memory."""
    packed = (
        key.to_bytes(4, "little") + value.to_bytes(VALUE_SIZES[key >> 28], "little")
        for key, value in values.items()
    )
    return frame(CFG_VALSET, b"\x00\x01\x00\x00" + b"".join(packed))


VALUE_SIZES = {1: 1, 2: 1, 3: 2, 4: 4}
"""Sizes (bytes) of the values of CFG-VALSET, by the first hexadecimal digit of the key."""


def reading_of(
    pvt: Pvt, arrival_ns: int, baud_rate: int, earliest_ns: int = EARLIEST_NS, length: int = PVT_LENGTH
) -> GpsReading:
    """Return the reading of a message with a payload of `length` bytes, received at `arrival_ns`.

    The earliest possible UTC is `earliest_ns`, ns since 1970. A date in the 1024 weeks before this time is
    moved forward by 1024 weeks. Raises OutOfRange for physically impossible values, and for earlier dates and
    dates more than 1024 weeks after `earliest_ns`.
    """
    _require(
        ("latitude", pvt.latitude * 1e-7, -90.0, 90.0, "deg"),
        ("longitude", pvt.longitude * 1e-7, -180.0, 180.0, "deg"),
        ("height", pvt.height * 1e-3, -1e4, _HIGHEST, "m"),
        ("speed", 1e-3 * math.hypot(*pvt.velocity), 0.0, _FASTEST, "m/s"),
    )
    position, axes = _position(pvt)
    timed = pvt.valid & DATE_AND_TIME == DATE_AND_TIME
    utc_ns, rolled_over = _utc_ns(pvt, earliest_ns) if timed else (0, False)
    accuracies = pvt.horizontal, pvt.vertical
    known = not {0, UNKNOWN_ACCURACY}.intersection(accuracies)
    speed_known = pvt.speed_accuracy not in {0, UNKNOWN_ACCURACY}
    return GpsReading(
        time_ns=arrival_ns - (length + OVERHEAD) * _BITS * SECOND_NS // baud_rate,
        arrival_ns=arrival_ns,
        utc_ns=utc_ns,
        position=position,
        velocity=1e-3 * np.array(pvt.velocity, dtype=float) @ axes,
        sigma=1e-3 * math.hypot(*accuracies) / math.sqrt(3.0) if known else math.nan,
        velocity_sigma=1e-3 * pvt.speed_accuracy / math.sqrt(3.0) if speed_known else math.nan,
        satellites=pvt.satellites,
        valid=timed
        and pvt.fix == THREE_DIMENSIONS
        and bool(pvt.flags & FIX_OK)
        and not pvt.flags3 & INVALID_POSITION,
        rolled_over=rolled_over,
    )


def _require(*limits: tuple[str, float, float, float, str]) -> None:
    """Raise OutOfRange for the first value out of bounds among tuples (name, value, low, high, unit)."""
    for name, value, low, high, unit in limits:
        if not low <= value <= high:
            raise OutOfRange(DEVICE, name, value, low, high, unit)


def _utc_ns(pvt: Pvt, earliest_ns: int) -> tuple[int, bool]:
    """Return UTC (ns since 1970) and whether it was moved by 1024 weeks. Raises OutOfRange."""
    year, month, day, hour, minute, second = pvt.date
    _require(("year", year, 1970, 2200, ""), ("month", month, 1, 12, ""))
    _require(
        ("day", day, 1, monthrange(year, month)[1], ""),
        ("hour", hour, 0, 23, ""),
        ("minute", minute, 0, 59, ""),
        ("second", second, 0, 60, ""),
    )
    # Second 60 is a leap second, which is converted to the first second of the next minute.
    whole = datetime(year, month, day, hour, minute, min(second, 59), tzinfo=UTC).timestamp()
    utc_ns = round(whole) * SECOND_NS + (second > 59) * SECOND_NS + pvt.nano
    if earliest_ns - ROLLOVER_NS <= utc_ns < earliest_ns:
        return utc_ns + ROLLOVER_NS, True
    limits_ns = earliest_ns, earliest_ns + ROLLOVER_NS
    if not limits_ns[0] <= utc_ns < limits_ns[1]:
        first, last = (datetime.fromtimestamp(limit // SECOND_NS, UTC).year for limit in limits_ns)
        raise OutOfRange(DEVICE, "year", year, first, last, "")
    return utc_ns, False


def _position(pvt: Pvt) -> tuple[FloatArray, FloatArray]:
    """Return the ITRS position (3,), m, and the unit vectors north, east and down as rows (3, 3)."""
    longitude, latitude = math.radians(pvt.longitude * 1e-7), math.radians(pvt.latitude * 1e-7)
    co, so, ca, sa = math.cos(longitude), math.sin(longitude), math.cos(latitude), math.sin(latitude)
    squared = _FLATTENING * (2.0 - _FLATTENING)
    across = _SEMI_MAJOR_AXIS / math.sqrt(1.0 - squared * sa * sa)
    height = pvt.height * 1e-3
    out = (across + height) * ca
    position = np.array([out * co, out * so, (across * (1.0 - squared) + height) * sa])
    return position, np.array([[-sa * co, -sa * so, ca], [-so, co, 0.0], [-ca * co, -ca * so, -sa]])


RANGE_ERROR = 3.0
"""Assumed standard deviation (m) of the position for a dilution of precision of 1."""
KNOT = 1852.0 / 3600.0
_LONGEST = 4096
_FIELDS = {"RMC": 10, "GGA": 12}
"""Minimum number of fields of a usable sentence, by sentence name."""
_VERTICAL_SPEED_S = 10.0
"""Longest time (s) between two fixes from which a vertical velocity is computed."""
_VERTICAL_SPEED_SIGMA = 50.0
"""Standard deviation (m/s) of an unknown vertical velocity, in low orbits with eccentricities up to 0.007."""
_NOT_MEASURED = {"", "0", "6", "7", "8"}
"""GGA qualities of a position that was not measured: no fix, extrapolated, manual input, simulator."""
_NO_FIX = "the receiver has no fix: check the antenna and the view of the sky"


class NmeaReceiver:
    """Driver of an NMEA receiver, which implements `hal.interfaces.devices.GpsReceiver`."""

    def __init__(self, port: SerialPort, clock: Clock, earliest_ns: int = EARLIEST_NS) -> None:
        """Read sentences from the open `port`.

        Dates before `earliest_ns` (ns since 1970) are moved forward by 1024 weeks.
        """
        self._port, self._clock, self._earliest_ns = port, clock, earliest_ns
        self._buffer = b""
        self._halves: dict[str, tuple[int, list[str]]] = {}  # by sentence: time (ns) of first byte, fields
        self._height: tuple[float, float] | None = None  # seconds of the day and altitude (m) of the last fix
        self._bytes = self._sentences = self._bad = self._discarded = 0
        self._out_of_range = self._unresolved = self._no_fix = self._rolled_over = 0
        self._last_byte_ns = -1
        self._condition = ""

    def poll(self) -> list[GpsReading]:
        """Return the readings since the last call, oldest first. Raises NotResponding if the port is lost."""
        readings = []
        for arrival_ns, data in self._port.receive():
            self._last_byte_ns = arrival_ns
            self._bytes += len(data)
            self._buffer += data
            taken = 0
            for found in _NMEA.finditer(self._buffer):
                self._discarded += found.start() - taken
                taken = found.end()
                if reduce(xor, found[1]) != int(found[2], 16):
                    self._bad += 1
                    continue
                self._sentences += 1
                behind_ns = (len(self._buffer) - found.start()) * _BITS * SECOND_NS // self._port.baud_rate
                fields = found[1].decode("ascii").split(",")
                readings.append(self._take(fields, arrival_ns, arrival_ns - behind_ns))
            if len(self._buffer) - taken > _LONGEST:  # longer than any sentence
                self._discarded += len(self._buffer) - taken
                taken = len(self._buffer)
            self._buffer = self._buffer[taken:]
        return [reading for reading in readings if reading is not None]

    def link(self) -> GpsLink:
        """Return the counters of the serial line."""
        return GpsLink(
            bytes_received=self._bytes,
            bad_checksum=self._bad,
            discarded_bytes=self._discarded,
            sentences=self._sentences,
            out_of_range=self._out_of_range,
            unresolved=self._unresolved,
            no_fix=self._no_fix,
            rolled_over=self._rolled_over,
            condition=self._condition,
            last_byte_ns=self._last_byte_ns,
        )

    def close(self) -> None:
        """Close the serial line."""
        self._port.close()

    def _take(self, fields: list[str], arrival_ns: int, begun_ns: int) -> GpsReading | None:
        """Return the reading that a sentence completes, or None if the other sentence is missing.

        The first byte of the sentence was sent at `begun_ns`.
        """
        kind = fields[0].removeprefix("P")[2:]  # proprietary sentences, such as PGRMC, begin with P
        if len(fields) < _FIELDS.get(kind, math.inf):
            return None
        other = self._halves.get("GGA" if kind == "RMC" else "RMC")
        self._halves[kind] = begun_ns, fields
        if other is None or other[1][1] != fields[1]:
            return None
        try:
            pvt = self._pvt(self._halves["RMC"][1], self._halves["GGA"][1])
            reading = reading_of(pvt, arrival_ns, self._port.baud_rate, self._earliest_ns)
        except (ValueError, OverflowError, OutOfRange) as error:
            self._out_of_range += 1
            self._condition = f"a sentence is implausible: {error}"
            return None
        self._halves.clear()
        self._unresolved += not pvt.valid
        self._no_fix += not pvt.fix
        self._rolled_over += reading.rolled_over
        self._condition = "" if reading.valid else _NO_FIX
        return replace(reading, time_ns=other[0])

    def _pvt(self, rmc: list[str], gga: list[str]) -> Pvt:
        """Return the content of the sentences RMC and GGA in the units of a NAV-PVT message.

        Raises ValueError or OverflowError for an invalid field.
        """
        clock, date = rmc[1], rmc[9]
        fix = gga[6] not in _NOT_MEASURED and rmc[2] == "A"
        known = len(date) == 6 and len(clock) >= 6
        day, month, year = (int(date[n : n + 2]) for n in (0, 2, 4)) if known else (0, 0, 0)
        hour, minute = (int(clock[n : n + 2]) for n in (0, 2)) if known else (0, 0)
        second = float(clock[4:]) if known else 0.0
        height = float(gga[9] or 0.0) + float(gga[11] or 0.0) if fix else 0.0
        speed, course = float(rmc[7] or 0.0) * KNOT, math.radians(float(rmc[8] or 0.0))
        accuracy = round(1e3 * RANGE_ERROR * float(gga[8] or 0.0)) if fix else 0
        down = self._down(3600.0 * hour + 60.0 * minute + second, height) if fix else None
        unknown = round(1e3 * math.sqrt(3.0) * _VERTICAL_SPEED_SIGMA) if fix else 0
        speed_accuracy = accuracy if down is not None else unknown
        return Pvt(
            date=(2000 + year, month, day, hour, minute, int(second)),
            nano=round(second % 1.0 * SECOND_NS),
            valid=DATE_AND_TIME if known else 0,
            fix=THREE_DIMENSIONS if fix else 0,
            flags=FIX_OK if fix else 0,
            satellites=int(gga[7] or 0),
            longitude=round(1e7 * _degrees(gga[4], gga[5])) if fix else 0,
            latitude=round(1e7 * _degrees(gga[2], gga[3])) if fix else 0,
            height=round(1e3 * height),
            horizontal=round(1.414 * accuracy) or UNKNOWN_ACCURACY,
            vertical=round(1.414 * accuracy) or UNKNOWN_ACCURACY,
            velocity=(
                round(1e3 * speed * math.cos(course)),
                round(1e3 * speed * math.sin(course)),
                round(1e3 * (down or 0.0)),
            ),
            speed_accuracy=speed_accuracy or UNKNOWN_ACCURACY,
        )

    def _down(self, seconds: float, height: float) -> float | None:
        """Return the downward velocity (m/s) from the change of the altitude, or None if it is unknown."""
        before, self._height = self._height, (seconds, height)
        since = math.inf if before is None else (seconds - before[0]) % 86_400.0
        if before is None or not 0.0 < since < _VERTICAL_SPEED_S:
            return None
        return (before[1] - height) / since


def _degrees(text: str, hemisphere: str) -> float:
    """Return an angle (deg) written as degrees and minutes (dddmm.mmmm).

    Raises ValueError or OverflowError for an invalid text.
    """
    whole = int(float(text)) // 100
    return (whole + (float(text) - 100.0 * whole) / 60.0) * (-1.0 if hemisphere in {"S", "W"} else 1.0)
