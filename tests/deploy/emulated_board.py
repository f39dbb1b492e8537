"""Emulated devices of a board, with the frames of `tests.deploy.emulated_video`.

`python -m tests.deploy.emulated_board CONFIG WORLD FOLDER` emulates the devices of CONFIG in the world that
the section `simulation` of WORLD describes. The device files of serial devices in CONFIG become links to
pseudo-terminals. Programs that run with the printed environment variables open the I2C bus by its device
file, through the preload library of `sim_hal emulate i2c`. Frames are supplied by
`tests.deploy.emulated_video`. The true state is logged in FOLDER. The program prints one JSON object when the
devices respond, and ends at SIGTERM.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from flight.schema import reader
from hal.buses.linux_wires import device_file
from hal.buses.system import SystemClock
from sim_hal.serving.emulate_i2c import I2cServer, library
from sim_hal.serving.server import DeviceServer
from sim_hal.settings import Simulation

TUMBLE = 0.05
"""Initial body rate (rad/s) of a satellite, at which the frames of its star camera contain streaks."""


def serve(path: Path, world: Path, folder: Path) -> None:
    """Serve the devices until SIGTERM."""
    config = reader.load(path)
    section = reader.simulation_section(world.read_text(encoding="utf-8"), str(world), Simulation)
    assert section is not None
    if section.free_body is not None:
        release = msgspec.structs.replace(section.free_body.release, speed=TUMBLE)
        body = msgspec.structs.replace(section.free_body, release=release)
        section = msgspec.structs.replace(section, free_body=body)
    server = DeviceServer(config, section, folder)
    with suppress(PermissionError):  # a real device does not wait for programs on a busy machine
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(1))
    signal.signal(signal.SIGTERM, server.stop)
    bus_socket = folder / "bus.sock"
    bus = I2cServer(server.hardware.wires.i2c(), bus_socket)
    try:
        for name, line in server.lines.items():
            Path(name).resolve().symlink_to(line)  # the device file may itself be a link
        server.attend(bus.fileno(), partial(bus.serve, 0.0))
        facts: dict[str, Any] = {
            "socket": str(server.socket_path),
            "environment": {
                "LD_PRELOAD": str(library()),
                "KNIGHTCUBE_I2C_SOCKET": str(bus_socket),
                "KNIGHTCUBE_I2C_BUS": device_file(config.coils.bus),
            },
        }
        server.release(SystemClock().now_ns())
        sys.stdout.write(json.dumps(facts) + "\n")
        sys.stdout.flush()
        server.serve()
    finally:
        bus.close()
        server.close()


if __name__ == "__main__":
    serve(*map(Path, sys.argv[1:]))
