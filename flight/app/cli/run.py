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
from flight.app.request import RunRequest
from flight.link.telemetry.reader import read_run
from flight.loop.progress import Progress
from flight.schema.carried import config_path, names


def configure(parser: argparse.ArgumentParser) -> None:
    """Tell the parser what this command takes."""
    parser.description = (
        "Fly a configuration: on real devices, or on simulated ones where it has a simulation "
        "section. Simulated flights run as fast as they can; --realtime flies them on the machine's clock, "
        "the devices in a process of their own. Ctrl-C ends a flight, coils at zero, log whole."
    )
    parser.add_argument(
        "config",
        type=config_path,
        metavar="CONFIG",
        help=f"YAML file, or a carried name: {', '.join(names())}",
    )
    place = parser.add_mutually_exclusive_group()
    place.add_argument("--out", type=Path, metavar="DIR", help="folder of the run (default runs/NAME-TIME)")
    place.add_argument("--archive", type=Path, metavar="DIR", help="folder of a board's runs: fly the next")
    parser.add_argument("--duration", type=float, metavar="S", help="fly so many seconds instead")
    parser.add_argument("--seed", type=seed_number, metavar="N", help="seed of the simulation instead")
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
        help="break something in the simulation, as 'imu: silent @ 120 for 5'; may be given again (below)",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object when done")
    parser.set_defaults(command=run)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    plain = parser.format_help
    parser.format_help = lambda: plain() + _faults_help()  # type: ignore[method-assign]  # the list is slow to load


def _faults_help() -> str:
    """Return how faults are written, and all of them."""
    from flight.app.simulated import fault_catalogue  # noqa: PLC0415 - for those who ask for help only

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
    elapsed = time.perf_counter() - begun
    # A service that is told to stop does not read days of packets first.
    flown = None if options.archive else read_run(result.folder)["control"]
    seconds = elapsed if flown is None else float(flown["time_ns"][-1]) * 1e-9 if len(flown) else 0.0
    if options.json:
        facts = {
            "folder": str(result.folder),
            "reason": result.reason,
            "interrupted": result.interrupted,
            "mission_time_s": seconds,
            "elapsed_s": elapsed,
            "packets": None if flown is None else len(flown),
            "log_error": result.log_error or None,
            "faults": result.faults,
        }
        sys.stdout.write(json.dumps(facts) + "\n")
    else:
        broken = f"faults: {'; '.join(result.faults)}\n" if result.faults else ""
        sys.stdout.write(
            f"flown: {seconds:.0f} s in {elapsed:.1f} s, {result.reason}\n"
            f"{broken}"
            f"log:   {result.folder}\n"
            f"next:  {PROGRAM} report {result.folder}\n"
        )
    for problem in filter(None, (result.log_error, result.restart)):
        sys.stderr.write(f"flight: {problem}\n")
    # A service manager starts again what ends with a failure.
    return 1 if result.log_error or result.restart else 0


def progress_line(stream: TextIO) -> Callable[[Progress], None]:
    """Return what writes one line again and again, a few times a second at most."""
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
    """Return the seed that an argument gives. Raises ArgumentTypeError below zero."""
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text} is below zero")
    return value
