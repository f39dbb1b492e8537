"""Binary packets of the VN-100: field tables, layouts, checksum.

A packet is `FA | group byte | one u16 LE word of field bits per group | payload LE | CRC16 big-endian`
(VectorNav UM001 v2.43 section 4.3). The CRC is CRC-16/XMODEM over the bytes between the FA and itself. Units
are the unit's own: gauss, degrees, m/s^2, rad/s, ns.
"""

from __future__ import annotations

import struct
from binascii import crc_hqx
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache

SYNC = 0xFA

# (name, struct code) by bit. No VN-100 has groups 4 and 7 (GNSS); their sizes are not listed.
_COMMON = (
    ("time_startup", "Q"), ("time_gps", "Q"), ("time_sync_in", "Q"), ("yaw_pitch_roll", "3f"),
    ("quaternion", "4f"), ("angular_rate", "3f"), ("position", "3d"), ("velocity", "3f"),
    ("accel", "3f"), ("imu", "6f"), ("mag_pres", "5f"), ("delta_theta_vel", "7f"),
    ("status", "H"), ("sync_in_count", "I"), ("time_gps_pps", "Q"),
)  # fmt: skip
_TIME = (
    ("time_startup", "Q"), ("time_gps", "Q"), ("gps_tow", "Q"), ("gps_week", "H"), ("time_sync_in", "Q"),
    ("time_gps_pps", "Q"), ("time_utc", "8s"), ("sync_in_count", "I"), ("sync_out_count", "I"),
    ("time_status", "B"),
)  # fmt: skip
_IMU = (
    ("imu_status", "H"), ("uncomp_mag", "3f"), ("uncomp_accel", "3f"), ("uncomp_gyro", "3f"), ("temp", "f"),
    ("pres", "f"), ("delta_theta", "4f"), ("delta_vel", "3f"), ("mag", "3f"), ("accel", "3f"),
    ("angular_rate", "3f"), ("sens_sat", "H"),
)  # fmt: skip
_ATTITUDE = (
    ("vpe_status", "H"), ("yaw_pitch_roll", "3f"), ("quaternion", "4f"), ("dcm", "9f"), ("mag_ned", "3f"),
    ("accel_ned", "3f"), ("linear_accel_body", "3f"), ("linear_accel_ned", "3f"), ("ypr_uncertainty", "3f"),
    ("reserved_9", "12s"), ("reserved_10", "28s"), ("reserved_11", "24s"), ("heave", "3f"),
    ("attitude_uncertainty", "f"),
)  # fmt: skip
_INS = (
    ("ins_status", "H"), ("position_lla", "3d"), ("position_ecef", "3d"), ("velocity_body", "3f"),
    ("velocity_ned", "3f"), ("velocity_ecef", "3f"), ("mag_ecef", "3f"), ("accel_ecef", "3f"),
    ("linear_accel_ecef", "3f"), ("position_uncertainty", "f"), ("velocity_uncertainty", "f"),
    ("reserved_11", "68s"), ("reserved_12", "64s"),
)  # fmt: skip

# By the group's bit in the group byte.
FIELDS: Mapping[int, tuple[tuple[str, str], ...]] = {0: _COMMON, 1: _TIME, 2: _IMU, 4: _ATTITUDE, 5: _INS}
GROUP_NAMES: Mapping[int, str] = {0: "common", 1: "time", 2: "imu", 4: "attitude", 5: "ins"}

Value = float | bytes


@dataclass(frozen=True, slots=True)
class Layout:
    """Layout of the packets of one output set.

    Attributes:
        header: the bytes after the sync byte: group byte and field words.
        fields: ((group bit, field bit), ...) in the order of the payload.
        places: field as "group.name" -> slice of the unpacked values.
        payload: the payload's struct.
        length: bytes of the whole packet, from sync to checksum.
    """

    header: bytes
    fields: tuple[tuple[int, int], ...]
    places: Mapping[str, slice]
    payload: struct.Struct
    length: int

    def pack(self, values: Iterable[Value]) -> bytes:
        """Return the packet with the payload `values`, flat, in the order of the fields."""
        body = self.header + self.payload.pack(*values)
        return b"".join((b"\xfa", body, crc16(body).to_bytes(2, "big")))


@dataclass(frozen=True, slots=True)
class BinaryPacket:
    """A packet with a valid checksum.

    `arrival_ns` is the host's time of its last byte; `values` is the payload, flat.
    """

    arrival_ns: int
    layout: Layout
    values: tuple[Value, ...]

    def __getitem__(self, field: str) -> tuple[Value, ...]:
        """Return the values of a field named "group.name"; raises KeyError without one."""
        return self.values[self.layout.places[field]]


def crc16(data: bytes) -> int:
    """Return CRC-16/XMODEM of `data`: polynomial 0x1021, start 0, check value 0x31C3 of "123456789"."""
    return crc_hqx(data, 0)


def layout_of(words: Mapping[int, int]) -> Layout:
    """Return the layout of field words by group bit, {0: 0x0131, 2: 0x0100}.

    Raises ValueError for a group or a field that is not in the tables.
    """
    groups = sum(1 << bit for bit in words)
    header = struct.pack(f"<B{len(words)}H", groups, *(words[bit] for bit in sorted(words)))
    layout = layout_of_header(header)
    if layout is None:
        raise ValueError(f"no VN-100 output set has the field words {dict(words)}")
    return layout


def header_length(group_byte: int) -> int:
    """Return the length of group byte and field words; 0 when no known unit sends this group byte."""
    if group_byte == 0 or any(group_byte >> bit & 1 and bit not in FIELDS for bit in range(8)):
        return 0
    return 1 + 2 * group_byte.bit_count()


@lru_cache(maxsize=256)
def layout_of_header(header: bytes) -> Layout | None:
    """Return the layout of `header` (group byte and its field words); None when there is none."""
    if not header:
        return None
    bits = [bit for bit in range(8) if header[0] >> bit & 1]
    words = struct.unpack(f"<{len(bits)}H", header[1:])
    fields: list[tuple[int, int]] = []
    places: dict[str, slice] = {}
    codes = "<"
    start = 0
    for group, word in zip(bits, words, strict=True):
        table = FIELDS.get(group)
        if table is None or word == 0 or word >> len(table):
            return None
        for bit, (name, code) in enumerate(table):
            if word >> bit & 1:
                count = len(struct.unpack(f"<{code}", bytes(struct.calcsize(f"<{code}"))))
                fields.append((group, bit))
                places[f"{GROUP_NAMES[group]}.{name}"] = slice(start, start + count)
                start += count
                codes += code
    payload = struct.Struct(codes)
    return Layout(header, tuple(fields), places, payload, 1 + len(header) + payload.size + 2)


HEADER_LENGTHS: tuple[int, ...] = tuple(header_length(byte) for byte in range(256))
