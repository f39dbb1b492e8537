"""Commands on orbits: `knightcube elements`, and the predictions `knightcube passes` and `knightcube day`."""

from __future__ import annotations

import argparse
import csv
import sys
import textwrap
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from flight.app.cli import PROGRAM, to_json
from flight.link.process.commanding import MOST_ENTRIES
from flight.schema import reader as configuration
from flight.schema.bodies import OrbitConfig
from flight.schema.document import Document, config_path, convert, not_utf_8, read_text
from ground.commands.options import finite, positive, print_result, utc
from ground.report.text import number, table
from ground.satellite_description import check_values, read_value
from ground.telemetry import read_run
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.mean_elements import FittedElements, fit_elements
from knightcube.astro.earth.omm import NamedElements, read_elements
from knightcube.astro.earth.orbit_knowledge import TwoLineElements
from knightcube.astro.earth.orientation import ROTATION_RATE, celestial_to_terrestrial
from knightcube.astro.earth.sun import DAY, UNIX_EPOCH
from knightcube.errors import KnightCubeError, UsageError, reason_of
from knightcube.gnc.guidance.pointing_target import Goal
from sim_hal.settings import OrbitSection, Simulation
from sim_hal.worlds.orbit import elements, julian_date, propagate

if TYPE_CHECKING:
    from ground.passes import OrbitPrediction, Pass, Station

_SPAN, _STEP = 86_400.0, 600.0
"""Duration and sampling interval (s) of the positions to which the elements of an orbit are fitted."""
_LISTED = 5  # maximum number of satellites that a message lists
_ECCENTRICITY = OrbitSection().eccentricity  # default eccentricity of an orbit
_COLUMNS, _VELOCITY = ("utc", "x", "y", "z"), ("vx", "vy", "vz")
"""Required columns of a CSV file of fixes, and its optional velocity columns."""
_WANTED = f"{', '.join(_COLUMNS)} and, if known, {', '.join(_VELOCITY)}"
_ORBIT = ("inclination", "eccentricity", "node", "local_time", "perigee", "anomaly", "epoch")
_LONGEST_DAYS = 30.0
"""Longest span (days) of a prediction. Times of later passes would be too uncertain."""
_UNCERTAIN_S = 10.0  # standard deviation of the predicted times (s) above which a warning is printed
_LEAD_S = 120.0
"""Default time (s) before the satellite's rise at which it is commanded to slew to the station."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `knightcube elements` to the parser."""
    parser.description = textwrap.fill(
        "Make two-line elements for the section `elements` of a satellite's configuration: of an orbit that "
        "is given by its altitude, of the simulated orbit of a configuration, or by a fit to "
        "positions, or read them from a file of CelesTrak or Space-Track. "
        "Prints the elements, the distances of the positions from their orbit, and the standard deviation of "
        "the along-track error that grows in a day, estimated from these distances. Outliers among the "
        "positions are rejected. The elements of an orbit are fitted to one day of it with the oblateness "
        "J2, without drag."
    )
    parser.epilog = (
        "examples:\n"
        f"  {PROGRAM} elements --altitude 500 --inclination 97.4 --epoch 2026-03-20T12:00:00\n"
        f"  {PROGRAM} elements --config my_satellite.yaml\n"
        f"  {PROGRAM} elements --fixes runs/mine\n"
        f"  {PROGRAM} elements --read gp.json --satellite 25544"
    )
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument(
        "--altitude", type=finite, metavar="KM", help="altitude of an orbit: semi-major axis minus 6378 km"
    )
    source.add_argument(
        "--config", type=config_path, metavar="CONFIG", help="configuration with a simulated orbit"
    )
    text = (
        "CSV file of GPS fixes with the columns utc (ISO 8601), x, y, z (m, ITRS) and, if known, vx, "
        "vy, vz (m/s relative to the ground, ITRS), or the folder of a run, whose logged fixes are fitted"
    )
    source.add_argument("--fixes", type=Path, metavar="FILE", help=text)
    text = (
        "file of two-line elements, or of OMM in JSON, XML, KVN or CSV, as CelesTrak and Space-Track "
        "publish them; the elements are checked"
    )
    source.add_argument("--read", type=Path, metavar="FILE", help=text)
    parser.add_argument(
        "--satellite", type=int, metavar="NUMBER", help="with --read: satellite number, if there are several"
    )
    _add_orbit(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(command=run)


def _add_orbit(parser: argparse.ArgumentParser) -> None:
    orbit = parser.add_argument_group("with --altitude")
    orbit.add_argument("--inclination", type=finite, metavar="DEG", help="required")
    orbit.add_argument("--epoch", metavar="UTC", help="required, such as 2026-03-20T12:00:00")
    orbit.add_argument("--eccentricity", type=finite, metavar="E", help=f"default {_ECCENTRICITY:g}")
    node = orbit.add_mutually_exclusive_group()
    node.add_argument(
        "--node", type=finite, metavar="DEG", help="right ascension of ascending node (default 0)"
    )
    node.add_argument(
        "--local-time", type=finite, metavar="H", help="local time of the ascending node instead"
    )
    orbit.add_argument("--perigee", type=finite, metavar="DEG", help="argument of perigee (default 0)")
    orbit.add_argument("--anomaly", type=finite, metavar="DEG", help="true anomaly at the epoch (default 0)")


def run(options: argparse.Namespace) -> int:
    """Read or fit two-line elements, and print them, with the residuals of a fit."""
    if options.altitude is None:
        given = [name for name in _ORBIT if getattr(options, name) is not None]
        if given:
            raise UsageError(f"--{given[0].replace('_', '-')}: only with --altitude")
    if options.read is not None:
        newest = read_file(options.read, options.satellite)
        read = {"elements": list(newest.lines), "name": newest.name, "number": newest.number}
        head = f"elements:  # [read from {options.read.name}: {f'{newest.number} {newest.name}'.strip()}]\n"
        print_result(options, read, head + "".join(f"  - '{line}'\n" for line in newest.lines))
        return 0
    if options.satellite is not None:
        raise UsageError("--satellite: only with --read")
    velocities = None
    if options.fixes is not None:
        fixes = read_fixes(options.fixes)
        dates, positions, velocities = fixes.dates, fixes.positions, fixes.velocities
    elif options.config is not None:
        configuration.load_orbit(options.config)
        text = read_text(options.config)
        section = configuration.simulation_section(text, str(options.config), Simulation)
        if section is None or section.free_body is None:
            problem = "`simulation.free_body` is missing: give the orbit by --altitude"
            raise UsageError(f"{options.config}: {problem}")
        dates, positions = _positions(section.free_body.orbit, julian_date(section.utc))
    else:
        dates, positions = _positions(*_given_orbit(options))
    try:
        made = fit_elements(dates, positions, velocities)
    except UsageError as error:
        raise error if options.fixes is None else UsageError(f"{options.fixes}: {error}") from error
    sys.stdout.write(to_json(_facts(made, dates)) if options.json else _text(made, dates))
    return 0


def read_file(path: Path, satellite: int | None) -> NamedElements:
    """Return the newest elements of a satellite in a file of two-line elements or OMM. Raises UsageError.

    The satellite number may be None if the file contains only one satellite.
    """
    try:
        found = read_elements(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {reason_of(error)}") from error
    except UnicodeDecodeError as error:
        raise not_utf_8(path, error) from error
    except UsageError as error:
        raise UsageError(f"{path}: {error}") from error
    chosen = [each for each in found if satellite in {None, each.number}]
    if len({each.number for each in chosen}) != 1:
        numbers = ", ".join(f"{each.number} {each.name}".strip() for each in found[:_LISTED])
        cure = f"give one satellite by --satellite: {numbers}{', ...' if len(found) > _LISTED else ''}"
        raise UsageError(f"{path}: {len(chosen)} of {len(found)} element sets match: {cure}")
    return max(chosen, key=lambda each: TwoLineElements(*each.lines).epoch)


def elements_of(orbit: OrbitSection, date: float) -> FittedElements:
    """Return the two-line elements of a simulated orbit that starts at a Julian date, UTC."""
    return fit_elements(*_positions(orbit, date))


def _positions(orbit: OrbitSection, date: float) -> tuple[FloatArray, FloatArray]:
    times = np.arange(0.0, _SPAN + 1.0, _STEP)
    return date + times / DAY, propagate(elements(orbit, date), _SPAN + _STEP).positions_at(times)


def _given_orbit(options: argparse.Namespace) -> tuple[OrbitSection, float]:
    """Return the orbit that the options describe, and the Julian date of its start. Raises UsageError."""
    for name in ("inclination", "epoch"):
        if getattr(options, name) is None:
            raise UsageError(f"--altitude needs --{name}")
    shape = {
        name: read_value(name, f"{value:g}")
        for name in ("altitude", "inclination", "eccentricity")
        if (value := getattr(options, name)) is not None
    }
    check_values("altitude", {"eccentricity": _ECCENTRICITY, **shape})
    values = {
        "altitude": 1e3 * options.altitude,
        "inclination_deg": options.inclination,
        "eccentricity": options.eccentricity,
        "ascending_node_deg": options.node,
        "local_time": options.local_time,
        "argument_of_perigee_deg": options.perigee,
        "true_anomaly_deg": options.anomaly,
    }
    given = {key: value for key, value in values.items() if value is not None}
    orbit = convert(Document(given, "this orbit is not supported", {}), OrbitSection)
    return orbit, _date(options.epoch, "--epoch")


@dataclass(frozen=True, slots=True, eq=False)
class Fixes:
    """Fixes of a GPS receiver.

    Attributes:
        dates: (n,) Julian dates UTC.
        positions: (n, 3) geocentric positions, m, ICRS.
        velocities: (n, 3) geocentric velocities, m/s, ICRS, or None if they were not measured.
    """

    dates: FloatArray
    positions: FloatArray
    velocities: FloatArray | None


def read_fixes(path: Path) -> Fixes:
    """Return the fixes in a CSV file, or in the flight log of a run's folder in order of UTC.

    Raises UsageError.
    """
    if path.is_dir():
        rows = read_run(path)["fix"]
        if not len(rows):
            raise UsageError(f"{path}: the flight log has no GPS fixes: give a CSV file with {_WANTED}")
        # A faulty receiver may repeat a fix or report an earlier time.
        rows = rows[np.unique(rows["utc_ns"], return_index=True)[1]]
        dates = UNIX_EPOCH + rows["utc_ns"] / (1e9 * DAY)
        return _celestial(dates, np.hstack([rows["position"], rows["velocity"]]))
    found = []
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            names = reader.fieldnames or ()
            if missing := [name for name in _COLUMNS if name not in names]:
                raise UsageError(f"{path}: the column {missing[0]} is missing: give {_WANTED}")
            columns = [*_COLUMNS[1:], *(_VELOCITY if set(_VELOCITY) <= set(names) else ())]
            for row in reader:
                place = f"{path}:{reader.line_num}"
                numbers = (_number(row[name], f"{place}: column {name}") for name in columns)
                found.append([_date(row["utc"] or "", f"{place}: column utc"), *numbers])
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {reason_of(error)}") from error
    except UnicodeDecodeError as error:
        raise not_utf_8(path, error) from error
    except csv.Error as error:
        raise UsageError(f"{path}: is not a CSV file: {error}") from error
    table = np.array(found).reshape(-1, 1 + len(columns))
    return _celestial(table[:, 0], table[:, 1:])


def _celestial(dates: FloatArray, states: FloatArray) -> Fixes:
    """Return celestial fixes from ITRS states (n, 3 or 6): positions and, if given, ITRS velocities."""
    turns = np.array([celestial_to_terrestrial(float(date)) for date in dates]).reshape(-1, 3, 3)
    positions = np.einsum("nji,nj->ni", turns, states[:, :3])
    if states.shape[1] == 3:
        return Fixes(dates, positions, None)
    ground = states[:, 3:] + np.cross([0.0, 0.0, ROTATION_RATE], states[:, :3])
    return Fixes(dates, positions, np.einsum("nji,nj->ni", turns, ground))


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
        "rejected": int(np.count_nonzero(~made.used)),
        "span_s": float(dates[-1] - dates[0]) * DAY,
        "rms_m": made.rms,
        "largest_m": float(made.residuals[made.used].max()),
        "growth_m_per_day": made.growth,
        "residuals_m": made.residuals.tolist(),
    }


def _text(made: FittedElements, dates: FloatArray) -> str:
    hours, rejected = float(dates[-1] - dates[0]) * 24.0, int(np.count_nonzero(~made.used))
    largest = float(made.residuals[made.used].max())
    without = f", {rejected} others rejected" if rejected else ""
    return (
        f"elements:                     # [computed: fitted to {len(dates) - rejected} positions over "
        f"{hours:.3g} h, {1e-3 * made.rms:.3g} km rms, {1e-3 * largest:.3g} km "
        f"at most{without}; {1e-3 * made.growth:.2g} km per day along the track]\n"
        f"  - '{made.lines[0]}'\n  - '{made.lines[1]}'\n"
    )


def configure_passes(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `knightcube passes` to the parser."""
    parser.description = (
        "Predict the passes of a satellite over ground stations from its two-line elements: rise, highest "
        "elevation and set, whether the satellite is in sunlight, and the Sun's elevation at the station. "
        "With --schedule, print the commands that point the satellite to the station during each pass. "
        "Exit status 1 if there is no pass. Needs the extra `ground`."
    )
    parser.epilog = (
        f"example: {PROGRAM} passes orbit_3u --from 2026-03-20T12:00:00 --station Berlin,52.5,13.4 --days 2"
    )
    _add_prediction(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    text = "print only the commands for each pass, to be sent by `command --link ADDRESS --keys FOLDER`"
    parser.add_argument("--schedule", action="store_true", help=text)
    text = "with --schedule: time to point before the rise (default %(default)g s)"
    parser.add_argument("--lead", type=finite, default=_LEAD_S, metavar="S", help=text)
    parser.set_defaults(command=run_passes)


def configure_day(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `knightcube day` to the parser."""
    parser.description = (
        "Draw a day of a satellite: its elevation above the ground stations, passes, eclipses, and the "
        "targets of the configuration, whose mission time begins at the start of the picture. Needs the "
        "extras `ground` and `plots`."
    )
    parser.epilog = f"example: {PROGRAM} day orbit_3u --from 2026-03-20T12:00:00 --station Berlin,52.5,13.4"
    _add_prediction(parser)
    parser.add_argument(
        "--picture", type=Path, default=Path("day.png"), metavar="PNG", help="the picture (default day.png)"
    )
    parser.set_defaults(command=run_day)


def _add_prediction(parser: argparse.ArgumentParser) -> None:
    text = "configuration of the satellite with `elements`, or a file of two-line elements or OMM"
    parser.add_argument("config", type=config_path, metavar="CONFIG", help=text)
    add_stations(parser)


def add_stations(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that select the satellite in a file of elements, the stations, and the time span."""
    parser.add_argument(
        "--satellite", type=int, metavar="NUMBER", help="satellite number, if the file has several satellites"
    )
    parser.add_argument(
        "--station",
        action="append",
        default=[],
        metavar="NAME,LAT,LON[,HEIGHT[,MASK]]",
        help="a ground station: degrees, metres, and the elevation (deg, default 5) from which it sees the "
        "satellite; may be repeated",
    )
    parser.add_argument(
        "--stations", type=Path, metavar="FILE", help="YAML file with a list `stations` of ground stations"
    )
    parser.add_argument(
        "--from",
        dest="begin",
        type=utc,
        metavar="UTC",
        help="start, such as 2026-03-20T12:00:00 (default now)",
    )
    text = "length of the prediction (default %(default)g days)"
    parser.add_argument("--days", type=positive, default=1.0, metavar="N", help=text)


def run_passes(options: argparse.Namespace) -> int:
    """Predict the passes and print them."""
    if options.lead < 0.0:
        raise UsageError(f"--lead {options.lead:g}: must be 0 s or more before the rise")
    prediction, stations, _ = predicted(options)
    from ground.passes import NEWER, SENDING, facts_of  # noqa: PLC0415

    if options.schedule and prediction.timing_error_s > max(options.lead, _UNCERTAIN_S):
        problem = f"the times have a standard deviation of {prediction.timing_error_s:.0f} s"
        cure = f"{NEWER}, or a longer lead"
        raise UsageError(f"--schedule: {problem}, which exceeds --lead {options.lead:g}: {cure}")
    found = prediction.passes(stations)
    # If the prediction begins now, the first command must be due late enough to be sent in time.
    earliest = prediction.begin + (SENDING if options.begin is None else timedelta(0))
    commands = _commands(found, options.lead, earliest) if options.schedule else [[] for _ in found]
    if options.json:
        passes = [
            facts_of(one) | ({"schedule": lines} if options.schedule else {})
            for one, lines in zip(found, commands, strict=True)
        ]
        sys.stdout.write(to_json({"timing_error_s": prediction.timing_error_s, "passes": passes}))
    elif options.schedule:
        sys.stdout.writelines(f"{line}\n" for lines in commands for line in lines)
    else:
        sys.stdout.write("\n".join(_lines(found)) + "\n" if found else "no pass\n")
    return 0 if found else 1


def _commands(found: list[Pass], lead: float, earliest: datetime) -> list[list[str]]:
    """Return the commands of each pass as a user types them, and warn about passes without commands."""
    from ground.passes import scheduled_targets  # noqa: PLC0415

    made: list[list[str]] = []
    for one, targets in zip(found, scheduled_targets(found, lead, earliest), strict=True):
        place = f"point ground {one.station.latitude_deg:g} {one.station.longitude_deg:g}"
        made.append(
            [
                f"schedule {at:%Y-%m-%dT%H:%M:%S} {'point nadir' if target.goal is Goal.NADIR else place}"
                for at, target in targets
            ]
        )
        if not targets:
            which = f"{one.station.name}, {one.rise:%Y-%m-%dT%H:%M:%S}"
            sys.stderr.write(
                f"{PROGRAM}: {which}: no commands, because an earlier pass lasts longer, or it ends at once\n"
            )
    count = sum(map(len, made))
    if count > MOST_ENTRIES:
        problem = f"{count} commands, but the satellite stores {MOST_ENTRIES}: give fewer --days"
        sys.stderr.write(f"{PROGRAM}: {problem}\n")
    return made


def run_day(options: argparse.Namespace) -> int:
    """Plot the passes of a day, and print the name of the picture."""
    from ground.report import draw_day  # noqa: PLC0415

    prediction, stations, config = predicted(options)
    span = (prediction.end - prediction.begin).total_seconds()
    steps = [] if config is None else [step for step in config.targets if step.at < span]
    draw_day(prediction, stations, [(step.at, step.target().text) for step in steps], options.picture)
    sys.stdout.write(f"picture: {options.picture}\n")
    return 0


def predicted(
    options: argparse.Namespace,
) -> tuple[OrbitPrediction, tuple[Station, ...], OrbitConfig | None]:
    """Return the predicted orbit, the stations, and the configuration if one is given. Raises UsageError.

    The path `options.config` names a configuration or a file of elements.
    """
    try:
        from ground.passes import NEWER, OrbitPrediction, read_stations, station_of  # noqa: PLC0415
    except ModuleNotFoundError as error:
        needed = "pip install 'knightcube-flight[ground]'"
        raise KnightCubeError(f"predicting passes needs {error.name}: {needed}") from error
    if options.days > _LONGEST_DAYS:
        raise UsageError(f"--days {options.days:g}: must be at most {_LONGEST_DAYS:g}")
    stations = tuple(map(station_of, options.station))
    stations += read_stations(options.stations) if options.stations is not None else ()
    if not stations:
        raise UsageError("give a ground station: --station Berlin,52.5,13.4, or --stations FILE")
    names = [station.name for station in stations]
    for name in names:
        if names.count(name) > 1:
            raise UsageError(f"two stations are called {name!r}: give each its own name")
    lines, config = _elements(options.config, options.satellite)
    begin = options.begin or datetime.now(UTC).replace(microsecond=0)
    prediction = OrbitPrediction(lines, begin, options.days)
    prediction.check_age()
    if prediction.timing_error_s > _UNCERTAIN_S:
        sys.stderr.write(
            f"{PROGRAM}: the elements are old: the times at the end have a standard deviation of "
            f"{prediction.timing_error_s:.0f} s: {NEWER}\n"
        )
    return prediction, stations, config


def _elements(path: Path, satellite: int | None) -> tuple[tuple[str, str], OrbitConfig | None]:
    """Return the two-line elements in a file, and the configuration that contains them. Raises UsageError."""
    if path.suffix not in {".yaml", ".yml"}:
        return read_file(path, satellite).lines, None
    config = configuration.load_orbit(path)
    if config.elements is None:
        raise UsageError(f"{path}: `elements` is missing: make it with `knightcube elements`")
    return config.elements, config


def _lines(found: list[Pass]) -> list[str]:
    rows = [
        [
            one.station.name,
            f"{one.rise:%Y-%m-%d %H:%M:%S}",
            number(one.azimuths_deg[0], 0),
            f"{one.top:%H:%M:%S}",
            number(one.azimuths_deg[1], 0),
            number(one.elevation_deg, 1),
            number(one.range, 0, 1e-3),
            f"{one.set:%H:%M:%S}",
            number(one.azimuths_deg[2], 0),
            number((one.set - one.rise).total_seconds(), 0),
            "sunlit" if one.sunlit > 0.5 else "shadow",
            number(one.sun_elevation_deg, 0),
        ]
        for one in found
    ]
    head = ["station", "rise UTC", "az", "top", "az", "elevation", "km", "set", "az", "s", "satellite", "Sun"]
    note = "  az: azimuth, deg; km: distance at the top (culmination); Sun: its elevation at the station, deg"
    return [*table(head, rows), note]
