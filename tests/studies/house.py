"""Sizes of the product's files, classes and functions, and the number of files that each activity uses.

Import-linter checks layers and cycles (pyproject.toml).

With `--touched` the program runs a flight and computes the attitude of an image. It counts the product files
whose functions are called in one control cycle, at the opening of a flight, and in a star fix. The execution
of a module or of a class body does not count. The flight is the step demonstration in lock-step. Files of
`sim_hal` and files that `sim_hal` calls do not count, because they emulate the hardware. A job that the
lock-step runner runs in the calling thread belongs to a worker and does not count either.
"""

from __future__ import annotations

import ast
import inspect
import re
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from types import FrameType
from typing import Annotated, Any
from unittest.mock import patch

import numpy as np

from flight.app import flight as application
from flight.app.run import RunRequest
from flight.loop.executive import Cycle, LockStepRunner
from flight.loop.flight_loop import ControlCycle, FlightLoop
from knightcube import StarTracker
from sim_hal.star_camera import StarCameraModel
from tests.studies.command import Json, command, say
from tests.support.scenes import exposed

ROOT = Path(__file__).resolve().parents[2]
PRODUCT = ("knightcube", "flight", "ground", "hal", "sim_hal")
MOST_LINES = {"file": 900, "class": 350, "function": 50}
"""Largest number of lines by kind; a class may be longer if its docstring gives a reason ("... lines:
...")."""
MOST_LONG_FUNCTIONS = 20
_REASON = re.compile(r"\blines\b", re.IGNORECASE)
LIMITS = {"control cycle": 30, "opening of a flight": 45, "star fix": 20}
"""Largest number of files whose functions each activity may call."""
_FIRST, _LAST = 400, 440
"""First and last control cycle of the measurement: one second of steady flight after the first plan."""


@dataclass(frozen=True, slots=True)
class Piece:
    """A file, class or function with its length in lines.

    `excused` is true if the docstring of the piece gives a reason for its length.
    """

    kind: str
    name: str
    lines: int
    excused: bool = False

    @property
    def long(self) -> bool:
        """Whether the length exceeds the limit of its kind."""
        return self.lines > MOST_LINES[self.kind] and not self.excused

    def __str__(self) -> str:
        return f"{self.kind:9} {self.lines:4} {self.name}"


@cache
def pieces(root: Path = ROOT) -> list[Piece]:
    """Return all files, classes and functions of the product, the longest first.

    A function within a function belongs to the outer function.
    """
    found = []
    for path in sorted(path for package in PRODUCT for path in (root / package).rglob("*.py")):
        text, name = path.read_text(encoding="utf-8"), path.relative_to(root).as_posix()
        found += [Piece("file", name, text.count("\n")), *_definitions(ast.parse(text), name)]
    return sorted(found, key=lambda piece: -piece.lines)


def _definitions(node: ast.AST, place: str) -> Iterator[Piece]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            name, lines = f"{place}:{child.name}", (child.end_lineno or child.lineno) - child.lineno + 1
            if isinstance(child, ast.ClassDef):
                yield Piece("class", name, lines, bool(_REASON.search(ast.get_docstring(child) or "")))
                yield from _definitions(child, name)
            else:
                yield Piece("function", name, lines)
        elif not isinstance(child, ast.expr):
            yield from _definitions(child, place)


class Touched:
    """Recorder of the product files (relative to `ROOT`) whose functions a measured block calls."""

    def __init__(self) -> None:
        self.files: set[str] = set()
        self._outside = 0  # depth of nested calls into code that does not count

    def _profile(self, frame: FrameType, event: str, _: Any) -> None:
        if event not in {"call", "return"}:
            return
        code = frame.f_code
        outside = code.co_filename.startswith(f"{ROOT}/sim_hal/") or code is LockStepRunner.submit.__code__
        outside |= code.co_name == "<module>"  # Decorators that an import calls do not count.
        if event == "return":
            self._outside -= bool(self._outside and outside)
            return
        self._outside += outside
        if self._outside or not code.co_flags & inspect.CO_OPTIMIZED:
            return
        if code.co_filename.startswith((f"{ROOT}/flight/", f"{ROOT}/hal/", f"{ROOT}/knightcube/")):
            self.files.add(code.co_filename.removeprefix(f"{ROOT}/"))

    @contextmanager
    def measured(self) -> Iterator[None]:
        """Record the files whose functions the block calls."""
        self._outside = 0
        sys.setprofile(self._profile)
        try:
            yield
        finally:
            sys.setprofile(None)


def of_flight() -> dict[str, set[str]]:
    """Return the files whose functions are called at the opening of a flight and in a control cycle.

    The opening lasts from the request to the first cycle. The control cycle is the cycle with the most files
    in a second of flight.
    """
    opening, cycles = Touched(), [Touched()]
    fly, run = FlightLoop.run, ControlCycle.run

    def fly_on(loop: FlightLoop, epoch_ns: int, label: Any) -> str:
        sys.setprofile(None)
        return fly(loop, epoch_ns, label)

    def run_measured(control: ControlCycle, cycle: Cycle) -> Any:
        if not _FIRST <= cycle.slot < _LAST:
            return run(control, cycle)
        cycles.append(Touched())
        with cycles[-1].measured():
            return run(control, cycle)

    with (
        patch.object(FlightLoop, "run", fly_on),
        patch.object(ControlCycle, "run", run_measured),
        tempfile.TemporaryDirectory() as folder,
        opening.measured(),
    ):
        configuration, duration = ROOT / "config/step_demo.yaml", 0.025 * (_LAST + 1)
        application.fly(RunRequest(configuration, Path(folder) / "run", duration=duration))
    largest = max((cycle.files for cycle in cycles), key=len)
    return {"control cycle": largest, "opening of a flight": opening.files}


def of_star_fix() -> dict[str, set[str]]:
    """Return the files whose functions are called to compute the attitude of an image of stars at rest."""
    camera = StarCameraModel(field_of_view=np.radians(12.0))
    scene = exposed(camera, np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3), 0.2, np.random.default_rng(1))
    touched, tracker = Touched(), StarTracker(fov_deg=12.0)
    with touched.measured():
        solution = tracker.solve(scene.pixels)
    assert solution, solution.reason
    return {"star fix": touched.files}


def measure() -> dict[str, set[str]]:
    """Return the files whose functions each activity of `LIMITS` calls."""
    return of_flight() | of_star_fix()


@command
def main(
    *, touched: Annotated[bool, "also count the files that are entered"] = False, json: Json = False
) -> int:
    """Print sizes and files. Returns 1 if a limit is exceeded."""
    measured = pieces()
    long = [piece for piece in measured if piece.long]
    files = [piece.lines for piece in measured if piece.kind == "file"]
    entered = {name: sorted(found) for name, found in (measure() if touched else {}).items()}
    if json:
        pieces_long = [asdict(piece) for piece in long]
        say(lines=sum(files), files=len(files), long=pieces_long, touched=entered)
    else:
        lines = [f"{sum(files)} lines in {len(files)} files, {files[len(files) // 2]} in the median one"]
        lines += ["longer than the limit:", *map(str, long)]
        for name, found in entered.items():
            lines += [f"files of a {name}: {len(found)}, at most {LIMITS[name]}", *found]
        sys.stdout.write("\n".join(lines) + "\n")
    return int(not kept(long) or any(len(found) > LIMITS[name] for name, found in entered.items()))


def kept(long: Sequence[Piece]) -> bool:
    """Return whether at most the permitted number of functions is too long, and nothing else is."""
    return all(piece.kind == "function" for piece in long) and len(long) <= MOST_LONG_FUNCTIONS


if __name__ == "__main__":
    raise SystemExit(main())
