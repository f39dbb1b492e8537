"""Sockets of a process that have an address beyond loopback at either end, from Linux's tables in /proc."""

from __future__ import annotations

import os
import socket
import struct
from ipaddress import IPv4Address, IPv6Address
from pathlib import Path

_TABLES = ("tcp", "tcp6", "udp", "udp6")


def beyond_loopback(pid: int) -> set[str]:
    """Return the sockets of a process that reach beyond loopback or can be reached from there."""
    inodes = _sockets_of(pid)
    found = set()
    for table in _TABLES:
        for line in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
            words = line.split()
            if words[9] not in inodes:
                continue
            own, other = (_address(word) for word in words[1:3])
            connected = not other.is_unspecified
            if not own.is_loopback or (connected and not other.is_loopback):
                found.add(f"{table} {own} to {other}")
    return found


def _sockets_of(pid: int) -> set[str]:
    """Return the inodes of a process's sockets."""
    found = set()
    for name in os.listdir(f"/proc/{pid}/fd"):
        try:
            target = os.readlink(f"/proc/{pid}/fd/{name}")
        except OSError:  # the socket has been closed in the meantime
            continue
        if target.startswith("socket:["):
            found.add(target[len("socket:[") : -1])
    return found


def _address(word: str) -> IPv4Address | IPv6Address:
    """Return the address of a table entry: hexadecimal words of 32 bits in the machine's byte order."""
    digits = word.partition(":")[0]
    data = b"".join(struct.pack("=I", int(digits[i : i + 8], 16)) for i in range(0, len(digits), 8))
    if len(data) == 4:
        return IPv4Address(data)
    address = IPv6Address(socket.inet_ntop(socket.AF_INET6, data))
    return address.ipv4_mapped or address
