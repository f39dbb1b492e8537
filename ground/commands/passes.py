"""Commands `knightcube passes` and `knightcube day`: predicted passes over ground stations."""

from __future__ import annotations

import argparse
import json
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from flight.app.cli import PROGRAM
from flight.schema import reader as configuration
from flight.schema.document import config_path
from flight.schema.orbit import OrbitConfig, as_orbit
from ground.commands.elements import read_file
from ground.commands.options import finite, positive, utc
from ground.report.text import number, table
from knightcube.errors import FlightError, UsageError
from knightcube.gnc.guidance.pointing_target import Goal

if TYPE_CHECKING:
    from ground.passes import OrbitPrediction, Pass, Station

_LONGEST_DAYS = 30.0
"""Longest span (days) of a prediction, because older elements do not give times of useful accuracy."""
_UNCERTAIN_S = 10.0  # standard deviation of the predicted times (s) above which a warning is printed
_LEAD_S = 120.0
"""Default time (s) before the satellite's rise at which it is commanded to slew to the station."""


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
    _add_orbit(parser)
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
    _add_orbit(parser)
    parser.add_argument(
        "--picture", type=Path, default=Path("day.png"), metavar="PNG", help="the picture (default day.png)"
    )
    parser.set_defaults(command=run_day)


def _add_orbit(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that select satellite, time span and stations."""
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
    parser.add_argument("--from", dest="begin", type=utc, metavar="UTC", help="start (default now)")
    text = "length of the prediction (default %(default)g days)"
    parser.add_argument("--days", type=positive, default=1.0, metavar="N", help=text)


def run_passes(options: argparse.Namespace) -> int:
    """Predict the passes and print them."""
    prediction, stations, _ = predicted(options)
    from ground.passes import facts_of, scheduled_targets  # noqa: PLC0415

    found = prediction.passes(stations)
    if options.json:
        facts = {"timing_error_s": prediction.timing_error_s, "passes": [facts_of(one) for one in found]}
        sys.stdout.write(json.dumps(facts) + "\n")
    elif options.schedule:
        for one in found:
            for at, target in scheduled_targets(one, options.lead):
                words = "point nadir" if target.goal is Goal.NADIR else f"point ground {_place(one.station)}"
                sys.stdout.write(f"schedule {at:%Y-%m-%dT%H:%M:%S} {words}\n")
    else:
        sys.stdout.write("\n".join(_lines(found)) + "\n" if found else "no pass\n")
    return 0 if found else 1


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

    The path `options.config` is that of a configuration or of a file of elements.
    """
    try:
        from ground.passes import OrbitPrediction, read_stations, station_of  # noqa: PLC0415
    except ModuleNotFoundError as error:
        needed = "pip install 'knightcube-flight[ground]'"
        raise FlightError(f"predicting passes needs {error.name}: {needed}") from error
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
    if prediction.timing_error_s > _UNCERTAIN_S:
        sys.stderr.write(
            f"{PROGRAM}: the elements are old: the times at the end have a standard deviation of "
            f"{prediction.timing_error_s:.0f} s\n"
        )
    return prediction, stations, config


def _elements(path: Path, satellite: int | None) -> tuple[tuple[str, str], OrbitConfig | None]:
    """Return the two-line elements in a file, and the configuration that contains them. Raises UsageError."""
    if path.suffix not in {".yaml", ".yml"}:
        return read_file(path, satellite).lines, None
    config = as_orbit(configuration.load(path))
    if config.elements is None:
        raise UsageError(f"{path}: `elements` is missing: the orbit is not known")
    return config.elements, config


def _lines(found: list[Pass]) -> list[str]:
    """Return the table of the passes."""
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


def _place(station: Station) -> str:
    return f"{station.latitude_deg:g} {station.longitude_deg:g}"
