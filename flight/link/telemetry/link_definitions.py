"""The telemetry of the link process: how the link stands, and what became of each command."""

from __future__ import annotations

from flight.link.telemetry.form import Field, Packet, counter
from flight.link.telemetry.states import NO_YES, STAGES

LINK = Packet(
    "link",
    0x170,
    "1 Hz, of the link process; not in the flight log",
    "Frames that came, by their fate, and the counters of the security associations",
    (
        counter("received", "frames that came since the link's start"),
        counter("admitted", "of them let in"),
        counter("refused_crc", "refused: the CRC is wrong"),
        counter("refused_header", "refused: no frame of this spacecraft"),
        counter("refused_spi", "refused: no association of that SPI"),
        counter("refused_lost", "refused: both copies of the counter of that SPI are lost"),
        counter("refused_mac", "refused: the MAC is wrong, as of a forgery or of an old key"),
        counter("refused_repeated", "refused: the counter was used"),
        counter("refused_beyond", "refused: the counter is 65,536 or more ahead"),
        counter("refused_unstored", "refused: the counter could not be stored"),
        counter("refused_command", "let in, but no command; no answer; or refused by the flight"),
        Field("highest", "i8", "-", "highest accepted counter of SPI 1 and 2; -1 none yet, -2 lost", 2),
        Field("generation", "u4", "-", "of the keys of SPI 1 to 4; 0 lost", 4),
        Field("copies", "u1", "-", "good copies of the counters of SPI 1 to 4", 4),
        counter("sent", "telemetry frames sent since the link's start"),
        counter("thinned", "live packets left out for want of rate; the archive has them"),
        Field("playing", "u1", "-", "the archive is played back", states=NO_YES),
        Field("played_ns", "i8", "ns", "mission time that the playback has reached"),
        counter("unreported", "reports of the link whose values did not fit, or that newer ones displaced"),
    ),
    version=2,
)

VERIFICATION = Packet(
    "verification",
    0x171,
    "at each step of a command, of the link process; not in the flight log",
    "What became of a command that came by the link",
    (
        Field("spi", "u2", "-", "of its frame"),
        Field("counter", "i8", "-", "of its frame: with the SPI its identifier; 2^63 - 1 for all beyond"),
        Field("stage", "u1", "-", "how far the command is", states=STAGES),
        Field("name", "S16", "-", "name of the command, empty for none"),
        Field("text", "S128", "-", "its values, or the reason"),
        Field("packet", "u2", "-", "first 16 bits of the command's packet, 0 where it was not read"),
        Field("sequence", "u2", "-", "sequence count of the command's packet"),
    ),
    version=2,
)

TRANSFER = Packet(
    "transfer",
    0x172,
    "1 Hz of each open transfer and at its end, of the link process; not in the flight log",
    "How a file's transfer stands",
    (
        Field("down", "u1", "-", "the satellite sends the file", states=NO_YES),
        Field("source", "u2", "-", "entity that sends: 1 the satellite, 2 the ground, 3 another's ground"),
        Field("number", "u4", "-", "of the transfer there"),
        Field("name", "S96", "-", "of the file, empty while it is not known"),
        Field("size", "u4", "bytes", "of the file"),
        Field("done", "u4", "bytes", "sent and not asked for again; or received"),
        Field("open", "u1", "-", "the transfer goes on", states=NO_YES),
        Field("condition", "u1", "-", "why it ended, CCSDS 727.0-B condition code; 0 whole, or open"),
        Field("text", "S64", "-", "how it ended"),
    ),
)
