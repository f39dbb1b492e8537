"""The commands `knightcube run`, which flies a configuration, and `knightcube check`.

The function `probe` looks for the real devices that a configuration names. The function starts cameras and
separate sensors, writes no settings to other devices, and drives no coil. A device that does not respond is
reported together with the suggested remedy. The serial ports, the cameras and the separate sensors that a
running flight uses are reported as busy.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np

from flight.app.cli import PROGRAM, complain, to_json
from flight.app.devices import (
    NO_CAMERA,
    NO_INDEX,
    check_settings,
    check_simulated_elements,
    fault_catalogue,
    open_camera,
    real_rig,
)
from flight.app.run import RunRequest, RunResult
from flight.link.telemetry.log import find_segments
from flight.link.telemetry.packets import LAYOUTS, walk
from flight.schema import reader as configuration
from flight.schema.bodies import OrbitConfig
from flight.schema.devices import (
    Camera,
    SensorsSection,
    WideCamera,
    driver_of,
    fitted_devices,
    structure_mask,
)
from flight.schema.document import ConfigError, config_path, names, read_document
from flight.schema.sections import Config
from hal.interfaces.errors import DeviceError, NotResponding
from hal.interfaces.wires import LATE_NS
from knightcube.compiled import report_compilations
from knightcube.errors import KnightCubeError, UsageError, reason_of

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
    """Add the arguments of the command `run` to the parser."""
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
    parser.add_argument(
        "--duration", type=float, metavar="S", help="duration that replaces the configured one"
    )
    parser.add_argument("--seed", type=seed_number, metavar="N", help="seed that replaces the configured one")
    parser.add_argument(
        "--realtime", action="store_true", help="run simulated devices on the machine's clock"
    )
    parser.add_argument(
        "--devices",
        type=Path,
        metavar="FILE",
        help="with --realtime: use the simulated devices of `python -m sim_hal serve --facts FILE`",
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
    plain = parser.format_help
    parser.format_help = lambda: plain() + _faults_help()  # type: ignore[method-assign]  # the list is slow to load


def _faults_help() -> str:
    """Return a text with the syntax of fault specifications and a list of all faults."""
    grammar, listing = fault_catalogue()
    return (
        f"\nfaults: {grammar}\n"
        "  Seconds are of mission time; without @ a fault begins at 0, without `for` it lasts to the end.\n"
        "  The number 0 of a camera, string or panel means all of them.\n"
        "  In a configuration: simulation: {faults: [{fault: 'imu: silent', at: 120, for: 5}]}\n"
        f"\n{listing}\n"
    )


REFUSED = 78
"""Exit status of a service whose configuration is wrong (EX_CONFIG of sysexits.h).

The service manager restarts the service after any other failure. The exit status of other usage errors, 2, is
not used, because a shell that temporarily cannot start the service also ends with status 2.
"""


def run(options: argparse.Namespace) -> int:
    """Fly, show progress on standard error, and print the summary."""
    try:
        return _flown(options)
    except (OSError, UsageError) as error:
        if options.archive is None:
            raise
        if isinstance(error, UsageError):
            return complain(str(error), REFUSED)
        raise KnightCubeError(str(error)) from error  # the service manager restarts the service


def _flown(options: argparse.Namespace) -> int:
    from flight.app.flight import fly  # noqa: PLC0415 - no other command needs devices
    from flight.app.run import default_folder  # noqa: PLC0415
    from flight.app.service import StoppedError  # noqa: PLC0415

    request = RunRequest(
        options.config,
        options.out or options.archive or default_folder(options.config),
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
    if sys.stderr.isatty():
        sys.stderr.write("\r\x1b[K")
    elapsed = time.perf_counter() - begun
    if options.json:
        sys.stdout.write(to_json(summary_facts(result, elapsed)))
    else:
        sys.stdout.write(summary_text(result, elapsed))
    for problem in filter(None, (result.log_error, result.restart)):
        sys.stderr.write(f"knightcube: {problem}\n")
    # The exit status 1 makes a service manager restart the service.
    return 1 if result.log_error or result.restart else 0


def progress_on(stream: TextIO) -> Callable[[FlightProgress], None]:
    """Return a function that shows progress in one line of a terminal, or otherwise as a line every 10 s.

    While a first flight waits for numba, the line names the function that numba compiles.
    """
    terminal = stream.isatty()
    period, before, after = (0.2, "\r\x1b[K", "") if terminal else (10.0, "", "\n")
    last = time.perf_counter()

    def write(text: Callable[[], str]) -> None:
        nonlocal last
        now = time.perf_counter()
        if now - last < period:
            return
        last = now
        # A full disk, or a stream that is closed when numba compiles later, must not affect the flight.
        with suppress(OSError, ValueError):
            stream.write(f"{before}{text()}{after}")
            stream.flush()

    def show(progress: FlightProgress) -> None:
        write(lambda: _progress_text(progress))

    report_compilations(lambda name: write(lambda: f"compiling {name} for this machine, once"))
    return show


def _progress_text(progress: FlightProgress) -> str:
    currents = " ".join(f"{1e3 * current:+.1f}" for current in progress.currents)
    return (
        f"{progress.mission_time:6.0f}/{progress.duration:.0f} s  {progress.attitude}  "
        f"coils {currents} mA  {progress.state}  slips {progress.slips}  events {progress.events}"
    )


def seed_number(text: str) -> int:
    """Return the seed given as an argument. Raises ArgumentTypeError unless it is 0 to 2^64 - 1."""
    try:
        value = int(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 0 to 2^64 - 1") from error
    if not 0 <= value < 2**64:
        raise argparse.ArgumentTypeError(f"{text}: give a whole number from 0 to 2^64 - 1")
    return value


@dataclass(frozen=True, slots=True)
class Probed:
    """Check result of a device or file: its configuration name, address, and response or suggested remedy."""

    name: str
    place: str
    found: bool
    text: str


def probe(config: Config) -> list[Probed]:
    """Return the check result of each device, file and folder that the configuration needs."""
    sections = fitted_devices(config)
    sections += [("camera", "camera", config.camera)] if config.camera is not None else []
    sections += [(f"wide_cameras[{k}]", "camera", camera) for k, camera in enumerate(config.wide_cameras)]
    with ExitStack() as cameras:
        return [_probed(config, cameras, *named) for named in sections] + list(_files(config))


def _probed(config: Config, cameras: ExitStack, name: str, kind: str, section: Any) -> Probed:
    """Check whether one device responds, over connections that are opened for this check.

    All cameras stay open until `cameras` closes them, because cameras that can be opened separately may
    together exceed the bandwidth of a USB bus. Separate sensors are started for the check, which would
    disturb a flight that reads them. The bus of the coils is therefore locked first, as in a flight.
    """
    camera = isinstance(section, Camera | WideCamera)
    driver = driver_of(kind, section.device if camera else section)
    place = ", ".join(driver.files(section) or driver_of("coils", config.coils).files(config.coils))
    place = getattr(section.device, "name", "") or place if camera else place
    with ExitStack() as own:
        stack = cameras if camera else own
        rig = real_rig(config, stack)
        try:
            if camera:
                open_camera(section, rig, stack)
            if isinstance(section, SensorsSection):
                with suppress(NotResponding):  # sensors on other buses do not need the bus of the coils
                    real_rig(config, own, exclusive=True).wires.i2c()
            return Probed(name, place, True, driver.probe(rig, section))
        except DeviceError as error:
            return Probed(name, place, False, error.message)


def _files(config: Config) -> Iterator[Probed]:
    tracker = config.camera.star_tracker if config.camera is not None else None
    if tracker is not None and tracker.index is not None:
        there = Path(tracker.index).is_file()
        yield Probed("camera.star_tracker.index", tracker.index, there, "is there" if there else NO_INDEX)
    for index, camera in enumerate(config.wide_cameras):
        if camera.structure_file is not None:
            try:
                text, there = f"hides {100.0 * float(structure_mask(camera).mean()):.0f} % of the image", True
            except UsageError as error:
                text, there = str(error), False
            yield Probed(f"wide_cameras[{index}].structure_file", camera.structure_file, there, text)
    if config.commands.socket is not None:
        there = Path(config.commands.socket).parent.is_dir()
        cure = "no such folder: systemd creates it for a service (RuntimeDirectory), otherwise create it"
        yield Probed("commands.socket", config.commands.socket, there, "has its folder" if there else cure)


FLOWN_S = 10.0


@dataclass(slots=True)
class CheckResult:
    """The result of a check; the configuration is ready to fly if the list `problems` is empty.

    The list `warnings` has what the configuration cannot do.
    """

    config: Config
    path: Path
    chain: tuple[str, ...] = ()
    problems: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    devices: list[Any] = field(default_factory=list)
    result: RunResult | None = None
    elapsed: float = 0.0


def configure_check(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command `check` to the parser."""
    parser.description = (
        "Check a configuration before a flight. Its values are validated. If it names real devices, each "
        "device must answer. Cameras and separate sensors are started, but no coil is driven. A missing "
        "device is reported with the remedy. If it has a simulation section, ten seconds of flight are "
        "simulated in lock-step. Exit status 0: ready; 1: not ready; 2: the configuration is refused."
    )
    carried = ", ".join(names())
    parser.add_argument("config", type=config_path, metavar="CONFIG", help=f"YAML file, or one of {carried}")
    parser.add_argument(
        "--merged", type=Path, metavar="FILE", help="write CONFIG and the files that it extends as one file"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(command=check)


def check(options: argparse.Namespace) -> int:
    """Check a configuration, print the result, and return 1 if it is not ready to fly."""
    from flight.app.flight import placing  # noqa: PLC0415
    from flight.app.service import accepted_config  # noqa: PLC0415

    chosen = accepted_config(options.config, os.environ)
    path = chosen.path
    config = configuration.parse(chosen.text, str(path))
    chain = read_document(chosen.text, str(path)).chain
    verdict = CheckResult(config, path, chain, [chosen.problem] if chosen.problem else [])
    verdict.warnings += _shortcomings(config)
    if options.merged is not None:
        _write(options.merged, configuration.merged_text(chosen.text, str(path)))
    with placing(chosen.text, str(path)):
        check_values(config)
        if config.simulation is None:
            verdict.devices = probe(config)
            verdict.problems += [f"{item.name}: missing" for item in verdict.devices if not item.found]
        else:
            check_simulated_elements(RunRequest(path, Path()), chosen.text, config)
            _check_unused_paths(verdict)
            _fly(verdict)
    sys.stdout.write(to_json(_facts(verdict)) if options.json else _text(verdict))
    return 1 if verdict.problems else 0


def check_values(config: Config) -> None:
    """Raise ConfigError for a configuration that cannot be flown, regardless of which devices respond.

    Every plan of a satellite needs a GPS receiver or two-line elements to predict the magnetic field.
    """
    from flight.app.flight import body_kind  # noqa: PLC0415

    body_kind(config)
    check_settings(config)
    cameras: dict[str, Camera | WideCamera | None] = {"camera": config.camera}
    cameras |= {f"wide_cameras[{number}]": camera for number, camera in enumerate(config.wide_cameras)}
    for name, camera in cameras.items():
        if config.simulation is None and camera is not None and camera.device is None:
            raise ConfigError(f"{name}.device", f"is missing: {NO_CAMERA}")
    if isinstance(config, OrbitConfig) and config.gps is None and config.elements is None:
        target = config.targets[0].point
        cure = "add `gps`, or `elements`, which `knightcube elements` makes"
        raise ConfigError("targets[0].point", f"is {target}: pointing needs the satellite's position: {cure}")


def _shortcomings(config: Config) -> list[str]:
    """Return what a satellite cannot do with its devices."""
    stars = config.camera is not None and config.camera.star_tracker is not None
    if (
        not isinstance(config, OrbitConfig)
        or stars
        or config.wide_cameras
        or config.solar_strings is not None
    ):
        return []
    lacks = "no star tracker (`camera.star_tracker`), no `wide_cameras` and no `solar_strings`"
    return [f"{lacks}: the attitude stays unknown, and the satellite never points to `targets`"]


def _write(path: Path, text: str) -> None:
    """Write a new file. Raises UsageError if the file exists or cannot be written."""
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except OSError as error:
        raise UsageError(f"--merged {path}: cannot be written: {reason_of(error)}") from error


def _check_unused_paths(verdict: CheckResult) -> None:
    """Add problems of the command socket and the state folder, which the flight of a check does not use."""
    socket, state = verdict.config.commands.socket, verdict.config.state.folder
    if socket is not None and (reason := _unwritable(Path(socket).parent)):
        verdict.problems.append(f"commands.socket: cannot be created: {reason}")
    if state is not None:
        there = next(folder for folder in (Path(state), *Path(state).absolute().parents) if folder.exists())
        if reason := _unwritable(there):
            verdict.warnings.append(f"state.folder: the state cannot be stored: {reason}")


def _unwritable(folder: Path) -> str:
    """Return why no file can be created in a folder, or "" if files can be created."""
    try:
        tempfile.TemporaryDirectory(dir=folder).cleanup()
    except OSError as error:
        return f"{folder}: {error.strerror}: create it, or correct its permissions"
    return ""


def _fly(verdict: CheckResult) -> None:
    """Fly the first seconds of a configuration in lock-step simulation, with logs in a temporary folder."""
    from flight.app.flight import fly  # noqa: PLC0415

    duration, begun = min(FLOWN_S, verdict.config.duration), time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="knightcube-check-") as folder:
        verdict.result = fly(RunRequest(verdict.path, Path(folder) / "run", duration=duration, trial=True))
        verdict.elapsed = time.perf_counter() - begun
        if not verdict.result.faults:
            problems, warnings = gyro_units(verdict.config, Path(folder) / "run")
            verdict.problems += problems
            verdict.warnings += warnings
    verdict.problems += flight_problems(verdict.result)


_DEGREE = 180.0 / math.pi


def gyro_units(config: Config, folder: Path) -> tuple[list[str], list[str]]:
    """Return problems and warnings about the gyro's unit: logged rates are compared with simulated rates.

    It is a problem if a driver returns deg/s, or multiplies rad/s by pi / 180. Such a driver is not found if
    the body is almost at rest. The warning is that the noise of the gyro is probably configured in deg/s.
    """
    imu, truth = _rows(folder, "flight", "imu"), _rows(folder, "truth", "truth")
    imu = imu[np.isfinite(imu["rate"]).all(axis=1)]
    if len(imu) < 2 or len(truth) < 2:
        return [], []
    times = imu["sample_time_ns"].astype(float)
    true = np.stack([np.interp(times, truth["time_ns"], rate) for rate in truth["rate"].T], axis=1)
    square = float((true * true).sum())
    scale = float((imu["rate"] * true).sum()) / square if square > 0.0 else math.nan
    left = imu["rate"] - scale * true
    noise = float(np.median(np.std(left, axis=0)))
    for factor in (_DEGREE, 1.0 / _DEGREE):
        if abs(scale / factor - 1.0) < 0.2 and 5.0 * noise < 0.2 * factor * math.sqrt(square):
            found = f"the gyro of `inertial_unit` measures {scale:.3g} times the simulated rate"
            return [f"{found}: its driver must return rad/s, and convert deg/s once"], []
    stated = config.inertial_unit.rate_noise
    if abs(stated / max(noise, 1e-9) / _DEGREE - 1.0) < 0.3:
        found = f"`inertial_unit.rate_noise` is {stated:g}, and the simulated gyro has {noise:.2g} rad/s"
        return [], [f"{found}: give rad/s, not deg/s"]
    return [], []


def _rows(folder: Path, stem: str, name: str) -> Any:
    """Return the packets called `name` of a log as a structured array."""
    data = b"".join(path.read_bytes() for path in find_segments(folder, stem))
    layout = LAYOUTS[name]
    return layout.array(b"".join(data[begin:end] for kind, begin, end in walk(data) if kind == layout))


def flight_problems(result: RunResult) -> list[str]:
    """Return the problems of a flight, with events and alarms only if no faults were injected."""
    ending = result.ending
    problems = [text for text in (result.log_error, result.restart, ending.coil_error) if text]
    if result.interrupted:
        problems.append(f"the flight was {result.reason}")
    if not ending.coils_at_zero and not ending.coil_error:
        problems.append("the coil currents are not zero at the end")
    if not result.faults:
        problems += [f"alarm: {with_cause(name, ending)}" for name in ending.alarms]
        problems += [
            f"fault noticed: {with_cause(name, ending, f' ({count})')}"
            for name, count in sorted(ending.faults.items())
        ]
    return problems


def with_cause(name: str, ending: FlightEnding, count: str = "") -> str:
    """Return the name of an alarm or event, its `count` and its cause, which is the text of the event."""
    cause = ending.causes.get(name, "")
    return f"{name}{count}: {cause}" if cause else f"{name}{count}"


def _facts(verdict: CheckResult) -> dict[str, Any]:
    config, result = verdict.config, verdict.result
    flown = None if result is None else summary_facts(result, verdict.elapsed)
    return {
        "config": str(verdict.path),
        "extends": list(verdict.chain[1:]),
        "name": config.name,
        "body": config.body,
        "simulated": config.simulation is not None,
        "devices": [asdict(item) for item in verdict.devices],
        "drivers": _drivers(config),
        "flight": flown,
        "problems": verdict.problems,
        "warnings": verdict.warnings,
        "ready": not verdict.problems,
    }


def _drivers(config: Config) -> dict[str, str]:
    """Return the name of the driver of each device, and the part of each of its sensors, by dotted key."""
    found = {}
    for key, _, section in fitted_devices(config):
        found[key] = str(getattr(section, "driver", None) or section.__struct_config__.tag)
        for number, sensor in enumerate(getattr(section, "sensors", ())):
            found[f"{key}.sensors[{number}]"] = sensor.part
    cameras: list[tuple[str, Camera | WideCamera]] = []
    cameras += [("camera", config.camera)] if config.camera is not None else []
    cameras += [(f"wide_cameras[{number}]", camera) for number, camera in enumerate(config.wide_cameras)]
    for key, camera in cameras:
        if camera.device is not None:
            found[key] = str(camera.device.__struct_config__.tag)
    return found


def _text(verdict: CheckResult) -> str:
    config, result = verdict.config, verdict.result
    foreign = [f"{key} {name}" for key, name in _drivers(config).items() if ":" in name]
    devices = "simulated" if config.simulation is not None else f"{len(verdict.devices)} checked"
    lines = [
        ("configuration", f"{verdict.path}: {config.name}, valid"),
        *(("extends", name) for name in verdict.chain[1:]),
        ("flight", f"body {config.body}, {config.duration:g} s"),
        ("devices", "; ".join((devices, *foreign))),
    ]
    lines += [
        ("", f"{'found' if item.found else 'MISSING':8} {item.name}, {item.place}: {item.text}")
        for item in verdict.devices
    ]
    if result is not None:
        ending = result.ending
        noticed = f"{counts_text(ending.faults, 'faults')}; {counts_text(ending.warnings, 'warnings')}"
        lines.append(("flown", f"{ending.mission_time:.0f} s in lock-step; mode {ending.mode}"))
        lines += [("battery", ending.power)] if ending.power else []
        lines.append(("noticed", noticed))
        lines += [("", with_cause(name, ending)) for name in sorted(ending.warnings)]
        if result.faults:
            lines.append(("injected", "; ".join(result.faults)))
    lines += [("warning", warning) for warning in verdict.warnings]
    lines += [("problem", problem) for problem in verdict.problems]
    warned = verdict.warnings or (result is not None and result.ending.warnings and not result.faults)
    ready = "ready, with warnings: see above" if warned else "ready"
    lines.append(("verdict", "not ready" if verdict.problems else ready))
    return "".join(f"{name + ':' if name else '':15}{text}\n" for name, text in lines)
