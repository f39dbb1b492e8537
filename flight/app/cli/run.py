"""The command `knightcube run`, which runs a flight with a configuration and prints a summary of it."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from flight.app.cli import PROGRAM
from flight.app.run import RunRequest, RunResult
from flight.schema.document import config_path, names
from hal.interfaces.wires import LATE_NS
from knightcube.errors import FlightError

if TYPE_CHECKING:  # see `flight.app.run`
    from flight.loop.flight_loop import FlightEnding, FlightProgress


def summary_text(result: RunResult, elapsed: float) -> str:
    """Return the summary of a flight that took `elapsed` s of real time, as lines of text."""
    ending = result.ending
    lines = [
        ("flown", f"{ending.mission_time:.0f} s in {elapsed:.1f} s, {result.reason}"),
        ("mode", ending.mode),
        ("alarms", ", ".join(ending.alarms) or "none"),
        ("noticed", counts_text(ending.faults, "faults") + "; " + counts_text(ending.warnings, "warnings")),
        ("coils", _coils(ending)),
    ]
    if result.faults:
        lines.append(("injected", "; ".join(result.faults)))
    if result.devices_late is not None and result.devices_late[0]:
        count, longest = result.devices_late
        text = (
            f"emulated devices late by more than {1e-6 * LATE_NS:g} ms {count} times, at most {longest:.2f} s"
        )
        lines.append(
            ("devices", f"{text}: the emulation, not the flight software, causes gaps in their readings")
        )
    lines += [("log", str(result.folder)), ("next", f"{PROGRAM} report {result.folder}")]
    return "".join(f"{name + ':':10}{text}\n" for name, text in lines)


def summary_facts(result: RunResult, elapsed: float) -> dict[str, Any]:
    """Return the summary of a flight for the option `--json`."""
    ending = result.ending
    return {
        "folder": str(result.folder),
        "reason": result.reason,
        "interrupted": result.interrupted,
        "mission_time_s": ending.mission_time,
        "elapsed_s": elapsed,
        "packets": ending.cycles,
        "mode": ending.mode,
        "alarms": ending.alarms,
        "noticed_faults": dict(ending.faults),
        "noticed_warnings": dict(ending.warnings),
        "causes": dict(ending.causes),
        "coils_at_zero": ending.coils_at_zero,
        "coils_left_out": ending.coils_left_out,
        "log_error": result.log_error or None,
        "faults": result.faults,
        "devices_late": result.devices_late and result.devices_late[0],
        "devices_late_max_s": result.devices_late and result.devices_late[1],
    }


def counts_text(counts: Mapping[str, int], noun: str) -> str:
    """Return the number of events of each kind as a phrase."""
    if not counts:
        return f"no {noun}"
    return f"{noun} " + ", ".join(f"{name} ({count})" for name, count in sorted(counts.items()))


def _coils(ending: FlightEnding) -> str:
    state = "at zero" if ending.coils_at_zero else f"NOT confirmed at zero: {ending.coil_error}"
    left_out = ", ".join(ending.coils_left_out)
    return f"{state}; left out: {left_out}" if left_out else state


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this command to the parser."""
    parser.description = (
        "Run the flight of a configuration on real devices, or on simulated devices if it has a simulation "
        "section. Simulated flights run as fast as they can; with --realtime they run on the machine's "
        "clock, with the devices in a process of their own. Ctrl-C ends a flight with the coils at zero and "
        "the log closed."
    )
    carried = ", ".join(names())
    parser.add_argument("config", type=config_path, metavar="CONFIG", help=f"YAML file, or one of {carried}")
    place = parser.add_mutually_exclusive_group()
    place.add_argument("--out", type=Path, metavar="DIR", help="folder of the run (default runs/NAME-TIME)")
    place.add_argument(
        "--archive", type=Path, metavar="DIR", help="folder of all runs of a board; this run is added"
    )
    parser.add_argument("--duration", type=float, metavar="S", help="another duration")
    parser.add_argument("--seed", type=seed_number, metavar="N", help="seed of the simulation")
    parser.add_argument(
        "--realtime", action="store_true", help="run simulated devices on the machine's clock"
    )
    parser.add_argument(
        "--devices",
        type=Path,
        metavar="FILE",
        help="use the simulated devices of `python -m sim_hal serve --facts FILE`; with --realtime",
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
    """Return a text with the syntax of fault specifications and a list of all faults."""
    from flight.app.devices import fault_catalogue  # noqa: PLC0415 - only --help needs it

    grammar, listing = fault_catalogue()
    return (
        f"\nfaults: {grammar}\n"
        "  Seconds are of mission time; without @ a fault begins at 0, without `for` it lasts to the end.\n"
        "  In a configuration: simulation: {faults: [{fault: 'imu: silent', at: 120, for: 5}]}\n"
        f"\n{listing}\n"
    )


def run(options: argparse.Namespace) -> int:
    """Fly, show progress on standard error, and print the summary."""
    from flight.app.flight import fly  # noqa: PLC0415 - no other command needs devices
    from flight.app.run import default_folder  # noqa: PLC0415
    from flight.app.service import StoppedError  # noqa: PLC0415

    request = RunRequest(
        options.config,
        options.out or default_folder(options.config),
        options.realtime,
        options.duration,
        options.seed,
        options.devices,
        options.archive,
        tuple(options.fault),
        accepted=True,
    )
    begun = time.perf_counter()
    # A service shows no progress in the journal, because its flight log contains everything.
    progress = None if options.archive and not sys.stderr.isatty() else progress_on(sys.stderr)
    try:
        result = fly(request, progress)
    except StoppedError as error:  # a signal interrupted the service's start
        sys.stderr.write(f"knightcube: {error}\n")
        return 0
    except OSError as error:
        if options.archive is None:
            raise
        raise FlightError(str(error)) from error  # the service manager restarts the service
    if sys.stderr.isatty():
        sys.stderr.write("\r\x1b[K")
    elapsed = time.perf_counter() - begun
    if options.json:
        sys.stdout.write(json.dumps(summary_facts(result, elapsed)) + "\n")
    else:
        sys.stdout.write(summary_text(result, elapsed))
    for problem in filter(None, (result.log_error, result.restart)):
        sys.stderr.write(f"knightcube: {problem}\n")
    # The exit status 1 makes a service manager restart the service.
    return 1 if result.log_error or result.restart else 0


def progress_on(stream: TextIO) -> Callable[[FlightProgress], None]:
    """Return a function that shows progress in one line of a terminal, or otherwise as a line every 10 s."""
    terminal = stream.isatty()
    period, before, after = (0.2, "\r\x1b[K", "") if terminal else (10.0, "", "\n")
    last = time.perf_counter()

    def show(progress: FlightProgress) -> None:
        nonlocal last
        now = time.perf_counter()
        if now - last < period:
            return
        last = now
        of = f"/{progress.duration:.0f}"
        currents = " ".join(f"{1e3 * current:+.1f}" for current in progress.currents)
        with suppress(OSError):  # an error such as a full disk must not affect the flight
            stream.write(
                f"{before}{progress.mission_time:6.0f}{of} s  {progress.attitude}  "
                f"coils {currents} mA  {progress.state}  "
                f"slips {progress.slips}  events {progress.events}{after}"
            )
            stream.flush()

    return show


def seed_number(text: str) -> int:
    """Return the seed given as an argument.

    Raises ArgumentTypeError if the seed is not a whole number from 0 to 2^64 - 1.
    """
    try:
        value = int(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 0 to 2^64 - 1") from error
    if not 0 <= value < 2**64:
        raise argparse.ArgumentTypeError(f"{text}: give a whole number from 0 to 2^64 - 1")
    return value
