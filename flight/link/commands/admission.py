"""Has the kernel drop datagrams that are no commands, or not from peers, before they take a place in a queue.

A socket's queue is short. Without a filter a stranger who sends faster than the loop reads fills the queue,
and a peer's command is lost. The filter is classic BPF (linux/filter.h): it sees a UDP datagram from its UDP
header on, and a UNIX datagram from its first byte on.
"""

from __future__ import annotations

import socket
import struct
from array import array
from collections.abc import Sequence
from contextlib import suppress
from ipaddress import IPv4Network

_SO_ATTACH_FILTER = 26
_SOURCE = 0xFFF00000 + 12  # SKF_NET_OFF: the source address of the IPv4 header
_UDP_HEADER_BYTES = 8
_LOAD_WORD, _LOAD_HALF, _AND, _EQUAL, _RETURN = 0x20, 0x28, 0x54, 0x15, 0x06
_DROP, _WHOLE = (_RETURN, 0, 0, 0), (_RETURN, 0, 0, 0xFFFF)

_Instruction = tuple[int, int, int, int]
"""Operation, instructions to skip if it holds and if it does not, operand."""


def admit(
    bound: socket.socket, identifiers: Sequence[int], peers: Sequence[IPv4Network] | None = None
) -> None:
    """Let a socket receive only datagrams that begin with one of `identifiers`, from `peers` where given.

    Where the kernel refuses the filter the socket receives everything, and its reader has to look.
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
