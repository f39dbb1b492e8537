"""A bring-up session whose devices are objects of a test, in simulated time."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from typing import Any
from unittest.mock import Mock

import numpy as np

from flight.schema import reader
from ground.bringup.bench import Session
from ground.bringup.diagnosis import Finding
from hal.interfaces.devices import Frame, ImuLink, ImuReading
from hal.interfaces.errors import NotResponding
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import FloatArray
from sim_hal.clock import SimClock
from tests.support.orbit_devices import orbit_config

UTC_NS = 1_774_008_000 * SECOND_NS
"""UTC (ns since 1970) at the time 0 of the session's clock."""


def bench_session(devices: dict[str, Any], **changes: Any) -> Session:
    """Return a session with open `devices` (by key). `changes` replace sections of the configuration."""
    config = reader.replace(orbit_config(camera=True), **changes)
    rig: Any = Mock(clock=SimClock(UTC_NS), cameras=None)
    return Session(config, rig, ExitStack(), lambda _: None, _open=devices)


def named(findings: list[Finding]) -> list[str]:
    """Return part and kind of each finding."""
    return [f"{one.part} {one.kind}" for one in findings]


class ScriptedCoils:
    """Torque coils that keep the latest command and all earlier commands."""

    def __init__(self) -> None:
        self.now = np.zeros(3)
        self.commands: list[list[float]] = []

    def command(self, currents: FloatArray) -> None:
        """Keep a command, A."""
        self.now = np.array(currents)
        self.commands.append(self.now.tolist())

    def off(self) -> None:
        """Set all currents to zero."""
        self.command(np.zeros_like(self.now))


class ScriptedCamera:
    """Camera that returns given pixels, one picture for each trigger; the last picture is repeated.

    A picture may be None for a trigger without a frame. A frame arrives `late_s` after its exposure. If
    `frozen`, all frames have the same frame number.
    """

    def __init__(self, session: Callable[[], Session], *pictures: Any, late_s: float = 0.1) -> None:
        self.session, self.pictures, self.late_s, self.frozen = session, list(pictures), late_s, False
        self.triggers: list[int] = []

    def trigger(self, exposure_ns: int) -> None:
        """Begin an exposure."""
        self.triggers.append(exposure_ns)

    def poll(self) -> Frame | None:
        """Return the frame of the latest trigger. Raises NotResponding for a trigger without a frame."""
        number = len(self.triggers)
        pixels = self.pictures[min(number, len(self.pictures)) - 1]
        if pixels is None:
            raise NotResponding("camera", f"no frame for trigger {number}")
        now_ns, exposure_ns = self.session().rig.clock.now_ns(), self.triggers[-1]
        begun_ns = now_ns - exposure_ns - round(self.late_s * SECOND_NS)
        return Frame(7 if self.frozen else number, begun_ns, exposure_ns, now_ns, np.asarray(pixels))


class ScriptedUnit:
    """Inertial unit at rest that samples at 40 Hz and measures given values.

    The function `sample` returns rate, field and acceleration of the sample with the given number. The
    attribute `counts` has the counters of the link after the first call of `link`.
    """

    def __init__(
        self,
        session: Callable[[], Session],
        sample: Callable[[int], tuple[FloatArray, FloatArray, FloatArray]],
        **counts: Any,
    ) -> None:
        self.session, self.sample, self.counts = session, sample, counts
        self.sent = self.asked = 0
        self.rate_hz = 40.0

    def poll(self) -> list[ImuReading]:
        """Return the samples since the last call."""
        due = int(self.session().rig.clock.now_ns() * 1e-9 * self.rate_hz)
        found = [self._reading(number) for number in range(self.sent + 1, due + 1)]
        self.sent = max(self.sent, due)
        return found

    def _reading(self, number: int) -> ImuReading:
        time_ns = round(number / self.rate_hz * SECOND_NS)
        return ImuReading(time_ns, time_ns, time_ns, np.array([0.0, 0.0, 0.0, 1.0]), *self.sample(number))

    def link(self) -> ImuLink:
        """Return zeros at the first call, and the given counters at all later calls."""
        self.asked += 1
        zeros = dict.fromkeys(("bytes_received", "packets", "bad_checksum", "discarded_bytes"), 0)
        zeros |= {"out_of_range": 0, "not_finite": 0, "last_byte_ns": 0}
        return ImuLink(**(zeros if self.asked == 1 else zeros | self.counts))
