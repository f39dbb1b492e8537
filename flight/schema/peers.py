"""Whom the lines of the link are open to: the networks that the configuration names, or those around its own.

The link takes frames from nobody else, and the service's sandbox (`deploy/board_dropin.py`) lets no other
packet in or out.
"""

from __future__ import annotations

from ipaddress import IPv4Address, IPv4Network

from flight.schema.sections import Commands, Link

LOOPBACK = IPv4Network("127.0.0.0/8")
_AROUND = 24
"""Bits of the network taken for granted around an address: that of most small networks."""


def peer_networks(link: Link) -> tuple[IPv4Network, ...]:
    """Return the networks, none without UDP and TCP. Raises ValueError, with what would be right."""
    addresses = [address for address in (link.udp, link.tcp) if address is not None]
    if not addresses:
        return ()
    if link.peers is not None:
        return tuple(map(IPv4Network, link.peers))
    return tuple(dict.fromkeys(_around(address.rpartition(":")[0]) for address in addresses))


def is_loopback(commands: Commands) -> bool:
    """Return whether plain UDP commands, if any, come from this machine alone."""
    host = (commands.udp or "localhost:0").rpartition(":")[0]
    try:
        return host == "localhost" or IPv4Address(host).is_loopback
    except ValueError:
        return False


def _around(host: str) -> IPv4Network:
    if host == "localhost":
        return LOOPBACK
    try:
        own = IPv4Address(host)
    except ValueError as error:
        raise ValueError(f"{host} may be anywhere: say who may connect in `link.peers`") from error
    if own.is_unspecified:
        raise ValueError(f"{host} is every network: say who may connect in `link.peers`")
    return LOOPBACK if own.is_loopback else IPv4Network((own, _AROUND), strict=False)
