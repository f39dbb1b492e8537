"""The command line: one module a command; a mistake of the user's is one line and exit status 2.

Only the module of the command that was typed is imported: a board that flies has no use for the others.
"""

from __future__ import annotations

import argparse
import importlib
import io
import sys
from collections.abc import Sequence

from flight import __version__
from flight.errors import FlightError, UsageError
from hal.interfaces.errors import DeviceError

COMMANDS = {
    "run": "fly a configuration",
    "command": "tell a flight what to do",
    "report": "tell what a run achieved",
    "export": "write a run's packets as CSV",
    "plan": "plan a single path",
    "identify": "the body's constants from a short flight",
    "rate": "body rate from a picture of streaked stars",
    "solve": "where a picture of the sky looks, and which stars it shows",
    "camera": "take frames from the configured camera and look at them",
    "horizon": "the way down, from a picture of the Earth's limb",
    "calibrate": "a camera's lens from pictures of the sky",
}

_EXAMPLES = """\
examples:
  python -m flight run config/step_demo.yaml --out runs/demo
  python -m flight report runs/demo
  python -m flight plan --from 0.4 --to -0.3 --picture path.png
  python -m flight rate frame.png --fov 20 --exposure 0.2 --overlay found.png
  python -m flight solve night.jpg --fov 11.4 --overlay solved.png
  python -m flight horizon limb.png --fov 67 --altitude 515 --overlay found.png
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; return the exit status: 0 done, 1 ran and failed, 2 wrong use."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # a file's name need not be a text
    words = list(sys.argv[1:] if arguments is None else arguments)
    options = _parser(words).parse_args(words)
    try:
        status: int = options.command(options)
    except UsageError as error:
        return _complain(str(error), 2)
    except (FlightError, DeviceError) as error:
        return _complain(str(error), 1)
    except BrokenPipeError:
        return 1  # whoever read our output has read enough
    except OSError as error:  # a name that no file can have, a folder that may not be entered
        if error.filename is None:
            return _complain(error.strerror or str(error), 1)
        return _complain(f"{error.filename}: {error.strerror}", 2)
    return status


def _parser(words: Sequence[str]) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m flight",
        description="The on-board application of the KnightCube.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"knightcube-flight {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for name, purpose in COMMANDS.items():
        command = commands.add_parser(name, help=purpose)
        if words[:1] == [name]:
            importlib.import_module(f"flight.cli.{name}").configure(command)
    return parser


def _complain(message: str, status: int) -> int:
    sys.stderr.write(f"flight: {message}\n")
    return status
