"""The command `knightcube check`, which checks whether a configuration can be flown at present.

The function `probe` looks for the real devices that a configuration names. No device is configured, and no
coil is driven. A device that does not respond is reported together with the suggested remedy. The serial port
and the camera that a running flight uses are reported as busy.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flight.app.cli.run import counts_text, summary_facts
from flight.app.devices import NO_CAMERA, open_camera, real_rig
from flight.app.run import RunRequest, RunResult
from flight.schema import reader as configuration
from flight.schema.devices import Camera, WideCamera, driver_of, fitted_devices, structure_mask
from flight.schema.document import ConfigError, config_path, merged_text, names, read_document
from flight.schema.orbit import OrbitConfig
from flight.schema.sections import Config
from hal.interfaces.errors import DeviceError
from knightcube.errors import UsageError

if TYPE_CHECKING:  # see `flight.app.run`
    from flight.loop.flight_loop import FlightEnding


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
    return [_probed(config, *named) for named in sections] + list(_files(config))


def _probed(config: Config, name: str, kind: str, section: Any) -> Probed:
    """Check whether one device responds, over connections that are opened for this check."""
    camera = isinstance(section, Camera | WideCamera)
    driver = driver_of(kind, section.device if camera else section)
    place = ", ".join(driver.files(section) or driver_of("coils", config.coils).files(config.coils))
    place = getattr(section.device, "name", "") or place if camera else place
    with ExitStack() as stack:
        rig = real_rig(config, stack)
        try:
            if camera:
                open_camera(section, rig, stack)
            return Probed(name, place, True, driver.probe(rig, section))
        except DeviceError as error:
            return Probed(name, place, False, error.message)


def _files(config: Config) -> Iterator[Probed]:
    tracker = config.camera.star_tracker if config.camera is not None else None
    if tracker is not None and tracker.index is not None:
        there = Path(tracker.index).is_file()
        cure = "no such file: make it with `knightcube index --camera CONFIG --out FILE`"
        yield Probed("camera.star_tracker.index", tracker.index, there, "is there" if there else cure)
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
    """The result of a check; the configuration is ready to fly if the list `problems` is empty."""

    config: Config
    path: Path
    chain: tuple[str, ...] = ()
    problems: list[str] = field(default_factory=list)
    devices: list[Any] = field(default_factory=list)
    result: RunResult | None = None
    elapsed: float = 0.0


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this command to the parser."""
    parser.description = (
        "Check a configuration before a flight. Its values are validated. If it names real devices, each "
        "device must answer; no device is configured and no coil is driven. A missing device is reported "
        "with the remedy. If it has a simulation section, ten seconds of flight are simulated in lock-step. "
        "Exit status 0: ready; 1: not ready; 2: the configuration is refused."
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
    from flight.app.cli.check import probe  # noqa: PLC0415
    from flight.app.devices import check_simulated_elements  # noqa: PLC0415
    from flight.app.flight import placing  # noqa: PLC0415
    from flight.app.service import accepted_config  # noqa: PLC0415

    chosen = accepted_config(options.config, os.environ)
    path = chosen.path
    config = configuration.parse(chosen.text, str(path))
    chain = read_document(chosen.text, str(path)).chain
    verdict = CheckResult(config, path, chain, [chosen.problem] if chosen.problem else [])
    if options.merged is not None:
        _write(options.merged, merged_text(chosen.text, str(path)))
    with placing(chosen.text, str(path)):
        check_values(config)
        if config.simulation is None:
            verdict.devices = probe(config)
            verdict.problems += [f"{item.name}: missing" for item in verdict.devices if not item.found]
        else:
            check_simulated_elements(RunRequest(path, Path()), chosen.text, config)
            _fly(verdict)
    sys.stdout.write(json.dumps(_facts(verdict)) + "\n" if options.json else _text(verdict))
    return 1 if verdict.problems else 0


def check_values(config: Config) -> None:
    """Raise ConfigError for a configuration that cannot be flown, regardless of which devices respond.

    For example, the configuration of a satellite must contain a GPS receiver or two-line elements, because
    every plan predicts the magnetic field along the orbit.
    """
    from flight.app.devices import check_settings  # noqa: PLC0415
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


def _write(path: Path, text: str) -> None:
    """Write a new file. Raises UsageError if the file exists or cannot be written."""
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except OSError as error:
        raise UsageError(f"--merged {path}: cannot be written: {error.strerror or error}") from error


def _fly(verdict: CheckResult) -> None:
    """Fly the first seconds of a configuration in lock-step simulation, with logs in a temporary folder."""
    from flight.app.flight import fly  # noqa: PLC0415

    duration, begun = min(FLOWN_S, verdict.config.duration), time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="knightcube-check-") as folder:
        verdict.result = fly(RunRequest(verdict.path, Path(folder) / "run", duration=duration))
    verdict.elapsed = time.perf_counter() - begun
    verdict.problems += flight_problems(verdict.result)


def flight_problems(result: RunResult) -> list[str]:
    """Return a text for each problem in the result of a flight.

    Events and alarms are problems only if no faults were injected.
    """
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
        "flight": flown,
        "problems": verdict.problems,
        "ready": not verdict.problems,
    }


def _text(verdict: CheckResult) -> str:
    config, result = verdict.config, verdict.result
    lines = [
        ("configuration", f"{verdict.path}: {config.name}, valid"),
        *(("extends", name) for name in verdict.chain[1:]),
        ("to fly", f"body {config.body}, {config.duration:g} s"),
        ("devices", "simulated" if config.simulation is not None else f"{len(verdict.devices)} looked for"),
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
    lines += [("problem", problem) for problem in verdict.problems]
    lines.append(("verdict", "not ready" if verdict.problems else "ready"))
    return "".join(f"{name + ':' if name else '':15}{text}\n" for name, text in lines)
