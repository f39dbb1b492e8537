"""Command `knightcube identify`, which estimates the constants of a body from a flight.

For the testbed, the command executes a flight with current pulses in a coil and fits the constants of the
plant. The attitude filter of a satellite estimates the inertia and the properties of coils and sensors in
every flight, so for a satellite the command only reads the folder of a run.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from flight.app.cli.run import progress_on, seed_number
from flight.app.run import RunRequest
from flight.schema import reader as configuration
from flight.schema.bodies import OrbitConfig, TestbedConfig
from flight.schema.document import config_path, read_text
from ground.commands.options import check_new, check_picture, positive, print_result, write_new
from ground.identification.fit import (
    DURATION,
    MAGNETOMETER_ERROR,
    NAMES,
    UNITS,
    AbsolutePlant,
    PlantFit,
    absolute,
    config_text,
    configured_constants,
    excitation_config,
    fit,
    noise_of,
    plant_text,
    prior_of,
)
from ground.identification.orbit import LearnedDescription, LearnedQuantity, fragment, learned_description
from ground.identification.record import IdentificationError, Record, read_record, reported_problems
from ground.telemetry import read_run
from knightcube.errors import UsageError

_ABSOLUTE_UNITS = {"inertia": "kg m^2", "dipole": "m^2", "field": "T"}
_ABSOLUTE_UNITS |= {"torque_constant": "N m/A", "stiffness": "N m/rad", "damping": "N m s/rad"}

_TITLES = {
    "inertia": "inertia",
    "coils": "coil matrix",
    "gyro": "gyro matrix",
    "field": "magnetometer matrix",
    "field_bias": "magnetometer bias",
    "camera": "star camera rotation",
    "gyro_bias": "gyro bias",
    "dipole": "residual dipole",
    "sunlit_dipole": "dipole in sunlight",
}


@dataclass(frozen=True, slots=True, eq=False)
class _Identified:
    """Results of an identification and their origin."""

    folder: Path
    config: TestbedConfig
    record: Record
    found: PlantFit
    plant: AbsolutePlant
    reported: list[str]

    @property
    def fragment(self) -> str:
        """Section `plant` of the configuration, as YAML text."""
        return plant_text(self.plant, self.config.plant.coil_turns, str(self.folder))


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `knightcube identify` to the parser."""
    parser.description = (
        "Identify torque constant, thread stiffness and damping from a short flight with pulses of the "
        "coil on x and free swings, on the testbed or simulated, or from the folder of an earlier flight. "
        "The motion determines the ratios to the inertia only. The scale comes from the configuration, "
        "whose section `identification` gives the errors of inertia, dipole and field, and from the "
        "magnetometer; the result states the contribution of each. The coils are off at the end. For a "
        "satellite, give the folder of a run: its filter has learned inertia, coils, sensors and residual "
        "dipole, which are compared with the configuration and written as a file that extends it."
    )
    parser.epilog = "example: knightcube identify config/testbed.yaml --out plant.yaml --picture fit.png"
    add = parser.add_argument
    text = "YAML file, name of a packaged configuration such as testbed, or the folder of a run"
    add("source", type=config_path, metavar="CONFIG", help=text)
    add("--out", type=Path, metavar="YAML", help="write the constants to this file")
    add("--run", type=Path, metavar="DIR", help="folder of the flight (default runs/NAME-TIME)")
    add("--duration", type=positive, metavar="S", help=f"duration of the flight, s (default {DURATION:g})")
    add("--seed", type=seed_number, metavar="N", help="seed of the simulation")
    add("--realtime", action="store_true", help="run simulated devices on the machine's clock")
    add("--json", action="store_true", help="print one JSON object")
    add("--picture", type=Path, metavar="PNG", help="draw measured and predicted motion")
    parser.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Fly unless the user gives the folder of a run, fit the constants, and print and write the results."""
    check_new(options.out)
    check_picture("--picture", options.picture)
    folder = Path(options.source)
    if folder.is_dir():
        for name in ("run", "duration", "seed", "realtime"):
            if getattr(options, name):
                problem = f"{options.source} is the folder of a flight, give a configuration"
                raise UsageError(f"--{name}: {problem}")
        config = configuration.load(folder / "config.yaml")
        if isinstance(config, OrbitConfig):
            return _show_learned(options, folder, config)
    else:
        folder = _fly(options)
    made = _identify(folder)
    if options.out is not None:
        write_new(options.out, made.fragment)
    print_result(options, _facts(made), _text(made) + _written(options, made.fragment))
    if options.picture is not None:
        from ground.report import draw_fit  # noqa: PLC0415

        draw_fit(made.record, made.found, options.picture)
        if not options.json:
            sys.stdout.write(f"picture: {options.picture}\n")
    return 0


def _show_learned(options: argparse.Namespace, folder: Path, config: OrbitConfig) -> int:
    if options.picture is not None:
        raise UsageError("--picture: draws the fit of a testbed flight only")
    found = learned_description(read_run(folder), config)
    place = options.out.parent if options.out is not None else Path()
    text = fragment(found, folder, os.path.relpath(folder / "config.yaml", place))
    if options.out is not None:
        write_new(options.out, text)
    quantities = {name: _quantity_facts(one) for name, one in found.quantities.items()}
    facts = {"folder": str(folder), "time_s": found.time, "quantities": quantities, "fragment": text}
    print_result(options, facts, _table(found, folder) + _written(options, text))
    return 0


def _written(options: argparse.Namespace, fragment: str) -> str:
    """Return the name of the written file, or the text for the configuration if no file was written."""
    return f"\nwritten: {options.out}\n" if options.out is not None else "\n" + fragment


def _quantity_facts(one: LearnedQuantity) -> dict[str, Any]:
    names = {"described": "described", "value": "value", "claim": "claim", "described_sigma": "prior"}
    changes = [None if math.isnan(change) else change for change in one.change.tolist()]
    values = {key: getattr(one, name).tolist() for key, name in names.items()}
    return {"unit": one.unit, "learned": one.learned, **values, "change_sigmas": changes}


def _table(found: LearnedDescription, folder: Path) -> str:
    lines = [
        f"flight: {folder}, values learned until {found.time:.0f} s",
        "",
        f"{'quantity':31s}{'described':>13s}{'learned':>13s}{'claim':>10s}{'change':>14s}",
    ]
    for one in found.quantities.values():
        values = zip(one.labels, one.described, one.value, one.claim, one.change, strict=True)
        unit = f" {one.unit}" if one.unit else ""
        for label, described, value, claim, change in values:
            title = f"{_TITLES[one.name]} {label}{unit}"
            numbers = f"{described:13.5g}{value:13.5g}{claim:10.2g}{change:+8.1f} sigma"
            lines.append(f"{title:31s}{numbers}{'' if one.learned else ', not learned'}")
    return "\n".join(lines) + "\n"


def _fly(options: argparse.Namespace) -> Path:
    if isinstance(configuration.load(options.source), OrbitConfig):
        cure = "make a run with `knightcube run`, and give its folder"
        raise UsageError(f"{options.source}: a satellite is identified from a run: {cure}")
    from flight.app.flight import fly  # noqa: PLC0415 - only a flight needs devices
    from flight.app.run import default_folder  # noqa: PLC0415

    given = configuration.load_testbed(options.source)
    if given.simulation is not None:  # errors then name the user's file and line
        from sim_hal.rig import SimulationRequest  # noqa: PLC0415 - loads the simulator

        SimulationRequest(options.source, read_text(options.source), Path()).section()
    config = excitation_config(given, options.duration or DURATION)
    out = options.run or default_folder(Path(f"{options.source.stem}-identify"))
    with_line = sys.stderr.isatty()
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / options.source.name
        path.write_text(config_text(config), encoding="utf-8")
        request = RunRequest(path, out, options.realtime, seed=options.seed)
        result = fly(request, progress_on(sys.stderr))
    if with_line:
        sys.stderr.write("\r\x1b[K")
    if result.interrupted:
        sys.stderr.write(f"knightcube: {result.reason}: the identification uses the part that was flown\n")
    if result.log_error:
        sys.stderr.write(f"knightcube: {result.log_error}\n")
    return result.folder


def _identify(folder: Path) -> _Identified:
    config = configuration.load_testbed(folder / "config.yaml")
    run = read_run(folder)
    record, reported = read_record(run, config.coils.stale_after), reported_problems(run)

    def show_round(count: int, step: float) -> None:
        sys.stderr.write(f"\r\x1b[Kfitting, round {count + 1}: the last step was {step:.2g} sigma")
        sys.stderr.flush()

    with_line = sys.stderr.isatty()
    try:
        found = fit(record, noise_of(config), show_round if with_line else None)
    except IdentificationError as error:
        because = f"; the flight reported {'; '.join(reported)}" if reported else ""
        raise IdentificationError(f"{error}{because}") from error
    if with_line:
        sys.stderr.write("\r\x1b[K")
    plant = absolute(found, prior_of(config), record.field)
    return _Identified(folder, config, record, found, plant, reported)


def _facts(made: _Identified) -> dict[str, Any]:
    found, plant, field = made.found, made.plant, made.record.field
    motion = {
        name: {"value": getattr(found.constants, name), "sigma": found.sigma(name), "unit": UNITS[name]}
        for name in NAMES
    }
    sources = plant.sources()
    scaled = {
        name: {**asdict(getattr(plant, name)), "unit": unit, "rests_on": sources[name]}
        for name, unit in _ABSOLUTE_UNITS.items()
    }
    return {
        "folder": str(made.folder),
        "duration_s": float(made.record.time[-1] - made.record.time[0]),
        "samples": len(made.record.time),
        "motion": motion,
        "motion_covariance": found.covariance.tolist(),
        "plant": scaled,
        "magnetometer_T": None if field is None else {"value": field.magnitude, "sigma": field.sigma},
        "noise": asdict(found.noise),
        "gone_over": len(found.innovations.restarts),
        "innovations": {**asdict(found.whiteness), "white": found.whiteness.passed},
        "reported": made.reported,
        "fragment": made.fragment,
    }


def _text(made: _Identified) -> str:
    found, plant, record, field = made.found, made.plant, made.record, made.record.field
    before, sources, noise = configured_constants(made.config), plant.sources(), found.noise
    lines = [
        f"flight: {made.folder}, {len(record.time)} samples in {record.time[-1] - record.time[0]:.0f} s, "
        f"{len(found.innovations.restarts)} restarts of the filter",
        *(f"reported by the flight: {one}" for one in made.reported),
        "",
        "from the motion, divided by the inertia:",
    ]
    for name in NAMES:
        value = f"{getattr(found.constants, name):+12.5e} +- {found.sigma(name):.1e} {UNITS[name]}"
        lines.append(f"  {name + ':':18s}{value}, configured {getattr(before, name):.4g}")
    lines += ["", "absolute values, whose common scale the motion does not determine:"]
    for name, unit in _ABSOLUTE_UNITS.items():
        scaled = getattr(plant, name)
        label, value = name.replace("_", " ") + ":", f"{scaled.value:12.5e} +- {scaled.sigma:.1e} {unit}"
        lines.append(f"  {label:18s}{value:34s} {sources[name]}")
    if field is None:
        why = "the coils were never off long enough, or the field did not rotate with the body"
        lines += ["", f"field:  as configured; not measured because {why}"]
    else:
        measured = f"{1e4 * field.magnitude:.4f} gauss from the magnetometer"
        measured += f" minus its offset of {1e4 * field.offset:.4f} gauss" if field.offset else ""
        lines += ["", f"field:  {measured}, with a scale error of {100.0 * MAGNETOMETER_ERROR:g} %"]
    verdict = "are white" if found.whiteness.passed else "are NOT white: the errors are increased accordingly"
    lines.append(
        f"noise:  current {1e3 * noise.current:.2f} mA, angle {1e3 * noise.angle:.2f} mrad, "
        f"rate {1e6 * noise.rate:.0f} urad/s; the innovations {verdict}"
    )
    return "\n".join(lines) + "\n"
