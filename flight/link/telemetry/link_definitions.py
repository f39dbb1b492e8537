"""The telemetry of the link process: how the link stands, and what became of each command."""

from __future__ import annotations

from flight.link.telemetry.form import Field, Packet

LINK = Packet(
    "link",
    0x160,
    "1 Hz, of the link process; not in the flight log",
    "Frames that came, by their fate, and the counters of the security associations",
    (
        Field("received", "u4", "-", "frames that came since the link's start"),
        Field("admitted", "u4", "-", "of them let in"),
        Field("refused_crc", "u4", "-", "refused: the CRC is wrong"),
        Field("refused_header", "u4", "-", "refused: no frame of this spacecraft"),
        Field("refused_spi", "u4", "-", "refused: no association of that SPI"),
        Field("refused_lost", "u4", "-", "refused: both copies of the counter of that SPI are lost"),
        Field("refused_mac", "u4", "-", "refused: the MAC is wrong, as of a forgery or of an old key"),
        Field("refused_repeated", "u4", "-", "refused: the counter was used"),
        Field("refused_beyond", "u4", "-", "refused: the counter is 65,536 or more ahead"),
        Field("refused_unstored", "u4", "-", "refused: the counter could not be stored"),
        Field("refused_command", "u4", "-", "let in, but no command; no answer; or refused by the flight"),
        Field("highest", "i8", "-", "highest accepted counter of SPI 1 and 2; -1 none yet, -2 lost", 2),
        Field("generation", "u4", "-", "of the keys of SPI 1 to 4; 0 lost", 4),
        Field("copies", "u1", "-", "good copies of the counters of SPI 1 to 4", 4),
        Field("sent", "u4", "-", "telemetry frames sent since the link's start"),
        Field("thinned", "u4", "-", "live packets left out for want of rate; the archive has them"),
        Field("playing", "u1", "-", "1 while the archive is played back"),
        Field("played_ns", "i8", "ns", "mission time that the playback has reached"),
    ),
)

VERIFICATION = Packet(
    "verification",
    0x161,
    "at each step of a command, of the link process; not in the flight log",
    "What became of a command that came by the link",
    (
        Field("spi", "u2", "-", "of its frame"),
        Field("counter", "i8", "-", "of its frame: with the SPI its identifier"),
        Field("stage", "u1", "-", "1 accepted, 2 refused, 3 started, 4 completed, 5 failed"),
        Field("name", "S16", "-", "name of the command, empty for none"),
        Field("text", "S128", "-", "its values, or the reason"),
    ),
)
