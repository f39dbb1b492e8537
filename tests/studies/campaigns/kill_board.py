"""A board whose flight process is killed again and again: its emulated devices and its kept state live on."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml

from flight.loop.state import StateStore, StoredState
from sim_hal.serving.device_link import RemoteI2cBus
from tests.hal.guardian.live_flight import LiveFlight, write_config

START_S = 1.5
"""s, assumed from exec to READY until the first start was measured."""

AT_MOST_S = 60.0


@dataclass
class Board:
    """What outlives a flight process.

    Attributes:
        boots: flights that have counted themselves.
        start_s: how long the last start took until READY.
        left: processes that were children of a flight when it was killed.
    """

    place: Path
    devices: Path
    bus: RemoteI2cBus
    boots: int = 0
    start_s: float = START_S
    left: list[int] = field(default_factory=list)

    @property
    def state(self) -> Path:
        """The folder of the kept state."""
        return self.place / "state"

    @contextmanager
    def flight(self, number: int, target: float, crash_limit: int) -> Iterator[LiveFlight]:
        """Start a flight to `target` in a folder of its own; none is left at the end."""
        folder = self.place / f"flight-{number}"
        folder.mkdir()
        config = write_config(folder)
        tree = yaml.safe_load(config.read_text(encoding="utf-8"))
        tree["steps"] = [{"at": 0.0, "q2": target}]
        tree["state"] = {"folder": str(self.state)}
        tree["modes"] = {"crash_limit": crash_limit}
        config.write_text(yaml.safe_dump(tree), encoding="utf-8")
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notifications:
            notifications.bind(str(folder / "notify"))
            flight = LiveFlight(folder, config, notifications, AT_MOST_S, "--devices", str(self.devices))
            try:
                yield flight
            finally:
                flight.process.kill()
                flight.process.wait()
                if flight.process.stderr is not None:
                    flight.process.stderr.close()

    def current(self) -> float:
        """Return the largest current of the coils now, A, as the devices' process knows it."""
        return float(np.abs(self.bus.call("currents")).max())

    def kept(self) -> tuple[StoredState, list[str]]:
        """Return the kept state, and what was wrong with its files."""
        problems: list[str] = []
        state = StateStore(self.state, lambda _, text: problems.append(text)).load()
        return state, problems
