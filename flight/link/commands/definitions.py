"""The one table of telecommands: CCSDS space packets of type 1, made and read as telemetry is.

`time_ns` of the secondary header is a number that the sender uses once, its UTC say: the very same packet is
obeyed once, so that a datagram which a network brings twice does no harm.
"""

from __future__ import annotations

from flight.link.telemetry.form import Field, Packet
from flight.link.telemetry.packets import Layout, compile_layouts


def _command(name: str, apid: int, meaning: str, *fields: Field) -> Packet:
    return Packet(name, apid, "at will", meaning, fields, telecommand=True)


PING = _command(
    "ping", 0x201, "Answer, and do nothing else", Field("number", "u4", "-", "comes back in the answer")
)
SAFE = _command("safe", 0x202, "Abort: coils to zero, mode safe", Field("reason", "S64", "-", "for the log"))
MODE = _command("mode", 0x203, "Change the mode", Field("mode", "u1", "-", "as in the telemetry packet mode"))
SLEW = _command(
    "slew", 0x204, "Go to an attitude, then hold it", Field("q2", "f8", "-", "commanded final q2, +-0.68")
)
CLEAR = _command("clear", 0x205, "Clear a latched event", Field("event", "S32", "-", "name of the event"))
POINT = _command(
    "point",
    0x206,
    "Point a satellite to a goal",
    Field("goal", "u1", "-", "0 nadir, 1 velocity, 2 sun, 3 inertial, 4 ground"),
    Field("numbers", "f8", "-", "inertial: quaternion, ICRS into body; ground: latitude, longitude, rad", 4),
    Field("roll", "f8", "rad", "about the pointing axis, NaN: free"),
)

COMMANDS: tuple[Packet, ...] = (PING, SAFE, MODE, SLEW, CLEAR, POINT)

LAYOUTS: dict[str, Layout] = compile_layouts(COMMANDS)
"""Their bytes, by name."""
