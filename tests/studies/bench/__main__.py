"""`python -m tests.studies.bench NAME [arguments]`: runs a benchmark; without a name, lists all of them.

A benchmark is a module of this package whose function `main` is a `command`. The list is read from the
docstrings. Only the requested benchmark is imported, so optional packages of other benchmarks may be missing.
"""

from __future__ import annotations

import argparse
import ast
import importlib
from collections.abc import Sequence
from pathlib import Path


def benches() -> dict[str, str]:
    """Return the name of each benchmark and the first line of its docstring, without importing any."""
    found = {}
    for path in sorted(Path(__file__).parent.glob("[a-z]*.py")):
        text = path.read_text(encoding="utf-8")
        if "\n@command\ndef main(" in text:
            found[path.stem] = (ast.get_docstring(ast.parse(text)) or "").partition("\n")[0].rstrip(".")
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
    bench = importlib.import_module(f"tests.studies.bench.{options.name}")
    return int(bench.main(options.arguments))


if __name__ == "__main__":
    raise SystemExit(main())
