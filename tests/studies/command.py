"""Command lines of studies: the parameters of a function are the options of its command."""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from inspect import Parameter, signature
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Protocol, get_args, get_origin, get_type_hints

from knightcube.errors import UsageError

Json = Annotated[bool, "print one JSON object instead of text"]
Seed = Annotated[int, "of the random draws"]


class Main(Protocol):
    """A function that runs a study with the arguments of a command line, and returns its exit status."""

    def __call__(self, arguments: Sequence[str] | None = None) -> int: ...


def command(function: Callable[..., int]) -> Main:
    """Make a study's function its `main`, which reads the function's parameters from a command line.

    A keyword-only parameter is an option, and any other parameter an argument. The annotation of each is
    `Annotated[TYPE, HELP]`, or `Annotated[TYPE, HELP, CHOICES]`. A `bool` is an option without a value, a
    `tuple` takes several values, and a `Literal` takes one of its own values. A UsageError is printed, and
    the exit status is 2.
    """

    def main(arguments: Sequence[str] | None = None) -> int:
        module = function.__globals__
        name = module["__spec__"].name.removesuffix(".__main__").replace(".bench.", ".bench ")
        parser = argparse.ArgumentParser(
            prog=f"python -m {name}",
            description=module["__doc__"],
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        hints = get_type_hints(function, include_extras=True)
        for parameter in signature(function).parameters.values():
            _add(parser, parameter, *get_args(hints[parameter.name]))
        try:
            return function(**vars(parser.parse_args(arguments)))
        except UsageError as error:
            sys.stderr.write(f"{name.rpartition('.')[2]}: {error}\n")
            return 2

    return main


def _add(
    parser: argparse.ArgumentParser, parameter: Parameter, kind: Any, text: str, choices: Any = None
) -> None:
    """Add the option or argument of a parameter."""
    shown = text.replace("%", "%%")
    option = f"--{parameter.name.replace('_', '-')}"
    if kind is bool:
        parser.add_argument(option, action="store_true", help=shown)
        return
    if get_origin(kind) is UnionType:
        kind = next(each for each in get_args(kind) if each is not type(None))
    words: dict[str, Any] = {"type": kind, "choices": choices}
    if get_origin(kind) is Literal:
        words = {"type": type(get_args(kind)[0]), "choices": get_args(kind)}
    elif get_origin(kind) is tuple:
        words = {"type": get_args(kind)[0], "nargs": "+"}
    if parameter.default is not Parameter.empty:
        words["default"] = parameter.default
        shown += "" if parameter.default in (None, "", ()) else " (default %(default)s)"
    if parameter.kind is Parameter.KEYWORD_ONLY:
        parser.add_argument(option, help=shown, required="default" not in words, **words)
    else:
        parser.add_argument(parameter.name, help=shown, nargs="?" if "default" in words else None, **words)


def say(**facts: Any) -> None:
    """Print a line with one JSON object."""
    sys.stdout.write(json.dumps(facts) + "\n")
    sys.stdout.flush()


@contextmanager
def scratch() -> Iterator[Path]:
    """Yield an empty folder that is removed at the end of the block."""
    with tempfile.TemporaryDirectory(prefix="knightcube-") as folder:
        yield Path(folder)


class Table:
    """A table that is printed row by row."""

    def __init__(self) -> None:
        self._widths: list[int] = []

    def add(self, **cells: Any) -> None:
        """Print a row, after the names of its columns if it is the first."""
        if not self._widths:
            self._widths = [max(len(name), 8) for name in cells]
            self._print(name.replace("_", " ") for name in cells)
        self._print(f"{cell:.4g}" if isinstance(cell, float) else str(cell) for cell in cells.values())

    def _print(self, texts: Iterable[str]) -> None:
        line = "  ".join(text.rjust(width) for text, width in zip(texts, self._widths, strict=True))
        sys.stdout.write(line + "\n")
        sys.stdout.flush()
