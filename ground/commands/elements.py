"""Command `flight elements`, which makes two-line elements of an orbit or fits them to positions."""

from __future__ import annotations

import argparse
import csv
import json
import sys
from datetime import UTC, datetime
from pathlib import Path

import msgspec
import numpy as np

from flight.schema import reader as configuration
from flight.schema.document import config_path, read_text
from flight.schema.orbit import as_orbit
from ground.commands.options import finite
from ground.telemetry import read_run
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.mean_elements import FittedElements, fit_elements
from knightcube.astro.earth.orientation import celestial_to_terrestrial
from knightcube.astro.earth.sun import DAY
from knightcube.errors import UsageError
from sim_hal.settings import OrbitSection, Simulation
from sim_hal.worlds.orbit import elements, julian_date, propagate

_SPAN, _STEP = 86_400.0, 600.0
"""Span and interval (s) of the positions to which the elements of an orbit are fitted."""
_COLUMNS = ("utc", "x", "y", "z")
_ORBIT = ("inclination", "eccentricity", "node", "local_time", "perigee", "anomaly", "epoch")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `flight elements` to the parser."""
    parser.description = (
        "Make two-line elements for the section `elements` of a satellite's configuration: of an orbit that "
        "is given by its altitude, of the simulated orbit of a configuration, or by a fit to positions. "
        "Prints the elements and the distances of the positions from them. The elements of an orbit are "
        "fitted to one day of it with the oblateness J2, without drag."
    )
    parser.epilog = (
        "example: python -m flight elements --altitude 500 --inclination 97.4 --local-time 10.5 "
        "--epoch 2026-03-20T12:00:00"
    )
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument(
        "--altitude", type=finite, metavar="KM", help="semi-major axis minus 6378 km, of an orbit"
    )
    source.add_argument(
        "--config", type=config_path, metavar="CONFIG", help="configuration with a simulated orbit"
    )
    source.add_argument(
        "--fixes",
        type=Path,
        metavar="FILE",
        help="CSV file of GPS fixes with the columns utc (ISO 8601), x, y and z (m, ITRS), or the folder of "
        "a simulated run, whose true positions are fitted",
    )
    orbit = parser.add_argument_group("with --altitude")
    orbit.add_argument("--inclination", type=finite, metavar="DEG", help="required")
    orbit.add_argument("--epoch", metavar="UTC", help="required, such as 2026-03-20T12:00:00")
    orbit.add_argument("--eccentricity", type=finite, metavar="E", help="default 0.001")
    node = orbit.add_mutually_exclusive_group()
    node.add_argument("--node", type=finite, metavar="DEG", help="right ascension of the ascending node (0)")
    node.add_argument(
        "--local-time", type=finite, metavar="H", help="mean local time of the ascending node instead"
    )
    orbit.add_argument("--perigee", type=finite, metavar="DEG", help="argument of perigee (0)")
    orbit.add_argument("--anomaly", type=finite, metavar="DEG", help="true anomaly at the epoch (0)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Make or fit elements and print them with their residuals."""
    if options.altitude is None:
        given = [name for name in _ORBIT if getattr(options, name) is not None]
        if given:
            raise UsageError(f"--{given[0].replace('_', '-')}: goes with --altitude")
    if options.fixes is not None:
        dates, positions = read_positions(options.fixes)
    elif options.config is not None:
        dates, positions = _positions(*_configured_orbit(options.config))
    else:
        dates, positions = _positions(*_given_orbit(options))
    made = fit_elements(dates, positions)
    sys.stdout.write(json.dumps(_facts(made, dates)) + "\n" if options.json else _text(made, dates))
    return 0


def elements_of(orbit: OrbitSection, date: float) -> FittedElements:
    """Return the two-line elements of a simulated orbit from the Julian date UTC of its start."""
    return fit_elements(*_positions(orbit, date))


def _positions(orbit: OrbitSection, date: float) -> tuple[FloatArray, FloatArray]:
    times = np.arange(0.0, _SPAN + 1.0, _STEP)
    return date + times / DAY, propagate(elements(orbit, date), _SPAN + _STEP).positions_at(times)


def _given_orbit(options: argparse.Namespace) -> tuple[OrbitSection, float]:
    """Return the orbit that the options describe, and the Julian date of its start. Raises UsageError."""
    for name in ("inclination", "epoch"):
        if getattr(options, name) is None:
            raise UsageError(f"--altitude needs --{name}")
    values = {
        "altitude": 1e3 * options.altitude,
        "inclination_deg": options.inclination,
        "eccentricity": options.eccentricity,
        "ascending_node_deg": options.node,
        "local_time": options.local_time,
        "argument_of_perigee_deg": options.perigee,
        "true_anomaly_deg": options.anomaly,
    }
    try:
        orbit = msgspec.convert(
            {key: value for key, value in values.items() if value is not None}, OrbitSection
        )
    except msgspec.ValidationError as error:
        raise UsageError(f"this orbit is not supported: {error}") from error
    return orbit, _date(options.epoch, "--epoch")


def _configured_orbit(path: Path) -> tuple[OrbitSection, float]:
    """Return the simulated orbit of a configuration, and the Julian date of its start. Raises UsageError."""
    as_orbit(configuration.load(path))
    section = configuration.simulation_section(read_text(path), str(path), Simulation)
    if section is None or section.free_body is None:
        raise UsageError(f"{path}: `simulation.free_body` is missing: give the orbit by --altitude")
    return section.free_body.orbit, julian_date(section.utc)


def read_positions(path: Path) -> tuple[FloatArray, FloatArray]:
    """Return Julian dates (n,) and positions (n, 3), m, ICRS, of a CSV file or of a simulated run.

    Raises UsageError.
    """
    if path.is_dir():
        rows = read_run(path)["orbit_truth"]
        if not len(rows):
            raise UsageError(f"{path}: has no true positions: give a CSV file with {', '.join(_COLUMNS)}")
        return np.asarray(rows["utc"], dtype=float), np.asarray(rows["position"], dtype=float)
    dates, positions = [], []
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            if missing := [name for name in _COLUMNS if name not in (reader.fieldnames or ())]:
                raise UsageError(f"{path}: the column {missing[0]} is missing: give {', '.join(_COLUMNS)}")
            for row in reader:
                place = f"{path}:{reader.line_num}"
                dates.append(_date(row["utc"] or "", place))
                ground = np.array([_number(row[name], place) for name in ("x", "y", "z")])
                positions.append(ground @ celestial_to_terrestrial(dates[-1]))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UsageError(f"{path}: cannot be read: {error}") from error
    return np.array(dates), np.array(positions).reshape(-1, 3)


def _number(text: str | None, place: str) -> float:
    try:
        return finite(text or "")
    except argparse.ArgumentTypeError as error:
        raise UsageError(f"{place}: {error}") from error


def _date(text: str, place: str) -> float:
    """Return the Julian date of a time, in UTC unless the text has a time zone. Raises UsageError."""
    try:
        found = datetime.fromisoformat(text)
    except ValueError as error:
        raise UsageError(f"{place}: {text!r}: give a time such as 2026-03-20T12:00:00") from error
    return julian_date((found.replace(tzinfo=UTC) if found.tzinfo is None else found).isoformat())


def _facts(made: FittedElements, dates: FloatArray) -> dict[str, object]:
    return {
        "elements": list(made.lines),
        "positions": len(dates),
        "span_s": float(dates[-1] - dates[0]) * DAY,
        "rms_m": float(np.sqrt(np.mean(made.residuals**2))),
        "largest_m": float(made.residuals.max()),
        "residuals_m": made.residuals.tolist(),
    }


def _text(made: FittedElements, dates: FloatArray) -> str:
    rms, largest = float(np.sqrt(np.mean(made.residuals**2))), float(made.residuals.max())
    hours = float(dates[-1] - dates[0]) * 24.0
    return (
        f"elements:                     # [computed: fitted to {len(dates)} positions over {hours:.3g} h, "
        f"{1e-3 * rms:.3g} km rms, {1e-3 * largest:.3g} km at most]\n"
        f"  - '{made.lines[0]}'\n  - '{made.lines[1]}'\n"
    )
