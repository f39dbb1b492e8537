"""Hands commands to the control process, each by a socket of its own: no answer is taken for another's."""

from __future__ import annotations

import socket
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from flight.link.telemetry.packets import LONGEST_PACKET

AT_MOST = 8
"""Commands that wait for their answers at once."""

PATIENCE_NS = 5_000_000_000
"""For the answer of a flight, whose command cycle is 0.1 s."""

T = TypeVar("T")


@dataclass(slots=True)
class _Waiting(Generic[T]):
    command: T
    line: socket.socket
    path: Path
    until_ns: int


class ControlLine(Generic[T]):
    """The control process's command socket as seen from the link. T says which command it was."""

    def __init__(self, target: Path, folder: Path) -> None:
        """`folder` is for the answers: the control process must be able to enter it."""
        self._target = str(target)
        self._folder = folder
        self._waiting: list[_Waiting[T]] = []
        self._count = 0

    def send(self, command: T, data: bytes, now_ns: int) -> str:
        """Hand a command over; return why that failed, empty when it went. Never waits."""
        if len(self._waiting) >= AT_MOST:
            return f"{AT_MOST} commands wait for their answers already"
        self._count += 1
        path = self._folder / f"answer-{self._count}"
        with ExitStack() as stack:
            try:
                line = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
                line.setblocking(False)
                stack.callback(_remove, path)
                path.unlink(missing_ok=True)
                line.bind(str(path))
                path.chmod(0o660)
                line.sendto(data, self._target)
            except OSError as error:
                return f"no flight listens: {error.strerror or error}"
            stack.pop_all()
        self._waiting.append(_Waiting(command, line, path, now_ns + PATIENCE_NS))
        return ""

    def answers(self, now_ns: int) -> list[tuple[T, bytes]]:
        """Return the answers that came, b"" for one that did not come in time."""
        found, still = [], []
        for waiting in self._waiting:
            try:
                data = waiting.line.recv(LONGEST_PACKET)
            except OSError:
                if now_ns < waiting.until_ns:
                    still.append(waiting)
                    continue
                data = b""
            self._end(waiting)
            found.append((waiting.command, data))
        self._waiting = still
        return found

    def close(self) -> None:
        """Give up what waits."""
        for waiting in self._waiting:
            self._end(waiting)
        self._waiting = []

    def _end(self, waiting: _Waiting[T]) -> None:
        waiting.line.close()
        _remove(waiting.path)


def _remove(path: Path) -> None:
    """Remove the file of a socket; one that cannot be removed now is bound over later."""
    with suppress(OSError):
        path.unlink(missing_ok=True)
