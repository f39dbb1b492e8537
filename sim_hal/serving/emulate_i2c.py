"""`sim_hal emulate i2c`: the coils' I2C bus of a configuration for programs that open /dev/i2c-N themselves.

Programs meet the bus through a preload library rather than a CUSE device: a CUSE device needs a kernel
module, its device node and the right to use both, which containers and shared machines lack; the library
needs a C compiler once. Programs that are linked statically, or set-user-id, do not load it.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from types import FrameType

import numpy as np

from flight.schema import reader as configuration
from flight.schema.carried import config_path, names
from hal.buses.clock import SystemClock
from hal.interfaces.wires import SECOND_NS
from knightcube.errors import UsageError
from sim_hal.coil_assembly import CoilHardware, assemble_coils
from sim_hal.serving.i2c_server import I2cServer
from sim_hal.serving.options import positive, seed
from sim_hal.serving.preload import library
from sim_hal.settings import Release, Simulation

_LONGEST_WAIT_S = 0.05

_EXAMPLES = """\
examples:
  python -m sim_hal emulate i2c -- i2cdetect -y 1
      run a program on the emulated bus; ends with it, and with its status
  python -m sim_hal emulate i2c --bus 7 --config testbed -- python3 my_driver.py
      another bus number, and the coils of another configuration
  python -m sim_hal emulate i2c
      serve until interrupted; prints the environment that lets any program open the bus
"""


def add_to(devices: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the device to `sim_hal emulate`."""
    parser = devices.add_parser(
        "i2c",
        help="the coils' I2C bus, for unchanged programs",
        description="Serve the PWM chip and the current monitor of a configuration's coils, in real time, to "
        "programs that open /dev/i2c-N themselves.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    carried = ", ".join(names())
    add = parser.add_argument
    add(
        "--config",
        type=config_path,
        default=config_path("step_demo"),
        metavar="CONFIG",
        help=f"YAML file, or one of {carried} (default step_demo)",
    )
    add("program", nargs="*", metavar="PROGRAM", help="after --: a program to run, with its arguments")
    add("--bus", type=int, choices=range(256), default=1, metavar="N", help="serve /dev/i2c-N (default 1)")
    add("--seed", type=seed, default=1, help="of the currents' noise (default 1)")
    add("--duration", type=positive, metavar="S", help="end after S seconds")
    add("--json", action="store_true", help="print one JSON object instead of the environment")
    parser.set_defaults(command=emulate)


def emulate(options: argparse.Namespace) -> int:
    """Serve until the program ends, or without one until SIGINT, SIGTERM or the duration's end."""
    try:
        coils = _coils(options.config, options.seed)
        with tempfile.TemporaryDirectory(prefix="knightcube-i2c-") as folder:
            path = Path(folder) / "bus.sock"
            environment = {
                "LD_PRELOAD": str(library()),
                "KNIGHTCUBE_I2C": str(path),
                "KNIGHTCUBE_I2C_BUS": str(options.bus),
            }
            server = I2cServer(coils.bus, path)
            try:
                if options.program:
                    return _with_program(server, options.program, environment, options.duration)
                _announce(options, environment, coils)
                _serve(server, None, options.duration)
            finally:
                server.close()
    except UsageError as error:
        sys.stderr.write(f"sim_hal: {error}\n")
        return 2
    return 0


def _coils(config_file: Path, number: int) -> CoilHardware:
    config = configuration.load(config_file)
    text = config_file.read_text(encoding="utf-8")
    section = configuration.simulation_section(text, str(config_file), Simulation)
    if section is None:  # a board's configuration: its coils are as it believes
        section = Simulation(release=Release(q2=0.0))
    return assemble_coils(config, section, np.random.default_rng(number), SystemClock().now_ns)


def _announce(options: argparse.Namespace, environment: Mapping[str, str], coils: CoilHardware) -> None:
    parts = {"pca9685": coils.pwm.address}
    if coils.monitor is not None:
        parts["ina219"] = coils.monitor.address
    facts = {"device": f"/dev/i2c-{options.bus}", "parts": parts, "environment": environment}
    text = " ".join(f"{name}={shlex.quote(value)}" for name, value in environment.items())
    sys.stdout.write((json.dumps(facts) if options.json else text) + "\n")
    sys.stdout.flush()


def _with_program(
    server: I2cServer, program: list[str], environment: Mapping[str, str], duration: float | None
) -> int:
    """Run a program beside the server; return its exit status as a shell does."""
    try:
        process = subprocess.Popen(program, env={**os.environ, **environment})
    except OSError as error:
        raise UsageError(f"{program[0]} cannot be run: {error.strerror}") from error
    _serve(server, process, duration)
    if process.poll() is None:
        process.terminate()
    status = process.wait()
    return status if status >= 0 else 128 - status


def _serve(server: I2cServer, process: subprocess.Popen[bytes] | None, duration: float | None) -> None:
    """Answer requests until the process, the duration or a signal ends it."""
    stopped = False

    def stop(_signal: int, _frame: FrameType | None) -> None:
        nonlocal stopped
        stopped = True

    clock = SystemClock()
    end_ns = None if duration is None else clock.now_ns() + round(duration * SECOND_NS)
    previous = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        while not stopped and (process is None or process.poll() is None):
            if end_ns is not None and clock.now_ns() >= end_ns:
                return
            server.serve(_LONGEST_WAIT_S)
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
