"""`flight report`: what a run achieved, against the thesis."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from flight.link.telemetry.log import find_runs
from ground import report as reporting
from ground.report.comparison import compare, format_archive, format_comparison, summarise_archive
from ground.telemetry import read_run
from knightcube.errors import UsageError


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this command to the parser."""
    parser.description = (
        "Print a run's performance against Table 5.3 of the thesis, and draw its figures. "
        "Judged on the simulation's truth where there is one, on the estimate otherwise. With a second run "
        "the two are compared: configuration, figures, events, with the differences; --figures draws both."
    )
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a run, or of an archive of runs")
    parser.add_argument("other", type=Path, nargs="?", metavar="OTHER", help="a second run, to compare")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead, and draw nothing")
    parser.add_argument(
        "--figures", type=Path, metavar="DIR", help="folder of the figures (default RUN/figures)"
    )
    parser.add_argument("--no-figures", action="store_true", help="draw nothing")
    parser.set_defaults(command=report)


def report(options: argparse.Namespace) -> int:
    """Print the report, then draw."""
    if options.other is not None:
        return _compare(options)
    if find_runs(options.run):
        archive = summarise_archive(options.run)
        text = json.dumps(archive, allow_nan=False) + "\n" if options.json else format_archive(archive)
        sys.stdout.write(text)
        return 0
    run = read_run(options.run)
    summary = reporting.summarise(run)
    if options.json:
        sys.stdout.write(json.dumps(summary, allow_nan=False) + "\n")
        if options.figures is None:
            return 0
    else:
        sys.stdout.write(reporting.format_report(summary))
    if options.no_figures:
        return 0
    try:
        paths = reporting.draw(run, options.figures or options.run / "figures")
    except UsageError as error:
        # The numbers are printed by now: missing figures do not fail the report.
        sys.stderr.write(f"flight: {error}\n")
        return 0 if options.figures is None else 2
    if not options.json:
        sys.stdout.write("\npictures:\n" + "".join(f"  {path}\n" for path in paths))
    return 0


def _compare(options: argparse.Namespace) -> int:
    """Print two runs side by side, and draw them where a folder for that is given."""
    runs = [read_run(folder) for folder in (options.run, options.other)]
    compared = compare(*(reporting.summarise(run) for run in runs))
    text = json.dumps(compared, allow_nan=False) + "\n" if options.json else format_comparison(compared)
    sys.stdout.write(text)
    if options.figures is not None and not options.no_figures:
        path = reporting.draw_both(runs[0], runs[1], options.figures)
        if not options.json:
            sys.stdout.write(f"\npicture:\n  {path}\n")
    return 0
