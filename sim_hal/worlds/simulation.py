"""Advances the world and the emulated devices together, event by event, and records the true state.

The truth recorder is an emulated device. It writes the state at 40 Hz, and that of an orbit at 1 Hz, as
packets to a log of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from flight.link.telemetry.definitions import ORBIT_TRUTH, TRUTH
from flight.link.telemetry.packets import Packer
from sim_hal.device import NEVER, EmulatedDevice
from sim_hal.worlds.world import CAUSES, OrbitingWorld, OrbitTruth, World


class TimedSimulation:
    """Advances the world to each device's next event, then runs that device."""

    def __init__(self, advance_world: Callable[[int], None], devices: Sequence[EmulatedDevice]) -> None:
        self._advance_world = advance_world
        self._devices = tuple(devices)

    def next_event_ns(self) -> int:
        """Return the time of the next event of any device."""
        return min([device.next_event_ns() for device in self._devices], default=NEVER)

    def run_events(self, event_ns: int) -> None:
        """Advance to the next event, and run the devices that are due then."""
        self._advance_world(event_ns)
        for device in self._devices:
            if device.next_event_ns() <= event_ns:
                device.advance(event_ns)

    def advance_to(self, time_ns: int) -> None:
        """Process all events due at or before `time_ns`, in order."""
        while (event_ns := self.next_event_ns()) <= time_ns:
            self.run_events(event_ns)
        self._advance_world(time_ns)


PERIOD_NS = 25_000_000
ORBIT_PERIOD_NS = 1_000_000_000
_UNKNOWN = np.full(3, np.nan)


class PacketLog(Protocol):
    """A log of packets."""

    def write(self, packet: bytes) -> None:
        """Append a packet."""


class TruthRecorder:
    """Writes the truth log; takes part in the simulation as an emulated device."""

    def __init__(self, log: PacketLog) -> None:
        self._log = log
        self._packer = Packer()
        self._world: World | None = None
        self._epoch_ns = 0
        self._due_ns = NEVER

    def watch(self, world: World) -> None:
        """Record this world."""
        self._world = world

    def begin(self, epoch_ns: int) -> None:
        """Record from mission time zero on."""
        self._epoch_ns = epoch_ns
        self._due_ns = epoch_ns

    def next_event_ns(self) -> int:
        """Return when the next record is due."""
        return self._due_ns

    def advance(self, now_ns: int) -> None:
        """Write the records that are due."""
        while self._due_ns <= now_ns:
            self._write(self._due_ns)
            self._due_ns += PERIOD_NS

    def _write(self, time_ns: int) -> None:
        world = self._world
        if world is None:
            return
        motion = world.motion(time_ns)
        truth = world.truth()
        self._log.write(
            self._packer.pack(
                TRUTH,
                time_ns - self._epoch_ns,
                quaternion=motion.quaternion.tolist(),
                rate=motion.rate.tolist(),
                current=truth.current.tolist(),
                energy=truth.energy,
                supply_energy=truth.supply_energy,
            )
        )
        if (time_ns - self._epoch_ns) % ORBIT_PERIOD_NS == 0 and isinstance(world, OrbitingWorld):
            self._log.write(self._of_orbit(time_ns, world.orbit_truth()))

    def _of_orbit(self, time_ns: int, truth: OrbitTruth) -> bytes:
        torques = truth.torques
        coils, dipole, gravity, drag, sunlight = (torques.get(cause, _UNKNOWN).tolist() for cause in CAUSES)
        return self._packer.pack(
            ORBIT_TRUTH,
            time_ns - self._epoch_ns,
            utc=truth.utc,
            position=truth.position.tolist(),
            velocity=truth.velocity.tolist(),
            field=truth.field.tolist(),
            sun=truth.sun.tolist(),
            sunlit=truth.sunlit,
            residual_dipole=truth.residual_dipole.tolist(),
            coil_torque=coils,
            dipole_torque=dipole,
            gravity_torque=gravity,
            drag_torque=drag,
            sunlight_torque=sunlight,
        )
