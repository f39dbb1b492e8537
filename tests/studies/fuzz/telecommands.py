"""Damaged and hostile command packets through the codec.

Accepted corruption is: a command from bytes that were never sent and whose CRC, reckoned here, is wrong; one
that no flight can obey. Damage that passes a CRC of 16 bits by chance is counted as a collision.
"""

from __future__ import annotations

from collections import Counter

import numpy as np

from flight.link.commands import (
    ChangeMode,
    Clear,
    Command,
    CommandError,
    CommandPacker,
    DumpParameters,
    LoadParameters,
    Ping,
    Point,
    Slew,
    check,
    unpack,
)
from flight.link.modes import COMMANDABLE, Mode
from flight.link.telemetry.definitions import PARAMETER_FIELDS
from knightcube.gnc.guidance.one_axis.plant import Q2_LIMIT
from knightcube.gnc.guidance.three_axes.pointing_target import Goal, PointingTarget
from tests.studies.fuzz.harness import Finding
from tests.studies.fuzz.logs import ccitt, hostile
from tests.studies.fuzz.mutation import Draw, chance, damage, integer

_MODES = [mode for mode in COMMANDABLE if mode is not Mode.SLEW]


class Telecommands:
    """The target."""

    def __init__(self) -> None:
        draw, packer = np.random.default_rng(20260115), CommandPacker()
        self._commands = [_command(draw) for _ in range(300)]
        self._packets = [packer.pack(c, integer(draw, 0, 2**62)) for c in self._commands]
        self._sent = set(self._packets)
        self._data = b""

    def last(self) -> str:
        """Return the last packet in hexadecimal."""
        return self._data.hex()

    def attempt(self, draw: Draw) -> Counter[str]:
        """Unpack one command."""
        which = integer(draw, 0, len(self._packets) - 1)
        data, fate = self._packets[which], draw.random()
        if fate < 0.05:
            if unpack(data) != self._commands[which]:
                raise Finding("a command that comes out as another")
            return Counter(whole=1)
        if fate < 0.15:
            data = draw.bytes(integer(draw, 0, 300))
        elif fate < 0.5:
            data = hostile(draw, data)
        else:
            for _ in range(integer(draw, 1, 3)):
                data = damage(draw, data)
        self._data = data
        try:
            command = unpack(data)
        except CommandError as error:
            if not str(error) or "\n" in str(error):
                raise Finding(f"a refusal that is not one line: {error}") from error
            return Counter(refused=1)
        return Counter(accepted=1) + self._judge(command, data)

    def _judge(self, command: Command, data: bytes) -> Counter[str]:
        if ccitt(data) != 0:
            raise Finding("a command with a wrong CRC")
        check(command.packet, command.fields)
        if not command.text.isprintable():
            raise Finding(f"a command whose words do not print: {command.text!r}")
        if isinstance(command, Slew) and not -Q2_LIMIT <= command.q2 <= Q2_LIMIT:
            raise Finding(f"a slew to {command.q2}")
        if isinstance(command, ChangeMode) and command.mode not in _MODES:
            raise Finding(f"a change to {command.mode}")
        if isinstance(command, Clear) and not command.event:
            raise Finding("an event without a name")
        if isinstance(command, Point) and not np.all(np.isfinite((0.0, *command.target.numbers))):
            raise Finding(f"a target at {command.target.numbers}")
        return Counter(right_crc=int(data not in self._sent))


def _command(draw: Draw) -> Command:
    mode = _MODES[integer(draw, 0, len(_MODES) - 1)]
    table = tuple(float(draw.uniform(*field.valid)) for field in PARAMETER_FIELDS if field.valid)
    commands: tuple[Command, ...] = (
        Ping(integer(draw, 0, 2**16 - 1)),
        ChangeMode(mode, "by hand" if mode is Mode.SAFE and chance(draw, 0.5) else ""),
        Point(PointingTarget(Goal.GROUND, (float(draw.uniform(-1.5, 1.5)), 0.3))),
        Point(PointingTarget(Goal.NADIR, roll=0.1 if chance(draw, 0.5) else None)),
        Slew(float(draw.uniform(-Q2_LIMIT, Q2_LIMIT))),
        Clear("imu-silent"),
        LoadParameters(integer(draw, 0, 2**32 - 1), table),
        DumpParameters(),
    )
    return commands[integer(draw, 0, len(commands) - 1)]
