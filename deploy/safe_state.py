#!/usr/bin/env -S python3 -I -S
"""Safe state of a board after repeated failures of the flight, with the coils at zero until the next attempt.

The service knightcube-safe.service runs this program, which needs only Python's standard library and the
script `coils-off` in the same folder. The program ends with status 0 when the flight software is to be
started again. The first start follows after 30 s, and the waiting time doubles with each further failure, up
to an hour. The command `mode` ends the waiting time at once, and the command `safe` extends it to one hour
after the command. The command `ping` is answered. Other commands are refused, and datagrams that are not
commands get no answer.

The environment variable KNIGHTCUBE_COMMANDS holds the path of the command socket. If the variable is missing,
no commands are received. The number of tries is stored in the folder RUNTIME_DIRECTORY until the next boot of
the board.
"""

from __future__ import annotations

import binascii
import contextlib
import os
import select
import signal
import socket
import stat
import struct
import subprocess
import sys
import time

FIRST_S, LONGEST_S = 30.0, 3600.0
FLEW_S = 600.0
"""Flight duration (s) after which the next restart has the shortest waiting time (`FIRST_S`) again."""

COILS_S, RETRY_S = 30.0, 1.0
"""Time (s) until the coils are set to zero again, after a successful attempt and after a failed attempt.

The script `coils-off` is also killed after `COILS_S`, so that a hanging bus delays answers by no more than
this time.
"""

# Tests compare these packet layouts with those of flight/link, which this program does not import.
COMMANDS = {
    **{0x1A01: "ping", 0x1A02: "safe", 0x1A03: "mode", 0x1A04: "slew", 0x1A05: "clear", 0x1A06: "point"},
    **{0x1A10: "load-parameters", 0x1A11: "dump-parameters"},
}
LENGTHS = {
    **{"ping": 21, "safe": 81, "mode": 18, "slew": 25, "clear": 49, "point": 58},
    **{"load-parameters": 153, "dump-parameters": 17},
}
ANSWER, ANSWER_ID, ANSWER_VERSION = ">HHHBqB16s16sIB128s", 0x0933, 1
SAFE_MODE = 1


class Tries:
    """Number of the next attempt to start the flight, stored until the next boot of the board."""

    def __init__(self, folder: str, now: float) -> None:
        self._path = os.path.join(folder, "tries") if folder else ""
        self.number = 1
        with contextlib.suppress(OSError, ValueError):
            with open(self._path, encoding="ascii") as file:
                number, ended = file.read(64).split()
            if now - float(ended) < FLEW_S + self.pause(int(number)):
                self.number = int(number) + 1

    @staticmethod
    def pause(number: int) -> float:
        """Return the waiting time (s) before the attempt `number` to start the flight."""
        return min(FIRST_S * 2.0 ** (min(number, 20) - 1), LONGEST_S)

    def keep(self, now: float) -> None:
        """Store the number and the time `now` (s) of this attempt to start the flight.

        Nothing is stored without a folder, or if writing fails.
        """
        if not self._path:
            return
        with contextlib.suppress(OSError):
            with open(self._path + ".part", "w", encoding="ascii") as file:
                file.write(f"{self.number} {now}\n")
            os.replace(self._path + ".part", self._path)


class SafeState:
    """Answers commands, and determines when the flight is to be started again."""

    def __init__(self, tries: Tries, now: float) -> None:
        self._tries = tries
        self._count = 0
        self._seen: list[bytes] = []
        self.due = now + tries.pause(tries.number)

    def answer(self, data: bytes, now: float) -> bytes | None:
        """Execute the command in a datagram, and return the answer, or None if there is no command."""
        name = command_name(data)
        if not name:
            return None
        obeyed, text = True, ""
        if data in self._seen:
            obeyed, text = False, "an identical packet was received before"
        elif name == "mode":
            self.due = now
        elif name == "safe":
            self.due = now + LONGEST_S
        elif name != "ping":
            obeyed, text = False, "the board is in its safe state and executes only ping, safe and mode"
        self._seen = [*self._seen[-63:], data]
        self._count += 1
        left = max(0.0, self.due - now)
        text = (
            text or f"{name}: safe state, start {self._tries.number} of the flight software in {left:.0f} s"
        )
        say(text)
        return pack(obeyed, name, self._count, text)


def command_name(data: bytes) -> str:
    """Return the name of the command in a datagram, or an empty text if there is no valid command."""
    name = COMMANDS.get(int.from_bytes(data[:2], "big"), "")
    whole = name and len(data) == LENGTHS[name] == int.from_bytes(data[4:6], "big") + 7
    return name if whole and binascii.crc_hqx(data, 0xFFFF) == 0 else ""


def pack(obeyed: bool, name: str, count: int, text: str) -> bytes:
    """Return the telemetry packet that answers a command."""
    length = struct.calcsize(ANSWER) + 2 - 7
    head = (ANSWER_ID, 0xC000 | (count - 1) % 0x4000, length, ANSWER_VERSION, 0)
    fields = (int(obeyed), name.encode(), b"safe state", count, SAFE_MODE, text.encode()[:128])
    body = struct.pack(ANSWER, *head, *fields)
    return body + binascii.crc_hqx(body, 0xFFFF).to_bytes(2, "big")


def say(text: str) -> None:
    """Write a line to standard error, which systemd records in the journal. Errors are ignored."""
    with contextlib.suppress(OSError):
        sys.stderr.write(f"safe state: {text}\n")
        sys.stderr.flush()


def listen(path: str) -> socket.socket | None:
    """Return a command socket bound to `path`, or None for an empty path or after an error."""
    try:
        if not path:
            return None
        if os.path.lexists(path) and stat.S_ISSOCK(os.lstat(path).st_mode):
            os.unlink(path)
        ears = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        before = os.umask(0o117)
        try:
            ears.bind(path)
        finally:
            os.umask(before)
        ears.setblocking(False)
        return ears
    except OSError as error:
        say(f"cannot listen on {path}: {error.strerror}")
        return None


def coils_off() -> bool:
    """Set the coils to zero by the script `coils-off`, and return whether the PWM chip acknowledged."""
    beside = os.path.join(os.path.dirname(os.path.abspath(__file__)), "coils-off")
    with contextlib.suppress(OSError):
        script = subprocess.Popen([beside], start_new_session=True)
        try:
            return script.wait(COILS_S) == 0
        except subprocess.TimeoutExpired:
            say(f"coils-off is killed because it did not end in {COILS_S:.0f} s")
            os.killpg(script.pid, signal.SIGKILL)  # ends the script and its child processes
            script.wait()
    return False


def serve(state: SafeState, path: str) -> None:
    """Keep the coils at zero and answer commands until the flight is to be started again."""
    ears: socket.socket | None = None
    zero_due, zeroed = 0.0, None
    while (now := time.monotonic()) < state.due:
        if now >= zero_due:
            acknowledged = coils_off()
            if acknowledged is not zeroed:
                say("coils at zero" if acknowledged else "the coils' PWM chip does not answer")
            zeroed = acknowledged
            zero_due = time.monotonic() + (COILS_S if zeroed else RETRY_S)
            # A socket whose file was removed is replaced.
            if ears is None or not os.path.exists(path):
                ears = listen(path)
        left = max(0.0, min(state.due, zero_due) - time.monotonic())
        if select.select([ears] if ears else [], [], [], left)[0]:
            assert ears is not None
            with contextlib.suppress(OSError):
                data, sender = ears.recvfrom(256)
                answer = state.answer(data, time.monotonic())
                if answer and sender:
                    ears.sendto(answer, sender)
    if ears is not None:
        ears.close()


def main() -> int:
    """Keep the board in the safe state until the flight is to be started again."""
    now = time.monotonic()
    tries = Tries(os.environ.get("RUNTIME_DIRECTORY", "").partition(":")[0], now)
    state = SafeState(tries, now)
    say(
        f"the flight software ended too often: start number {tries.number} follows in {state.due - now:.0f} s"
    )
    serve(state, os.environ.get("KNIGHTCUBE_COMMANDS", ""))
    tries.keep(time.monotonic())
    say(f"the flight software is started again, start {tries.number}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
