"""`python -m tests.studies.bench NAME [arguments]`: runs a benchmark; without a name, lists all of them.

A benchmark is a module of this package with a function `main`. The list is read from the docstrings. Only the
requested benchmark is imported, so optional packages of other benchmarks may be missing.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import inspect
import pkgutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

_FOLDER = Path(__file__).parent


def benches() -> dict[str, str]:
    """Return the name of each benchmark and the first line of its docstring, without importing any."""
    found = {}
    for module in pkgutil.iter_modules([str(_FOLDER)]):
        if module.name.startswith("_") or module.ispkg:
            continue
        tree = ast.parse((_FOLDER / f"{module.name}.py").read_text(encoding="utf-8"))
        if any(isinstance(node, ast.FunctionDef) and node.name == "main" for node in tree.body):
            # The first line of each docstring also names the command, which the list omits.
            line = (ast.get_docstring(tree) or "").partition("\n")[0]
            found[module.name] = line.partition("python -m")[0].rstrip(" :`")
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a benchmark. Returns its exit status, 0 after the list, or 2 for wrong use."""
    known = benches()
    width = max(map(len, known), default=0)
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.bench",
        description="Measure a part of the flight software.",
        epilog="benches:\n" + "\n".join(f"  {name:{width}}  {line}" for name, line in known.items()),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("name", nargs="?", choices=sorted(known), metavar="NAME", help="which bench")
    parser.add_argument("arguments", nargs=argparse.REMAINDER, help="the bench's own; see NAME --help")
    options = parser.parse_args(arguments)
    if options.name is None:
        parser.print_help()
        return 0
    return _run(options.name, options.arguments)


def _run(name: str, arguments: list[str]) -> int:
    """Run a benchmark's `main`, and pass the argument list if it accepts one."""
    bench = importlib.import_module(f"tests.studies.bench.{name}").main
    with _command_line(f"python -m tests.studies.bench {name}", arguments):
        status = bench(arguments) if inspect.signature(bench).parameters else bench()
    return int(status or 0)


@contextmanager
def _command_line(program: str, arguments: list[str]) -> Iterator[None]:
    """Set the process's command line, which some `main` functions read and which their help texts show."""
    before = sys.argv
    sys.argv = [program, *arguments]
    try:
        yield
    finally:
        sys.argv = before


if __name__ == "__main__":
    raise SystemExit(main())
