"""The command line: one module a command; a mistake of the user's is one line and exit status 2."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from flight import __version__
from flight.cli import export, plan, report, run
from flight.errors import FlightError, UsageError
from hal.interfaces.errors import DeviceError

_EXAMPLES = """\
examples:
  python -m flight run config/step_demo.yaml --out runs/demo
  python -m flight report runs/demo
  python -m flight plan --from 0.4 --to -0.3 --picture path.png
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; return the exit status: 0 done, 1 ran and failed, 2 wrong use."""
    parser = argparse.ArgumentParser(
        prog="python -m flight",
        description="The on-board application of the KnightCube.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"knightcube-flight {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for command in (run, report, export, plan):
        command.add_to(commands)
    options = parser.parse_args(arguments)
    try:
        status: int = options.command(options)
    except UsageError as error:
        return _complain(str(error), 2)
    except (FlightError, DeviceError) as error:
        return _complain(str(error), 1)
    except BrokenPipeError:
        return 1  # whoever read our output has read enough
    return status


def _complain(message: str, status: int) -> int:
    sys.stderr.write(f"flight: {message}\n")
    return status
