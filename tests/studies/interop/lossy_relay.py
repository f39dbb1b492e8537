"""A relay of datagrams that loses some of them in both directions at random, with a fixed seed."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

_LONGEST = 4096
_BUFFER = 1 << 22
_LOOK_S = 0.2


@contextmanager
def lossy_relay(to: str, loss: float, seed: int) -> Iterator[str]:
    """Relay datagrams between the yielded address and `to` (HOST:PORT of loopback)."""
    host, _, port = to.partition(":")
    near, far = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    for line in (near, far):
        line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        line.bind(("127.0.0.1", 0))
        line.settimeout(_LOOK_S)
    far.connect((host, int(port)))
    ended, peer = threading.Event(), list[tuple[str, int]]()

    def carry(number: int) -> None:
        draw = np.random.default_rng([seed, number])
        source = (near, far)[number]
        while not ended.is_set():
            try:
                data, sender = source.recvfrom(_LONGEST)
            except OSError:  # no datagram came, or the other end is not open yet
                continue
            if number == 0:
                peer[:] = [sender]
            if draw.random() < loss:
                continue
            try:
                if number == 0:
                    far.send(data)
                elif peer:
                    near.sendto(data, peer[0])
            except OSError:
                continue

    threads = [threading.Thread(target=carry, args=(number,)) for number in range(2)]
    for thread in threads:
        thread.start()
    try:
        yield f"127.0.0.1:{near.getsockname()[1]}"
    finally:
        ended.set()
        for thread in threads:
            thread.join()
        near.close()
        far.close()
