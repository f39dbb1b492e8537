"""Commands that evaluate a run: `knightcube report`, `knightcube export` and `knightcube orbit`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from flight.link.telemetry.log import find_runs
from ground import report as reporting
from ground.commands.options import print_result
from ground.messages import ObjectOrbit, orbits_of, write_attitudes, write_orbit_messages, write_tracking_data
from ground.report.comparison import compare, format_archive, format_comparison, summarise_archive
from ground.telemetry import FORMATS, Run, export, read_run
from knightcube.errors import UsageError


def configure_report(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `knightcube report` to the parser."""
    parser.description = (
        "Print the performance of a run and the limits of Sease (2013, Table 5.3), and draw its figures. The "
        "run is judged on the truth of the simulation if it has one, otherwise on the estimate. With a "
        "second run the two are compared: configuration, figures and events, with the differences; "
        "--figures draws both."
    )
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a run, or of an archive of runs")
    parser.add_argument("other", type=Path, nargs="?", metavar="OTHER", help="a second run for a comparison")
    parser.add_argument("--json", action="store_true", help="print one JSON object without drawing figures")
    parser.add_argument(
        "--figures", type=Path, metavar="DIR", help="folder of the figures (default RUN/figures)"
    )
    parser.add_argument("--no-figures", action="store_true", help="draw nothing")
    parser.set_defaults(command=run_report)


def run_report(options: argparse.Namespace) -> int:
    """Print the report and draw the figures."""
    if options.other is not None:
        return _compare(options)
    if find_runs(options.run):
        archive = summarise_archive(options.run)
        print_result(options, archive, format_archive(archive))
        return 0
    run = read_run(options.run)
    summary = reporting.summarise(run)
    print_result(options, summary, reporting.format_report(summary))
    if options.no_figures or (options.json and options.figures is None):
        return 0
    try:
        paths = reporting.draw(run, options.figures or options.run / "figures")
    except UsageError as error:
        # The report has been printed, so missing pictures are an error only with the option --figures.
        sys.stderr.write(f"knightcube: {error}\n")
        return 0 if options.figures is None else 2
    if not options.json:
        sys.stdout.write("\npictures:\n" + "".join(f"  {path}\n" for path in paths))
    return 0


def _compare(options: argparse.Namespace) -> int:
    """Print the results of two runs side by side, and draw both runs if a folder is given."""
    runs = [read_run(folder) for folder in (options.run, options.other)]
    compared = compare(*(reporting.summarise(run) for run in runs))
    print_result(options, compared, format_comparison(compared))
    if options.figures is not None and not options.no_figures:
        path = reporting.draw_both(runs[0], runs[1], options.figures)
        if not options.json:
            sys.stdout.write(f"\npicture:\n  {path}\n")
    return 0


def configure_export(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `knightcube export` to the parser."""
    parser.description = (
        "Write one CSV or Parquet file (extra `parquet`) per packet type, or one SQLite file with a table "
        "per packet type. Units and meanings are in the table or file `fields`, in Parquet the metadata."
    )
    parser.epilog = "example: knightcube export runs/demo --format sqlite"
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a run")
    parser.add_argument("--format", choices=FORMATS, default="csv", help="format of the files (default csv)")
    places = ", ".join(f"RUN/{place}" for place in FORMATS.values())
    text = f"folder of the files, or the SQLite file (default {places})"
    parser.add_argument("--out", type=Path, metavar="PLACE", help=text)
    message = parser.add_mutually_exclusive_group()
    text = (
        "write only the tracks of objects, as a CCSDS Tracking Data Message, and beside it the orbit of "
        "the camera (suffix .oem), as an Orbit Ephemeris Message"
    )
    message.add_argument("--tdm", type=Path, metavar="FILE", help=text)
    text = "write only the estimated attitudes of a satellite, as a CCSDS Attitude Ephemeris Message"
    message.add_argument("--aem", type=Path, metavar="FILE", help=text)
    parser.add_argument("--xml", action="store_true", help="write the message as XML (CCSDS 505.0-B)")
    parser.add_argument("--json", action="store_true", help="print the files as one JSON object")
    parser.set_defaults(command=run_export)


def run_export(options: argparse.Namespace) -> int:
    """Write the exported files and print their paths."""
    if options.xml and options.tdm is None and options.aem is None:
        raise UsageError("--xml needs a message: add --tdm FILE or --aem FILE")
    run = read_run(options.run)
    if options.tdm is not None:
        paths = write_tracking_data(run, options.tdm, options.xml)
    elif options.aem is not None:
        paths = write_attitudes(run, options.aem, options.xml)
    else:
        paths = export(run, options.out or options.run / FORMATS[options.format], options.format)
    sys.stderr.writelines(f"knightcube: {gap}\n" for gap in _gaps(run))
    print_result(options, {"files": [str(path) for path in paths]}, "".join(f"{path}\n" for path in paths))
    return 0


def _gaps(run: Run) -> Iterator[str]:
    """Yield a warning for each log of a run with packets that are missing in the exported files."""
    for name, log in run.logs.items():
        missing, dropped = sum(log.missing.values()), run.dropped_segments(name)
        if missing or log.skipped_bytes or log.other_versions or dropped:
            yield (
                f"the exported files have gaps: in the {name} log {missing} packets are missing, "
                f"{log.skipped_bytes} bytes are damaged, {log.other_versions} packets have another version, "
                f"{dropped} old segments were deleted"
            )


_POSITION, _VELOCITY = slice(0, 3), slice(3, 6)


def configure_orbit(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `knightcube orbit` to the parser."""
    parser.description = (
        "Determine a first orbit of each object that a flight tracked, from directions alone, with its "
        "covariance; if the arc is too short, print why. Exit status 0 if every object has an orbit, 1 if "
        "one has none."
    )
    parser.epilog = "example: knightcube orbit runs/object --opm orbits"
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a run")
    parser.add_argument(
        "--opm", type=Path, metavar="FOLDER", help="write each orbit as a CCSDS Orbit Parameter Message"
    )
    parser.add_argument("--xml", action="store_true", help="write the messages as XML (CCSDS 505.0-B)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(command=run_orbit)


def run_orbit(options: argparse.Namespace) -> int:
    """Determine, print and write the initial orbits."""
    found = orbits_of(read_run(options.run))
    paths = [] if options.opm is None else write_orbit_messages(found, options.opm, options.xml)
    facts = {"objects": [_orbit_facts(item) for item in found], "files": [str(path) for path in paths]}
    print_result(options, facts, "".join([*map(_orbit_text, found), *(f"{path}\n" for path in paths)]))
    return 0 if all(item.orbit is not None for item in found) else 1


def _orbit_facts(item: ObjectOrbit) -> dict[str, object]:
    facts: dict[str, object] = {"object": item.number, "sightings": item.sightings, "span_s": item.span}
    orbit = item.orbit
    if orbit is None:
        return facts | {"orbit": None, "reason": item.reason}
    return facts | {
        "orbit": {
            "utc": item.date.isoformat(),
            "position_m": orbit.state[:3].tolist(),
            "velocity_m_s": orbit.state[3:].tolist(),
            "covariance": orbit.covariance.tolist(),
            "distance_m": orbit.distance,
            "distance_95_m": list(orbit.interval),
            "lasts": orbit.lasts,
            "chi_square": orbit.chi_square,
            "degrees": orbit.degrees,
        }
    }


def _orbit_text(item: ObjectOrbit) -> str:
    head = f"object {item.number}: {item.sightings} sightings in {item.span:.0f} s\n"
    orbit = item.orbit
    if orbit is None:
        return f"{head}  no orbit: {item.reason}\n"
    low, high = (1e-3 * end for end in orbit.interval)
    x, y, z = 1e-3 * orbit.state[:3]
    u, v, w = 1e-3 * orbit.state[3:]
    place, speed = (float(np.sqrt(np.trace(orbit.covariance[part, part]))) for part in (_POSITION, _VELOCITY))
    lasting = (
        "" if orbit.lasts else "  it escapes or hits the Earth, but not every orbit within its errors does\n"
    )
    return (
        f"{head}"
        f"  at {item.date:%Y-%m-%dT%H:%M:%S.%f} UTC, ICRS\n"
        f"  position  {x:12.3f} {y:12.3f} {z:12.3f} km   +- {1e-3 * place:.3g} km\n"
        f"  velocity  {u:12.6f} {v:12.6f} {w:12.6f} km/s +- {1e-3 * speed:.3g} km/s\n"
        f"  distance  {1e-3 * orbit.distance:.1f} km, {low:.1f} to {high:.1f} with 95 %\n"
        f"{lasting}"
        f"  chi-square {orbit.chi_square:.0f} with {orbit.degrees} degrees of freedom\n"
    )
