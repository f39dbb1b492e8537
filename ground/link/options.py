"""The options by which a command of the ground reaches a satellite's link."""

from __future__ import annotations

import argparse
from pathlib import Path

from ground.link.terminal import DEFAULTS, Terminal, TerminalSettings, open_terminal
from knightcube.errors import UsageError


def add_link_options(parser: argparse.ArgumentParser, way: argparse._MutuallyExclusiveGroup) -> None:
    """Add `--link` to the ways to a flight, and its particulars to the parser."""
    way.add_argument(
        "--link", metavar="ADDRESS", help="its link: HOST:PORT (UDP), tcp:HOST:PORT or /dev/FILE@BAUD"
    )
    parser.add_argument("--keys", type=Path, metavar="FOLDER", help="the ground's keys, with --link")
    parser.add_argument(
        "--spacecraft", type=int, default=DEFAULTS.spacecraft, metavar="N", help="with --link"
    )
    parser.add_argument(
        "--frame-bytes", type=int, default=DEFAULTS.frame_bytes, metavar="N", help="with --link"
    )


def terminal_of(options: argparse.Namespace) -> Terminal:
    """Return the open end of the link that the options name. Raises UsageError, FlightError."""
    if options.keys is None:
        raise UsageError("--link needs --keys, the ground's folder of `python -m ground keys`")
    return open_terminal(
        options.link, options.keys, TerminalSettings(options.spacecraft, options.frame_bytes)
    )
