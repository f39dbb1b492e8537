"""The command line: one module a command; a mistake of the user's is one line and exit status 2.

Only the module of the command that was typed is imported: a board that flies has no use for the others.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import io
import sys
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path

from flight import __version__
from flight.app.cli.outlet import outlast_readers
from hal.interfaces.errors import DeviceError
from knightcube.errors import FlightError, UsageError

COMMANDS = {
    "run": "fly a configuration",
    "link": "connect a flight to its ground by protected frames",
    "check": "check a configuration and the devices that it names, before it is flown",
}
"""What a board has; the packages of `GROUP` add theirs."""

GROUP = "knightcube.commands"
"""Entry points: each a table like `COMMANDS` in the package whose modules bear the commands' names."""

PROGRAM = "knightcube" if Path(sys.argv[0]).name == "knightcube" else "python -m flight"
"""How this was started: by its console script or as a module."""

_EXAMPLES = f"""\
examples:
  {PROGRAM} check step_demo
  {PROGRAM} run step_demo --out runs/demo
  {PROGRAM} report runs/demo
  {PROGRAM} plan --from 0.4 --to -0.3 --picture path.png
  {PROGRAM} samples
  {PROGRAM} rate samples/streaks.png --fov 15 --exposure 0.4 --overlay found.png
  {PROGRAM} solve samples/stars.png --fov 15 --overlay solved.png
  {PROGRAM} horizon samples/limb.png --fov 67 --altitude 515 --overlay limb.png
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; return the exit status: 0 done, 1 ran and failed, 2 wrong use."""
    outlast_readers()
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # a file's name need not be a text
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        return _obey(words)
    except UsageError as error:
        return _complain(str(error), 2)
    except (FlightError, DeviceError) as error:
        return _complain(str(error), 1)
    except KeyboardInterrupt:
        return _complain("interrupted", 130)  # as a shell counts what SIGINT ended
    except OSError as error:  # a name that no file can have, a folder that may not be entered
        if error.filename is None:
            return _complain(error.strerror or str(error), 1)
        return _complain(f"{error.filename}: {error.strerror}", 2)


def _obey(words: Sequence[str]) -> int:
    try:
        try:
            parser = _parser(words)
        except OSError as error:  # a module that cannot be read is no mistake of the user's
            raise FlightError(str(error)) from error
        options = parser.parse_args(words)
        status: int = options.command(options)
    finally:
        sys.stdout.flush()
    return status


def _parser(words: Sequence[str]) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=PROGRAM,
        description="The on-board application of the KnightCube.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"knightcube-flight {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for name, (purpose, module) in _available(words).items():
        command = commands.add_parser(name, help=purpose)
        if words[:1] == [name]:
            importlib.import_module(module).configure(command)
    return parser


def _available(words: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Return purpose and module of each command; the start of a flight does not search for other packages."""
    own = {name: (purpose, f"{__name__}.{name}") for name, purpose in COMMANDS.items()}
    if words and words[0] in own:
        return own
    others: dict[str, tuple[str, str]] = {}
    for found in metadata.entry_points(group=GROUP):
        if importlib.util.find_spec(found.module.partition(".")[0]) is None:
            continue  # on a board: the installer leaves the ground package out
        table: dict[str, str] = found.load()
        others |= {name: (purpose, f"{found.module}.{name}") for name, purpose in table.items()}
    return own | others


def _complain(message: str, status: int) -> int:
    sys.stderr.write(f"flight: {message}\n")
    return status
