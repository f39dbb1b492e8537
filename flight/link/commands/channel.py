"""Command channels: datagrams from a UNIX socket or from UDP, read without waiting.

The queue of a socket is short: a stranger who sends faster than the loop reads would fill it, and a peer's
command would be lost. A classic BPF filter (linux/filter.h) therefore makes the kernel drop datagrams that
do not begin as a command does or that come from no peer. The filter sees a UDP datagram from its UDP header
on, and a UNIX datagram from its first byte on.
"""

from __future__ import annotations

import contextlib
import os
import socket
import stat
import struct
from array import array
from collections.abc import Sequence
from contextlib import suppress
from ipaddress import IPv4Address, IPv4Network
from pathlib import Path
from typing import Any, Protocol

from flight.link.commands.codec import IDENTIFIERS, LONGEST
from knightcube.errors import UsageError

_SO_ATTACH_FILTER = 26
_SOURCE = 0xFFF00000 + 12  # SKF_NET_OFF: the source address of the IPv4 header
_UDP_HEADER_BYTES = 8
_LOAD_WORD, _LOAD_HALF, _AND, _EQUAL, _RETURN = 0x20, 0x28, 0x54, 0x15, 0x06
_DROP, _WHOLE = (_RETURN, 0, 0, 0), (_RETURN, 0, 0, 0xFFFF)

_Instruction = tuple[int, int, int, int]
"""Operation, instructions to skip if the condition is true and if it is false, and operand."""


def _filter_datagrams(
    bound: socket.socket, identifiers: Sequence[int], peers: Sequence[IPv4Network] | None = None
) -> None:
    """Let a socket receive only datagrams that begin with one of `identifiers`, from `peers` if given.

    If the kernel refuses the filter, the socket receives all datagrams, and its reader must check them.
    """
    start = _UDP_HEADER_BYTES if bound.family == socket.AF_INET else 0
    left = len(identifiers)
    program: list[_Instruction] = [(_LOAD_HALF, 0, 0, start)]
    program += [(_EQUAL, left - number, 0, identifier) for number, identifier in enumerate(identifiers)]
    program.append(_DROP)
    for peer in peers or ():
        network = (_EQUAL, 0, 1, int(peer.network_address))
        program += [(_LOAD_WORD, 0, 0, _SOURCE), (_AND, 0, 0, int(peer.netmask)), network, _WHOLE]
    program.append(_WHOLE if peers is None else _DROP)
    code = array("B", b"".join(struct.pack("@HBBI", *instruction) for instruction in program))
    # struct sock_fprog: the number of instructions and a pointer to the first
    with suppress(OSError):
        packed = struct.pack("@HP", len(program), code.buffer_info()[0])
        bound.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, packed)


AT_MOST = 16
"""Maximum number of datagrams read per call, so that a flood does not delay the loop."""

_LOOK_EVERY = 10
"""Polls between two checks that the socket's file exists: one second in flight."""


class Channel(Protocol):
    """Source of datagrams, each with the address for its answer."""

    name: str

    def poll(self) -> list[tuple[bytes, Any]]:
        """Return the received datagrams, oldest first. Never waits, never raises."""

    def news(self) -> str:
        """Return what happened to the channel since the last call, empty when nothing did."""

    def answer(self, data: bytes, sender: Any) -> None:
        """Answer a sender that has an address and listens. Never waits, never raises."""

    def close(self) -> None:
        """Close. Safe to call twice."""


class DatagramChannel:
    """Bound datagram socket. A UNIX socket whose file was removed is bound again."""

    def __init__(
        self,
        name: str,
        bound: socket.socket,
        path: Path | None = None,
        peers: Sequence[IPv4Network] | None = None,
    ) -> None:
        """Use a bound socket; remove `path` at the end, and ignore senders outside `peers` if given."""
        self.name = name
        self._socket = bound
        self._path = path
        self._peers = peers
        self._polls = 0
        self._news = ""
        self._closed = False
        bound.setblocking(False)
        self._file = _identity(path)

    def poll(self) -> list[tuple[bytes, Any]]:
        """Return the received datagrams, oldest first, cut to one byte more than the longest command."""
        self._polls += 1
        if self._path is not None and not self._closed and self._polls % _LOOK_EVERY == 0:
            self._look(self._path)
        found = []
        for _ in range(AT_MOST):
            try:
                data, sender = self._socket.recvfrom(LONGEST + 1)
            except OSError:  # no datagram waits, or ICMP reports that an earlier answer found no listener
                break
            if self._peers is None or any(IPv4Address(sender[0]) in peers for peers in self._peers):
                found.append((data, sender))
        return found

    def news(self) -> str:
        """Return what happened to the channel since the last call, empty when nothing did."""
        news, self._news = self._news, ""
        return news

    def answer(self, data: bytes, sender: Any) -> None:
        """Answer a sender that has an address."""
        if sender:
            with contextlib.suppress(OSError):
                self._socket.sendto(data, sender)

    def close(self) -> None:
        """Close the socket and remove its file, unless another socket has replaced the file."""
        self._socket.close()
        self._closed = True
        if self._path is not None and self._file is not None and _identity(self._path) == self._file:
            with contextlib.suppress(OSError):
                self._path.unlink()

    def _look(self, path: Path) -> None:
        """Bind the socket again if its file was removed or replaced; retry at the next check."""
        if self._file is not None and _identity(path) == self._file:
            return
        try:
            bound = _bound_unix(path)
        except OSError as error:
            if self._file is not None:
                self._news = f"{path} is gone and cannot be bound again: {error.strerror or error}"
            self._file = None
            return
        bound.setblocking(False)
        old, self._socket, self._file = self._socket, bound, _identity(path)
        old.close()
        self._news = f"{path} was gone: bound again"


def open_unix(path: Path) -> DatagramChannel:
    """Bind a UNIX datagram socket that owner and group may write to. Raises UsageError.

    A stale socket file, to which no process listens, is replaced; any other file is left unchanged.
    """
    try:
        bound = _bound_unix(path)
    except OSError as error:
        reason = error.strerror or error
        raise UsageError(f"commands.socket: {path} cannot be listened to: {reason}") from error
    return DatagramChannel("socket", bound, path)


def _bound_unix(path: Path) -> socket.socket:
    """Return a bound socket. Raises OSError."""
    bound = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        with contextlib.suppress(FileNotFoundError):
            if not stat.S_ISSOCK(path.lstat().st_mode):
                raise OSError("something else stands there")
            if _is_served(path):
                raise OSError("another flight listens there")
            path.unlink()
        before = os.umask(0o117)
        try:
            bound.bind(str(path))
        finally:
            os.umask(before)
    except OSError:
        bound.close()
        raise
    _filter_datagrams(bound, IDENTIFIERS)
    return bound


def open_udp(address: str, peers: Sequence[IPv4Network] | None = None) -> DatagramChannel:
    """Bind a UDP socket to HOST:PORT; ignore senders outside `peers` if given. Raises UsageError."""
    host, _, port = address.rpartition(":")
    bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        bound.bind((host, int(port)))
    except (OSError, OverflowError) as error:
        bound.close()
        raise UsageError(f"commands.udp: {address} cannot be listened to: {error}") from error
    _filter_datagrams(bound, IDENTIFIERS, peers)
    return DatagramChannel("udp", bound, peers=peers)


def _identity(path: Path | None) -> tuple[int, int] | None:
    """Return the device and inode of a file, None if it does not exist."""
    try:
        found = os.lstat(path) if path is not None else None
    except OSError:
        return None
    return None if found is None else (found.st_dev, found.st_ino)


def _is_served(path: Path) -> bool:
    """Return whether a process listens to a socket file."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(str(path))
        except OSError:
            return False
        return True
