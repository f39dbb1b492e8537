"""`sim_hal serve`: a configuration's simulated hardware in real time, for any client."""

from __future__ import annotations

import argparse
import json
import signal
import sys
from pathlib import Path

import msgspec

from flight.schema import reader as configuration
from flight.schema.carried import config_path, names
from knightcube.errors import UsageError
from sim_hal.serving.server import DeviceServer
from sim_hal.settings import Simulation


def add_to(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the command line."""
    parser = commands.add_parser(
        "serve",
        help="serve all devices of a configuration in real time",
        description="Serve the simulated hardware of a configuration in real time: the VN-100 on a "
        "pseudo-terminal, the I2C bus and the camera on a Unix socket. Prints a JSON object with their names "
        "once they answer. `python -m flight run CONFIG --realtime` starts this by itself.",
    )
    carried = ", ".join(names())
    parser.add_argument(
        "config",
        type=config_path,
        metavar="CONFIG",
        help=f"YAML file with a simulation section, or one of {carried}",
    )
    parser.add_argument("--folder", type=Path, required=True, metavar="DIR", help="where the truth is logged")
    parser.add_argument("--seed", type=int, metavar="N", help="seed of the simulation instead")
    parser.add_argument(
        "--patience", type=float, metavar="S", help="end S seconds after the last client has left"
    )
    parser.add_argument(
        "--facts", type=Path, metavar="FILE", help="write the object to FILE too, for `flight run --devices`"
    )
    parser.set_defaults(command=serve)


def serve(options: argparse.Namespace) -> int:
    """Serve until SIGINT or SIGTERM."""
    try:
        config = configuration.load(options.config)
        text = options.config.read_text(encoding="utf-8")
        section = configuration.simulation_section(text, str(options.config), Simulation)
        if section is None:
            raise UsageError(f"{options.config} has no simulation section: nothing to serve")
        if options.seed is not None:
            section = msgspec.structs.replace(section, seed=options.seed)
        server = DeviceServer(config, section, options.folder)
    except UsageError as error:
        sys.stderr.write(f"sim_hal: {error}\n")
        return 2
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, server.stop)
    try:
        facts = {
            "serial": server.serial_device,
            "baud_rate": config.inertial_unit.baud_rate,
            "socket": str(server.socket_path),
            "camera": config.camera is not None,
            "gps": server.gps_device,
            "gps_baud_rate": None if config.gps is None else config.gps.baud_rate,
            "wide": len(config.wide_cameras),
        }
        if options.facts is not None:
            beside = options.facts.with_suffix(".part")
            beside.write_text(json.dumps(facts) + "\n", encoding="utf-8")
            beside.replace(options.facts)
        sys.stdout.write(json.dumps(facts) + "\n")
        sys.stdout.flush()
        server.serve(None if options.patience is None else round(options.patience * 1e9))
    finally:
        server.close()
    return 0
