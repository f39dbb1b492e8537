"""The command line of the emulated devices.

`sim_hal emulate` serves one device; `sim_hal serve` serves the simulated hardware of a configuration in real
time.
"""

from __future__ import annotations

import argparse
import json
import math
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType

import msgspec
import numpy as np

from flight.schema import reader as configuration
from flight.schema.document import config_path, names
from hal.buses.clock import SystemClock
from hal.interfaces.wires import Clock
from knightcube.errors import UsageError
from sim_hal.emulators.serial_line import PtyLine
from sim_hal.emulators.vn100 import Vn100Emulator, Vn100EmulatorSettings
from sim_hal.emulators.vn100_registers import BAUD_RATES
from sim_hal.emulators.vn100_sensors import PROFILES
from sim_hal.serving import emulate_i2c
from sim_hal.serving.options import number, positive, seed
from sim_hal.serving.server import DeviceServer
from sim_hal.settings import Simulation
from sim_hal.worlds.world import BodyMotion, about_thread


def _add_serve(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
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
    parser.set_defaults(command=_serve)


def _serve(options: argparse.Namespace) -> int:
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
    for signal_number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(signal_number, server.stop)
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


_LONGEST_WAIT_NS = 50_000_000

_VN100_EXAMPLES = """\
examples:
  python -m sim_hal emulate vn100
      a unit that swings by 20 degrees on its thread; prints the device to open
  python -m sim_hal emulate vn100 --rate-deg-s 3 --link /tmp/vn100
      a steady turn, under a name that stays the same
  python -m sim_hal emulate vn100 --json --duration 60
      prints one JSON object with the device's name, serves for a minute
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; return the exit status: 0 done, 1 failed, 2 wrong use."""
    options = _parser().parse_args(arguments)
    command: Callable[[argparse.Namespace], int] = options.command
    return command(options)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m sim_hal", description="Emulated devices for any client.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    emulate = commands.add_parser("emulate", help="serve one emulated device", description="Serve a device.")
    devices = emulate.add_subparsers(required=True, metavar="DEVICE")
    _add_vn100(devices)
    emulate_i2c.add_to(devices)
    _add_serve(commands)
    return parser


def _add_vn100(devices: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    vn100 = devices.add_parser(
        "vn100",
        help="a VectorNav VN-100 on a pseudo-terminal",
        description="Serve a VN-100 on a pseudo-terminal, in real time, until interrupted.",
        epilog=_VN100_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = vn100.add_argument
    add("--rate-deg-s", type=number, metavar="R", help="turn steadily at R degrees a second")
    add("--amplitude-deg", type=number, default=20.0, metavar="A", help="else swing by A (default 20)")
    add("--period-s", type=positive, default=20.0, metavar="S", help="period of the swing (default 20)")
    add("--field", type=number, default=4.5e-4, metavar="T", help="tesla (default 4.5e-4)")
    add("--baud", type=int, choices=BAUD_RATES, default=115200, help="the unit's speed (default 115200)")
    add("--noise", choices=sorted(PROFILES), default="thesis", help="noise profile (default thesis)")
    add("--seed", type=seed, default=1, help="of the noise (default 1)")
    add("--link", type=Path, metavar="PATH", help="make PATH a symbolic link to the device")
    add("--duration", type=positive, metavar="S", help="end after S seconds")
    add("--json", action="store_true", help="print one JSON object instead of the device's name")
    vn100.set_defaults(command=_emulate_vn100)


def _emulate_vn100(options: argparse.Namespace) -> int:
    clock = SystemClock()
    rng = np.random.default_rng(options.seed)
    if options.link is not None and options.link.exists() and not options.link.is_symlink():
        sys.stderr.write(
            f"sim_hal: --link {options.link} exists and is not a symbolic link: choose another path\n"
        )
        return 2
    try:
        line = PtyLine(options.baud, rng, options.link)
    except OSError as error:
        sys.stderr.write(f"sim_hal: the pseudo-terminal cannot be served: {error}\n")
        return 1
    settings = Vn100EmulatorSettings(noise=PROFILES[options.noise])
    emulator = Vn100Emulator(_demonstration(options, clock.now_ns()), line, rng, settings, clock.now_ns())
    emulator.set_baud_rate(options.baud)
    facts = {"device": line.name, "baud_rate": options.baud, "link": options.link and str(options.link)}

    def announce() -> None:
        sys.stdout.write((json.dumps(facts) if options.json else line.name) + "\n")
        sys.stdout.flush()

    try:
        serve_unit(emulator, line, clock, announce, options.duration)
    finally:
        line.close()
    return 0


def _demonstration(options: argparse.Namespace, start_ns: int) -> Callable[[int], BodyMotion]:
    """Return the motion on the thread that the options ask for: a steady turn or a swing."""
    amplitude, pulse = math.radians(options.amplitude_deg), 2.0 * math.pi / options.period_s

    def motion(time_ns: int) -> BodyMotion:
        seconds = (time_ns - start_ns) * 1e-9
        if options.rate_deg_s is not None:
            rate = math.radians(options.rate_deg_s)
            return about_thread(time_ns, rate * seconds, rate, options.field)
        angle = amplitude * math.sin(pulse * seconds)
        return about_thread(time_ns, angle, amplitude * pulse * math.cos(pulse * seconds), options.field)

    return motion


def serve_unit(
    emulator: Vn100Emulator,
    line: PtyLine,
    clock: Clock,
    announce: Callable[[], None],
    duration: float | None = None,
) -> None:
    """Serve the emulator on the line in real time, for `duration` s or until SIGINT or SIGTERM.

    `announce` is called once the signal handlers are in place.
    """
    stopped = False

    def stop(_signal: int, _frame: FrameType | None) -> None:
        nonlocal stopped
        stopped = True

    previous = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    end_ns = None if duration is None else clock.now_ns() + round(duration * 1e9)
    try:
        announce()
        while not stopped and (end_ns is None or clock.now_ns() < end_ns):
            now_ns = clock.now_ns()
            line.exchange(now_ns)
            emulator.advance(now_ns)
            line.wait(now_ns, min(emulator.next_event_ns(), now_ns + _LONGEST_WAIT_NS))
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
