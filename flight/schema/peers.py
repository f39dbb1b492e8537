"""Whom UDP is open to: the networks that the configuration names, or those around its own address.

The flight takes commands from nobody else, and the service's sandbox (`deploy/board_dropin.py`) lets no other
packet in or out.
"""

from __future__ import annotations

from ipaddress import IPv4Address, IPv4Network

from flight.schema.sections import Commands

_LOOPBACK = IPv4Network("127.0.0.0/8")
_AROUND = 24
"""Bits of the network taken for granted around an address: that of most small networks."""


def peer_networks(commands: Commands) -> tuple[IPv4Network, ...]:
    """Return the networks, none where UDP is not listened to. Raises ValueError, with what would be right."""
    if commands.udp is None:
        return ()
    if commands.peers is not None:
        return tuple(map(IPv4Network, commands.peers))
    host, _, _ = commands.udp.rpartition(":")
    if host == "localhost":
        return (_LOOPBACK,)
    try:
        own = IPv4Address(host)
    except ValueError as error:
        raise ValueError(f"{host} may be anywhere: say who may command in `commands.peers`") from error
    if own.is_unspecified:
        raise ValueError(f"{host} is every network: say who may command in `commands.peers`")
    return (_LOOPBACK,) if own.is_loopback else (IPv4Network((own, _AROUND), strict=False),)
