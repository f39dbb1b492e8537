"""`python -m tests.studies NAME [arguments]`: run a study, for instance `campaigns faults`."""

from __future__ import annotations

import os
import runpy
import sys
from pathlib import Path

# As in `python -m flight`, numpy uses one thread. The variable must be set before a study imports numpy.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

_FOLDER = Path(__file__).parent


def names() -> list[str]:
    """Return the names of the studies: the modules of this folder with a command, and the packages."""
    modules = [
        path.stem for path in _FOLDER.glob("*.py") if "\n@command\ndef main(" in path.read_text("utf-8")
    ]
    return sorted(modules + [path.parent.name for path in _FOLDER.glob("*/__main__.py")])


def main() -> int:
    """Run the study that the first argument names, with the remaining arguments."""
    if sys.argv[1:2] in (["-h"], ["--help"]):
        print(f"usage: python -m tests.studies NAME [arguments]\n\nstudies: {', '.join(names())}")  # noqa: T201
        print("\n`python -m tests.studies NAME --help` shows the arguments of a study.")  # noqa: T201 - a command
        return 0
    if len(sys.argv) < 2 or sys.argv[1] not in names():
        asked = f"there is no study {sys.argv[1]!r}; " if len(sys.argv) > 1 else ""
        print(f"{asked}studies: {', '.join(names())}", file=sys.stderr)  # noqa: T201 - a command
        return 2
    name = sys.argv.pop(1)
    runpy.run_module(f"tests.studies.{name}", run_name="__main__", alter_sys=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
