"""Command line of `python -m sim_hal`, which serves emulated devices to any client.

The command `emulate` serves one emulated device. The command `serve` serves the simulated hardware of a
configuration in real time.
"""

from __future__ import annotations

import argparse
import json
import math
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
import numpy as np

from flight.schema import reader as configuration
from flight.schema.document import config_path, names
from hal.buses.linux_wires import device_file
from hal.buses.system import SystemClock
from knightcube.errors import UsageError
from sim_hal.emulators.serial_line import PtyLine
from sim_hal.emulators.vn100 import BAUD_RATES, Vn100Emulator, Vn100EmulatorSettings
from sim_hal.emulators.vn100_sensors import PROFILES
from sim_hal.serving import emulate_i2c
from sim_hal.serving.server import DeviceServer
from sim_hal.settings import Simulation
from sim_hal.worlds.world import BodyMotion, about_thread

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

_I2C_EXAMPLES = """\
examples:
  python -m sim_hal emulate i2c -- i2cdetect -y 1
      run a program on the emulated bus; ends with it, and with its status
  python -m sim_hal emulate i2c --bus 7 --config testbed -- python3 my_driver.py
      another bus number, and the coils of another configuration
  python -m sim_hal emulate i2c
      serve until interrupted; prints the environment that lets any program open the bus
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return the exit status: 0 for success, 1 for a failure, 2 for wrong arguments."""
    options = _parser().parse_args(arguments)
    command: Callable[[argparse.Namespace], int] = options.command
    try:
        return command(options)
    except UsageError as error:
        sys.stderr.write(f"sim_hal: {error}\n")
        return 2


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m sim_hal", description="Emulated devices for any client.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    emulate = commands.add_parser("emulate", help="serve one emulated device", description="Serve a device.")
    devices = emulate.add_subparsers(required=True, metavar="DEVICE")
    raw, carried = argparse.RawDescriptionHelpFormatter, ", ".join(names())

    vn100 = devices.add_parser(
        "vn100",
        help="a VectorNav VN-100 on a pseudo-terminal",
        description="Serve a VN-100 on a pseudo-terminal, in real time, until interrupted.",
        epilog=_VN100_EXAMPLES,
        formatter_class=raw,
    )
    add = vn100.add_argument
    add("--rate-deg-s", type=_number, metavar="R", help="rotate at a constant R degrees per second")
    add(
        "--amplitude-deg",
        type=_number,
        default=20.0,
        metavar="A",
        help="amplitude of the swing, deg (default 20)",
    )
    add("--period-s", type=_positive, default=20.0, metavar="S", help="period of the swing, s (default 20)")
    add("--field", type=_number, default=4.5e-4, metavar="T", help="magnetic field, T (default 4.5e-4)")
    add("--baud", type=int, choices=BAUD_RATES, default=115200, help="baud rate of the unit (default 115200)")
    add("--noise", choices=sorted(PROFILES), default="thesis", help="noise profile (default thesis)")
    add("--seed", type=_seed, default=1, help="random seed of the sensor noise (default 1)")
    add("--link", type=Path, metavar="PATH", help="make PATH a symbolic link to the device")
    add("--duration", type=_positive, metavar="S", help="end after S seconds")
    add("--json", action="store_true", help="print one JSON object instead of the device's name")
    vn100.set_defaults(command=_emulate_vn100)

    i2c = devices.add_parser(
        "i2c",
        help="the coils' I2C bus as /dev/i2c-N, for any program",
        description="Serve the PWM chip and the current monitor of a configuration's coils, in real time, to "
        "programs that open /dev/i2c-N themselves.",
        epilog=_I2C_EXAMPLES,
        formatter_class=raw,
    )
    add = i2c.add_argument
    default = config_path("step_demo")
    text = f"YAML file, or one of {carried} (default step_demo)"
    add("--config", type=config_path, default=default, metavar="CONFIG", help=text)
    add("program", nargs="*", metavar="PROGRAM", help="after --: a program to run, with its arguments")
    add("--bus", type=int, choices=range(256), default=1, metavar="N", help="serve /dev/i2c-N (default 1)")
    add("--seed", type=_seed, default=1, help="seed of the currents' noise (default 1)")
    add("--duration", type=_positive, metavar="S", help="end after S seconds")
    add("--json", action="store_true", help="print one JSON object instead of environment variables")
    i2c.set_defaults(command=emulate_i2c.emulate)

    serve = commands.add_parser(
        "serve",
        help="serve all devices of a configuration in real time",
        description="Serve the simulated hardware of a configuration in real time: the VN-100 on a "
        "pseudo-terminal, the I2C bus and the camera on a Unix socket. Prints a JSON object with their names "
        "once they answer. `knightcube run CONFIG --realtime` starts this by itself.",
    )
    add = serve.add_argument
    text = f"YAML file with a simulation section, or one of {carried}"
    add("config", type=config_path, metavar="CONFIG", help=text)
    add("--folder", type=Path, required=True, metavar="DIR", help="folder for the log of the true state")
    add("--seed", type=int, metavar="N", help="random seed that replaces the seed of the configuration")
    add("--patience", type=float, metavar="S", help="end S seconds after the last client has disconnected")
    add("--facts", type=Path, metavar="FILE", help="copy of the JSON object, for `knightcube run --devices`")
    serve.set_defaults(command=_serve)
    return parser


def _number(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text} is not a finite number")
    return value


def _positive(text: str) -> float:
    value = _number(text)
    if value <= 0.0:
        raise argparse.ArgumentTypeError(f"{text} is not above zero")
    return value


def _seed(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text} is below zero")
    return value


def _serve(options: argparse.Namespace) -> int:
    """Serve the devices of a configuration until SIGINT or SIGTERM."""
    config = configuration.load(options.config)
    text = options.config.read_text(encoding="utf-8")
    section = configuration.simulation_section(text, str(options.config), Simulation)
    if section is None:
        raise UsageError(f"{options.config} has no simulation section: nothing to serve")
    if options.seed is not None:
        section = msgspec.structs.replace(section, seed=options.seed)
    server = DeviceServer(config, section, options.folder)
    for signal_number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(signal_number, server.stop)
    try:
        facts = {
            "socket": str(server.socket_path),
            "camera": config.camera is not None,
            "lines": server.lines,
            "coil_bus": device_file(config.coils.bus),
            "utc_offset_ns": server.hardware.utc_offset_ns,
            "wide": len(config.wide_cameras),
        }
        if options.facts is not None:
            part = options.facts.with_suffix(".part")
            part.write_text(json.dumps(facts) + "\n", encoding="utf-8")
            part.replace(options.facts)
        sys.stdout.write(json.dumps(facts) + "\n")
        sys.stdout.flush()
        server.serve(None if options.patience is None else round(options.patience * 1e9))
    finally:
        server.close()
    return 0


def _emulate_vn100(options: argparse.Namespace) -> int:
    """Serve a VN-100 on a rotating or oscillating testbed, until a signal or the end of the duration."""
    if options.link is not None and options.link.exists() and not options.link.is_symlink():
        raise UsageError(f"--link {options.link} exists and is not a symbolic link: choose another path")
    clock, rng = SystemClock(), np.random.default_rng(options.seed)
    try:
        line = PtyLine(options.baud, rng, options.link)
    except OSError as error:
        sys.stderr.write(f"sim_hal: the pseudo-terminal cannot be served: {error}\n")
        return 1
    start_ns, pulse = clock.now_ns(), 2.0 * math.pi / options.period_s
    amplitude = math.radians(options.amplitude_deg)

    def motion(time_ns: int) -> BodyMotion:
        seconds = (time_ns - start_ns) * 1e-9
        if options.rate_deg_s is not None:
            rate = math.radians(options.rate_deg_s)
            return about_thread(time_ns, rate * seconds, rate, options.field)
        angle = amplitude * math.sin(pulse * seconds)
        return about_thread(time_ns, angle, amplitude * pulse * math.cos(pulse * seconds), options.field)

    settings = Vn100EmulatorSettings(noise=PROFILES[options.noise])
    emulator = Vn100Emulator(motion, line, rng, settings, start_ns)
    emulator.set_baud_rate(options.baud)
    facts = {"device": line.name, "baud_rate": options.baud, "link": options.link and str(options.link)}
    end_ns = None if options.duration is None else clock.now_ns() + round(options.duration * 1e9)
    try:
        with emulate_i2c.stop_signals() as stopped:
            sys.stdout.write((json.dumps(facts) if options.json else line.name) + "\n")
            sys.stdout.flush()
            while not stopped.is_set() and (end_ns is None or clock.now_ns() < end_ns):
                now_ns = clock.now_ns()
                line.exchange(now_ns)
                emulator.advance(now_ns)
                line.wait(now_ns, min(emulator.next_event_ns(), now_ns + _LONGEST_WAIT_NS))
    finally:
        line.close()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
