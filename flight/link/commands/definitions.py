"""The one table of telecommands: CCSDS space packets of type 1, made and read as telemetry is.

`time_ns` of the secondary header is a number that the sender uses once, its UTC say: the very same packet
is obeyed once, so that a datagram which a network brings twice does no harm. States and ranges of arguments
are checked from this table, on the ground and on board; the words of `flight command` are made from it.
"""

from __future__ import annotations

from flight.link.modes import COMMANDABLE, Mode
from flight.link.telemetry.form import Field, Packet
from flight.link.telemetry.packets import Layout, compile_layouts
from flight.link.telemetry.parameters import FIELDS as PARAMETERS
from knightcube.gnc.guidance.one_axis.plant import Q2_LIMIT
from knightcube.gnc.guidance.three_axes.pointing_target import Goal

_MODES = tuple((int(mode), mode.label) for mode in COMMANDABLE if mode is not Mode.SLEW)
_NUMBERS = (
    "inertial: quaternion, ICRS into body; ground: latitude, longitude, rad; object: right ascension, "
    "declination, rad, where it is looked for, NaN: where the camera looks"
)
_GOALS = tuple((int(goal), goal.label) for goal in Goal)


def _command(name: str, apid: int, meaning: str, *fields: Field, hazard: str = "") -> Packet:
    return Packet(name, apid, "at will", meaning, fields, telecommand=True, hazard=hazard)


PING = _command(
    "ping", 0x201, "Answer, and do nothing else", Field("number", "u4", "-", "comes back in the answer")
)
SAFE = _command(
    "safe",
    0x202,
    "Abort: coils to zero, mode safe",
    Field("reason", "S64", "-", "for the log"),
    hazard="ends pointing, slews and braking until the next command",
)
MODE = _command(
    "mode",
    0x203,
    "Change the mode",
    Field("mode", "u1", "-", "what the satellite shall do", states=_MODES),
    hazard="moves the body, or stops moving it",
)
SLEW = _command(
    "slew",
    0x204,
    "Go to an attitude, then hold it",
    Field("q2", "f8", "-", "commanded final q2", valid=(-Q2_LIMIT, Q2_LIMIT)),
    hazard="moves the body",
)
CLEAR = _command(
    "clear",
    0x205,
    "Clear a latched event",
    Field("event", "S32", "-", "its name, as in the log"),
    hazard="what the event barred is used again, as a broken coil",
)
POINT = _command(
    "point",
    0x206,
    "Point a satellite to a goal",
    Field("goal", "u1", "-", "where to point", states=_GOALS),
    Field("numbers", "f8", "-", _NUMBERS, 4),
    Field("roll", "f8", "rad", "about the pointing axis, NaN: free"),
    hazard="moves the body",
)

LOAD_PARAMETERS = _command(
    "load-parameters",
    0x210,
    "Fly another table of parameters, all of them at once",
    Field(
        "replaced",
        "u4",
        "-",
        "CRC-32 of the table that it replaces: another one has come between, if not equal",
    ),
    Field("crc", "u4", "-", "CRC-32 of the values, as big-endian doubles in this order"),
    *PARAMETERS,
    hazard="moves the limits at which the satellite brakes, gives up or warns",
)
DUMP_PARAMETERS = _command("dump-parameters", 0x211, "Report the table of parameters that flies")

COMMANDS: tuple[Packet, ...] = (PING, SAFE, MODE, SLEW, CLEAR, POINT, LOAD_PARAMETERS, DUMP_PARAMETERS)

LAYOUTS: dict[str, Layout] = compile_layouts(COMMANDS)
"""Their bytes, by name."""
