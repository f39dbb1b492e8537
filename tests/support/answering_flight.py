"""A command socket that answers as the flight software does."""

from __future__ import annotations

import contextlib
import socket
import threading
import weakref
from pathlib import Path

from flight.link.commands import LONGEST
from flight.link.events import Mode
from flight.link.telemetry.definitions import COMMAND
from flight.link.telemetry.packets import Packer


def answer(obeyed: bool) -> bytes:
    """Return the flight software's reply to a command that it has executed or refused."""
    fields = dict.fromkeys((field.name for field in COMMAND.fields), 0)
    texts = {field.name: "as commanded" for field in COMMAND.fields if field.kind.startswith("S")}
    return Packer().pack(COMMAND, 5, {**fields, **texts, "obeyed": int(obeyed), "mode": int(Mode.HOLD)})


class Listener:
    """A command socket that sends prepared replies in order, and then repeats the last reply."""

    def __init__(self, path: Path) -> None:
        self._reply = [answer(True)]
        self._line = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._line.bind(str(path))
        threading.Thread(target=_listen, args=(self._line, self._reply), daemon=True).start()
        weakref.finalize(self, self._line.shutdown, socket.SHUT_RDWR)

    def will_say(self, *replies: bytes) -> None:
        """Set the replies to the next commands; the last reply is repeated."""
        self._reply[:] = replies


def _listen(line: socket.socket, reply: list[bytes]) -> None:
    """Answer each datagram until the socket is shut down."""
    while True:
        _, sender = line.recvfrom(LONGEST)
        if not sender:
            line.close()
            return
        with contextlib.suppress(OSError):  # the sender has closed its socket
            line.sendto(reply.pop(0) if len(reply) > 1 else reply[0], sender)
