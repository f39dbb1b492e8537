"""The command line: a user error is reported in one line, with exit status 2.

Only the module of the requested command is imported, because a flight computer does not need the other
commands. A command finishes its work even if its output is not read: if its pipe is closed (`| head`), if its
terminal is gone, or if its standard output is closed (`>&-`).
"""

from __future__ import annotations

import argparse
import errno
import importlib
import importlib.util
import io
import json
import math
import os
import sys
from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

from flight import __version__
from hal.interfaces.errors import DeviceError
from knightcube.errors import KnightCubeError, PlanningError, UsageError, reason_of, shown

_READER_GONE = frozenset({errno.EPIPE, errno.EIO, errno.EBADF})


class _Outlet(io.FileIO):
    """Output file that discards all data after its reader has closed it, or after the first error."""

    _lost = False

    def write(self, data: Any, /) -> int:
        """Return how many bytes were written or discarded. Raises OSError for the first disk error."""
        try:
            if not self._lost:
                return super().write(data)
        except OSError as error:
            self._lost = True
            if error.errno not in _READER_GONE:
                raise
        return memoryview(data).nbytes


def outlast_readers() -> None:
    """Let the process continue if its output is closed; streams that a caller replaced stay unchanged."""
    for number, name in ((1, "stdout"), (2, "stderr")):
        stream = getattr(sys, name)
        if stream is None:
            # A closed descriptor is replaced, so that the next opened file does not receive the output.
            while (held := os.open(os.devnull, os.O_WRONLY)) < number:
                pass
            if held != number:
                os.close(held)
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 - lasts as the process
        elif stream is getattr(sys, f"__{name}__") and isinstance(stream, io.TextIOWrapper):
            outlet = io.BufferedWriter(_Outlet(number, "w", closefd=False))
            by_line = name == "stderr" or stream.line_buffering
            made = io.TextIOWrapper(
                outlet, encoding=stream.encoding, errors="backslashreplace", line_buffering=by_line
            )
            stream.flush()
            setattr(sys, name, made)


GROUPS = {
    "fly": "Fly and judge a flight",
    "operate": "Operate a flight",
    "sky": "Pictures of the sky and the Earth",
    "plan": "Plan and identify",
    "make": "Make configurations and tables",
}
"""Headings of the groups of commands in `--help`."""

COMMANDS = {
    "run": ("fly", "fly a configuration", "run:configure"),
    "link": ("operate", "connect flight software and ground by protected frames", "link:configure"),
    "check": ("fly", "check a configuration and its devices before a flight", "run:configure_check"),
}
"""Group, purpose and MODULE:FUNCTION of the commands on board; entry points in `ENTRY_POINTS` add more."""

ENTRY_POINTS = "knightcube.commands"
"""Name of the entry point group; each entry point is a table of commands that a package adds."""

PROGRAM = "knightcube"
"""Name of the program in help, examples and error messages, even if it was started by `python -m flight`."""

_EXAMPLES = f"""\
examples:
  {PROGRAM} check step_demo
  {PROGRAM} run step_demo --out runs/demo
  {PROGRAM} report runs/demo
  {PROGRAM} new-satellite
  {PROGRAM} plan --from 0.4 --to -0.3 --picture path.png
  {PROGRAM} samples
  {PROGRAM} rate samples/streaks.png --fov 15 --exposure 0.4 --overlay found.png
  {PROGRAM} solve samples/stars.png --fov 15 --overlay solved.png
  {PROGRAM} horizon samples/limb.png --fov 67 --altitude 515 --overlay limb.png
"""


class _Answer:
    """Whether the command was started with `--json`, and whether its JSON object was made."""

    wanted = made = False


def to_json(facts: Any) -> str:
    """Return the result of a command as one line of JSON, with numbers rounded to 15 digits.

    Without rounding, times that are computed from integers in ns would be printed as 15.450000000000001. NaN
    and infinity become null, because JSON supports neither.
    """
    text = json.dumps(_rounded(facts), allow_nan=False) + "\n"
    _Answer.made = True
    return text


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(each) for each in value]
    if isinstance(value, float):
        return float(f"{value:.15g}") if math.isfinite(value) else None
    return value


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command, and return the exit status: 0 for success, 1 for a failure, 2 for a usage error."""
    outlast_readers()
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # file names may contain bytes that are not text
    words = list(sys.argv[1:] if arguments is None else arguments)
    # The option may be abbreviated, like all options of argparse.
    _Answer.wanted = any(len(word) > 2 and "--json".startswith(word) for word in words)
    _Answer.made = False
    try:
        return _obey(words)
    except (KnightCubeError, DeviceError) as error:
        # A planner that finds no path is a failure of the command, not a usage error.
        misused = isinstance(error, UsageError) and not isinstance(error, PlanningError)
        return complain(str(error), 2 if misused else 1)
    except KeyboardInterrupt:
        return complain("interrupted", 130)  # the exit status that shells use for SIGINT
    except OSError as error:  # such as an invalid file name or a folder without permission
        if error.filename is None:
            return complain(error.strerror or str(error), 1)
        return complain(f"{error.filename}: {reason_of(error)}", 2)


def _obey(words: Sequence[str]) -> int:
    try:
        try:
            parser = _parser(_typed() or words)
        except OSError as error:  # a module that cannot be imported is not a mistake of the user
            raise KnightCubeError(str(error)) from error
        _complete(parser)
        options = parser.parse_args(words)
        if "numpy" in sys.modules:
            from flight.loop.worker import lean_imports  # noqa: PLC0415 - for commands that use numpy

            lean_imports()
        status: int = options.command(options)
    finally:
        sys.stdout.flush()
    return status


def _typed() -> list[str]:
    """Return the command-line words that a shell asks to be completed, or none in a normal run."""
    line = os.environ.get("COMP_LINE", "") if "_ARGCOMPLETE" in os.environ else ""
    return line.split()[1:]


def _complete(parser: argparse.ArgumentParser) -> None:
    """Print the completions that a shell requests, and end the process; return at once in a normal run."""
    if "_ARGCOMPLETE" not in os.environ:
        return
    try:
        import argcomplete  # noqa: PLC0415 - an extra
    except ModuleNotFoundError as error:
        needed = "pip install 'knightcube-flight[watch]'"
        raise KnightCubeError(f"completion needs {error.name}: {needed}") from error
    argcomplete.autocomplete(parser)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from error


def _whole_number(text: str) -> int:
    try:
        return int(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number") from error


class _Parser(argparse.ArgumentParser):
    """Parser that reports wrong arguments also as a JSON object, if the arguments contain `--json`."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.register("type", float, _number)  # argparse would name the type `float` in its message
        self.register("type", int, _whole_number)

    def error(self, message: str) -> NoReturn:
        """Report wrong arguments, and end the process with the exit status 2."""
        _answer_error(message)
        super().error(message)


def _parser(words: Sequence[str]) -> argparse.ArgumentParser:
    available = _available(words)
    parser = _Parser(
        prog=PROGRAM,
        description=_overview(available),
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"knightcube-flight {__version__}")
    commands = parser.add_subparsers(
        required=True, metavar="COMMAND", help="one of the commands listed above"
    )
    for name, (_, _, target) in available.items():
        command = commands.add_parser(name)
        if words[:1] == [name]:
            module, _, function = target.partition(":")
            getattr(importlib.import_module(module), function)(command)
    return parser


def _overview(available: Mapping[str, tuple[str, str, str]]) -> str:
    """Return the text above the options in `--help`: the commands by groups."""
    lines = ["On-board application of the KnightCube, and its ground tools."]
    for group, heading in GROUPS.items():
        lines += ["", f"{heading}:"]
        lines += [f"  {name:15} {purpose}" for name, (own, purpose, _) in available.items() if own == group]
    return "\n".join(lines)


def _available(words: Sequence[str]) -> dict[str, tuple[str, str, str]]:
    """Return group, purpose and MODULE:FUNCTION of each command; search other packages only if needed."""
    own = _full_names(COMMANDS, __name__)
    if words and words[0] in own:
        return own
    from importlib import metadata  # noqa: PLC0415 - takes half as long to load as the other modules together

    others: dict[str, tuple[str, str, str]] = {}
    for found in metadata.entry_points(group=ENTRY_POINTS):
        if importlib.util.find_spec(found.module.partition(".")[0]) is None:
            continue  # the package ground is not installed on a flight computer
        others |= _full_names(found.load(), found.module)
    return own | others


def _full_names(table: dict[str, tuple[str, str, str]], package: str) -> dict[str, tuple[str, str, str]]:
    return {name: (group, purpose, f"{package}.{at}") for name, (group, purpose, at) in table.items()}


def complain(message: str, status: int) -> int:
    """Print an error message, also as a JSON object if `--json` is given, and return the exit status.

    Control characters of the message are escaped, so that they have no effect.
    """
    _answer_error(message)
    lines = map(shown, message.split("\n"))
    sys.stderr.write("knightcube: " + "\n".join(lines) + "\n")
    return status


def _answer_error(message: str) -> None:
    """Print a JSON object with the error message, if `--json` is given and no JSON object was printed."""
    if _Answer.wanted and not _Answer.made:
        sys.stdout.write(to_json({"error": message}))
        sys.stdout.flush()
