"""Sends a command by the link and shows what becomes of it; changes the keys of both ends."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from flight.app.run import utc_ns
from flight.link.commands import CommandPacker, Ping
from flight.link.frames import TELECOMMAND_MASK
from flight.link.process import directives
from flight.link.process.commanding import Report, Stage
from flight.link.process.directives import NewKey
from flight.link.security import COMMAND_SPIS, NEXT, Association, Sealer, Vault, new_key
from ground.link.terminal import Terminal
from knightcube.errors import FlightError, UsageError

Show = Callable[[Report], object]


def obeyed(reports: list[Report]) -> bool:
    """Return whether a command with these reports was obeyed, as far as it is known."""
    return bool(reports) and reports[-1].stage in {Stage.STARTED, Stage.COMPLETED}


def command(terminal: Terminal, packet: bytes, spi: int, seconds: float, show: Show) -> list[Report]:
    """Send a command; return its reports, each shown as it comes. Raises FlightError without any."""
    counter = terminal.send(packet, spi)
    return _shown(terminal.follow(counter, spi, seconds), show, seconds)


def change_key(
    terminal: Terminal, vault: Vault, changed: int, spi: int, seconds: float, show: Show
) -> list[Report]:
    """Change the key of SPI `changed` by a command under the key of `spi`.

    The new key is on the ground's disk before it is sent, and takes the old one's place when the satellite
    has it. Where that stayed unknown the next call asks first, by a ping under the new key.
    Raises FlightError without an answer.
    """
    old, name = vault.read(changed), f"{changed}-{NEXT}"
    if old is None:
        raise UsageError(f"both copies of SPI {changed} are lost here too: make new keys")
    following = vault.read(name)
    if following is not None and changed in COMMAND_SPIS:
        reports = _try(terminal, Sealer(vault, name, TELECOMMAND_MASK), changed, seconds)
        if obeyed(reports):
            _promote(vault, changed)
            return reports
        following = vault.read(name)
    if following is None or following.generation != old.generation + 1:
        following = Association(changed, old.generation + 1, 0, new_key())
        vault.write(following, name)
    packet = directives.pack(NewKey(changed, following.generation, following.key), utc_ns())
    reports = command(terminal, packet, spi, seconds, show)
    if obeyed(reports) and changed in COMMAND_SPIS:
        _promote(vault, changed)
    return reports  # a new key of telemetry takes its place with the first frame under it


def _try(terminal: Terminal, sealer: Sealer, spi: int, seconds: float) -> list[Report]:
    counter = terminal.send_by(sealer, CommandPacker().pack(Ping(), utc_ns()))
    return list(terminal.follow(counter, spi, seconds))


def _promote(vault: Vault, spi: int) -> None:
    """Put the next key in the old one's place."""
    with vault.locked():
        following = vault.read(f"{spi}-{NEXT}")
        if following is not None:
            vault.write(following)
            vault.remove(f"{spi}-{NEXT}")


def _shown(reports: Iterator[Report], show: Show, seconds: float) -> list[Report]:
    found = []
    for report in reports:
        show(report)
        found.append(report)
    if not found:
        raise FlightError(f"no answer by the link within {seconds:g} s")
    return found
