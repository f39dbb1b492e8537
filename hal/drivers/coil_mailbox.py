"""The newest command to the torque coils, passed from the control loop to the driver's job."""

from __future__ import annotations

import threading

from hal.interfaces.wires import Clock

Counts = tuple[int, int, int]
"""Signed PWM counts of the three coils."""
Axes = tuple[bool, bool, bool]
"""One flag for each coil."""

ZERO: Counts = (0, 0, 0)
NONE: Axes = (False, False, False)


class CommandMailbox:
    """Holds the newest command and brake request; replaces a command that is too old by zero.

    Attributes:
        lock: guards everything here; re-entrant, because a signal handler may request zero in the middle of
            its own thread's call.
        braked: the bridges to be braked.
        number: of the newest command, withdrawal or brake.
        command: A, as requested.
        command_ns: host time of the newest command, -1 before the first.
        saturated: whether any axis of the command was limited.
        stale: the command was too old and was replaced by zero.
    """

    def __init__(self, clock: Clock, stale_ns: int) -> None:
        """Accept commands; one that is older than `stale_ns` becomes zero."""
        self.lock = threading.RLock()
        self.braked = NONE
        self.number = 0
        self.command: tuple[float, float, float] = (0.0, 0.0, 0.0)
        self.command_ns = -1
        self.saturated = False
        self.stale = False
        self._clock = clock
        self._stale_ns = stale_ns
        self._wanted: Counts | None = None  # None: zero

    def put(self, command: tuple[float, float, float], counts: Counts, saturated: bool) -> None:
        """Replace the command, in A, by a new one and its signed counts."""
        with self.lock:
            self.command = command
            self.command_ns = self._clock.now_ns()
            self._wanted = counts
            self.saturated = saturated
            self.stale = False
            self.number += 1

    def brake(self, axes: Axes) -> None:
        """Request that these bridges be braked from now on, whatever is commanded."""
        with self.lock:
            self.braked = axes
            self.number += 1

    def withdraw(self) -> None:
        """Request zero."""
        with self.lock:
            self._wanted = None
            self.command = (0.0, 0.0, 0.0)
            self.saturated = False
            self.stale = False
            self.number += 1

    def newest(self) -> tuple[Counts, Axes, int]:
        """Return the signed counts and braked bridges that should be on the wire now, and their number."""
        with self.lock:
            if self._wanted is not None and self._clock.now_ns() - self.command_ns > self._stale_ns:
                self._wanted = None
                self.saturated = False
                self.stale = True
                self.number += 1
            x, y, z = self._wanted or ZERO
            brake_x, brake_y, brake_z = self.braked
            counts = 0 if brake_x else x, 0 if brake_y else y, 0 if brake_z else z
            return counts, self.braked, self.number
