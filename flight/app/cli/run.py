"""`flight run`: fly a configuration."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TextIO

from flight.app.cli import PROGRAM
from flight.app.request import RunRequest, RunResult
from flight.link.telemetry.packets import PacketArray
from flight.link.telemetry.reader import read_run
from flight.loop.progress import Progress
from flight.schema.carried import config_path, names


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this command to the parser."""
    parser.description = (
        "Fly a configuration on real devices, or on simulated devices where it has a simulation section. "
        "Simulated flights run as fast as they can; --realtime flies them on the machine's clock, with the "
        "devices in a process of their own. Ctrl-C ends a flight with the coils at zero and the log closed."
    )
    carried = ", ".join(names())
    parser.add_argument("config", type=config_path, metavar="CONFIG", help=f"YAML file, or one of {carried}")
    place = parser.add_mutually_exclusive_group()
    place.add_argument("--out", type=Path, metavar="DIR", help="folder of the run (default runs/NAME-TIME)")
    place.add_argument("--archive", type=Path, metavar="DIR", help="folder of a board's runs: fly the next")
    parser.add_argument("--duration", type=float, metavar="S", help="another duration")
    parser.add_argument("--seed", type=seed_number, metavar="N", help="another seed of the simulation")
    parser.add_argument(
        "--realtime", action="store_true", help="fly simulated devices on the machine's clock"
    )
    parser.add_argument(
        "--devices",
        type=Path,
        metavar="FILE",
        help="fly the simulated devices that `python -m sim_hal serve --facts FILE` serves; with --realtime",
    )
    parser.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="FAULT",
        help="inject a fault in the simulation, such as 'imu: silent @ 120 for 5'; repeatable (list below)",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object when done")
    parser.set_defaults(command=run)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    plain = parser.format_help
    parser.format_help = lambda: plain() + _faults_help()  # type: ignore[method-assign]  # the list is slow to load


def _faults_help() -> str:
    """Return the grammar of faults and the list of them."""
    from flight.app.simulated import fault_catalogue  # noqa: PLC0415 - only --help needs it

    grammar, listing = fault_catalogue()
    return (
        f"\nfaults: {grammar}\n"
        "  Seconds are of mission time; without @ a fault begins at 0, without `for` it lasts to the end.\n"
        "  In a configuration: simulation: {faults: [{fault: 'imu: silent', at: 120, for: 5}]}\n"
        f"\n{listing}\n"
    )


def run(options: argparse.Namespace) -> int:
    """Fly, showing progress on standard error when it is a terminal."""
    from flight.app.accepted_config import accepted_config  # noqa: PLC0415
    from flight.app.flight import fly  # noqa: PLC0415 - no other command needs devices
    from flight.app.run_folder import default_folder  # noqa: PLC0415

    config, problem = accepted_config(options.config, os.environ)
    if problem:
        sys.stderr.write(f"flight: {problem}\n")
    out = options.out or default_folder(options.config)
    request = RunRequest(
        config,
        out,
        options.realtime,
        options.duration,
        options.seed,
        options.devices,
        options.archive,
        tuple(options.fault),
        problem,
    )
    begun = time.perf_counter()
    with_line = sys.stderr.isatty()
    result = fly(request, progress_line(sys.stderr) if with_line else None)
    if with_line:
        sys.stderr.write("\r\x1b[K")
    # A service that is asked to stop does not read days of packets first.
    control = None if options.archive else read_run(result.folder)["control"]
    _print_result(result, control, time.perf_counter() - begun, options.json)
    for problem in filter(None, (result.log_error, result.restart)):
        sys.stderr.write(f"flight: {problem}\n")
    # A service manager restarts a service that failed.
    return 1 if result.log_error or result.restart else 0


def _print_result(result: RunResult, control: PacketArray | None, elapsed: float, as_json: bool) -> None:
    """Print how the flight went; `control` are its control packets, `elapsed` the seconds it took."""
    seconds = elapsed
    if control is not None:
        seconds = float(control["time_ns"][-1]) * 1e-9 if len(control) else 0.0
    if as_json:
        facts = {
            "folder": str(result.folder),
            "reason": result.reason,
            "interrupted": result.interrupted,
            "mission_time_s": seconds,
            "elapsed_s": elapsed,
            "packets": None if control is None else len(control),
            "log_error": result.log_error or None,
            "faults": result.faults,
        }
        sys.stdout.write(json.dumps(facts) + "\n")
        return
    faults = f"faults: {'; '.join(result.faults)}\n" if result.faults else ""
    sys.stdout.write(
        f"flown: {seconds:.0f} s in {elapsed:.1f} s, {result.reason}\n"
        f"{faults}"
        f"log:   {result.folder}\n"
        f"next:  {PROGRAM} report {result.folder}\n"
    )


def progress_line(stream: TextIO) -> Callable[[Progress], None]:
    """Return a function that rewrites one line of progress, at most five times a second."""
    last = 0.0

    def show(progress: Progress) -> None:
        nonlocal last
        now = time.perf_counter()
        if now - last < 0.2:
            return
        last = now
        of = f"/{progress.duration:.0f}"
        currents = " ".join(f"{1e3 * current:+.1f}" for current in progress.currents)
        stream.write(
            f"\r\x1b[K{progress.mission_time:6.0f}{of} s  {progress.attitude}  "
            f"coils {currents} mA  {progress.state}  "
            f"slips {progress.slips}  events {progress.events}"
        )
        stream.flush()

    return show


def seed_number(text: str) -> int:
    """Return the seed that an argument gives. Raises ArgumentTypeError unless the log can hold it."""
    try:
        value = int(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number") from error
    if not 0 <= value < 2**64:
        raise argparse.ArgumentTypeError(f"{text}: give a whole number from 0 to 2^64 - 1")
    return value
