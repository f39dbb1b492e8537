"""Commands that the link process executes itself: playback, and new keys."""

from __future__ import annotations

from dataclasses import dataclass, field

from flight.link.commands.codec import CommandError
from flight.link.security.sdls import KEY_BYTES
from flight.link.telemetry.form import Field, Packet
from flight.link.telemetry.packets import HEADER_BYTES, Layout, Packer, TelemetryError, compile_layouts, crc16

PLAY = Packet(
    "play",
    0x2A0,
    "at will",
    "Play a stretch of the archive back",
    (
        Field("run", "u4", "-", "number of the run, 0 the newest"),
        Field("begin", "f8", "s", "mission time"),
        Field("end", "f8", "s", "mission time"),
    ),
    telecommand=True,
)
STOP = Packet("stop-playback", 0x2A1, "at will", "End the playback", (), telecommand=True)
NEW_KEY = Packet(
    "new-key",
    0x2A2,
    "at will",
    "Change the key of an SPI; its counter begins at 0 again",
    (
        Field("spi", "u2", "-", "whose key: 1 to 4"),
        Field("generation", "u4", "-", "of the new key, one more than the old one's"),
        Field("key", "u1", "-", "AES-256", KEY_BYTES),
    ),
    telecommand=True,
)

DIRECTIVES: tuple[Packet, ...] = (PLAY, STOP, NEW_KEY)
LAYOUTS: dict[str, Layout] = compile_layouts(DIRECTIVES)
_BY_IDENTIFIER = {layout.identifier: layout for layout in LAYOUTS.values()}


@dataclass(frozen=True, slots=True)
class Play:
    """Play back what run `run` (0: the newest) recorded from `begin` to `end` s of mission time."""

    run: int
    begin: float
    end: float

    def __str__(self) -> str:
        run = f"run {self.run}" if self.run else "the newest run"
        return f"play {run} from {self.begin:g} to {self.end:g} s"


@dataclass(frozen=True, slots=True)
class Stop:
    """End the playback."""

    def __str__(self) -> str:
        return "stop playback"


@dataclass(frozen=True, slots=True)
class NewKey:
    """Change a key."""

    spi: int
    generation: int
    key: bytes = field(repr=False)

    def __str__(self) -> str:
        return f"new key of SPI {self.spi}, generation {self.generation}"


Directive = Play | Stop | NewKey


def name_of(directive: Directive) -> str:
    """Return the name of the packet that carries a directive."""
    match directive:
        case Play():
            return PLAY.name
        case NewKey():
            return NEW_KEY.name
        case Stop():
            return STOP.name


def pack(directive: Directive, utc_ns: int) -> bytes:
    """Return the packet of a directive. Raises CommandError for values that are none."""
    packer = Packer(LAYOUTS)
    try:
        match directive:
            case Play(run, begin, end):
                return packer.pack(PLAY, utc_ns, run=run, begin=begin, end=end)
            case Stop():
                return packer.pack(STOP, utc_ns)
            case NewKey(spi, generation, key):
                return packer.pack(NEW_KEY, utc_ns, spi=spi, generation=generation, key=list(key))
    except TelemetryError as error:
        raise CommandError("these values fit no directive of the link") from error


def unpack(data: bytes) -> Directive | None:
    """Return the directive that `data` is, None for a packet of another kind. Raises CommandError."""
    layout = _BY_IDENTIFIER.get(int.from_bytes(data[:2], "big"))
    if layout is None:
        return None
    if len(data) != layout.length or crc16(data) != 0 or data[HEADER_BYTES] != layout.packet.version:
        raise CommandError(f"its length, CRC or version is not that of {layout.packet.name}")
    (row,) = layout.array(data)
    match layout.packet.name:
        case PLAY.name:
            play = Play(int(row["run"]), float(row["begin"]), float(row["end"]))
            if not play.begin <= play.end:  # NaN compares false
                raise CommandError(f"from {play.begin:g} to {play.end:g} s is no stretch of time")
            return play
        case NEW_KEY.name:
            return NewKey(int(row["spi"]), int(row["generation"]), bytes(row["key"].tolist()))
        case _:
            return Stop()
