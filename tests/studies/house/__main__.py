"""Draws the house from the code's own imports and sizes: `python -m tests.studies.house`.

With `--reached` it also flies, and reports the lines of `flight/` that the flights reach. With `--touched` it
flies and solves an image, and reports how many files a control cycle, an opening and a star fix enter.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

from tests.studies.house import graph, sizes

ROOT = Path(__file__).resolve().parents[3]


@dataclass(frozen=True, slots=True)
class Bar:
    """One measured figure and its limits."""

    name: str
    value: float
    limit: str
    met: bool

    def __str__(self) -> str:
        verdict = "" if self.met else "  NOT MET"
        return f"{self.name:34} {self.value:8g}   {self.limit:10}{verdict}"


@dataclass(frozen=True, slots=True)
class House:
    """The drawing: floors of rooms, arrows between them, and the sizes."""

    rooms: dict[str, frozenset[str]]
    floors: dict[str, int]
    back: list[str]
    circles: list[list[str]]
    sizes: sizes.Sizes

    @property
    def shape(self) -> list[Bar]:
        """The figures that import-linter's contracts could hold too."""
        return [
            at_most("rooms on the first level", len(self.rooms), 9),
            at_most("floors", 1 + max(self.floors.values()), 6),
            at_most("arrows back", len(self.back), 0),
            at_most("circles", len(self.circles), 0),
        ]

    @property
    def dimensions(self) -> list[Bar]:
        """The figures of files, classes and functions, in lines."""
        found = self.sizes
        median = found.median_file
        return [
            Bar("median file", median, "60 to 300", 60 <= median <= 300),
            at_most("largest file", found.files[0].lines, sizes.LONG_FILE),
            at_most(f"classes over {sizes.LONG_CLASS}, no reason given", len(found.long_classes), 0),
            at_most(
                f"functions over {sizes.LONG_FUNCTION} lines",
                len(found.long_functions),
                sizes.MOST_LONG_FUNCTIONS,
            ),
        ]


def at_most(name: str, value: float, limit: float) -> Bar:
    """Return a figure with an upper limit."""
    return Bar(name, value, f"<= {limit:g}", value <= limit)


@cache
def draw(root: Path = ROOT) -> House:
    """Read the product's source, once in a process."""
    files = graph.product_files(root)
    modules = graph.import_graph(files)
    rooms = graph.room_graph(modules)
    back = [str(arrow) for arrow in graph.arrows_back(modules, graph.contract(root))]
    circles = graph.circles(rooms) + graph.circles(modules)
    return House(rooms, graph.floors(rooms), back, circles, sizes.measure(files))


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the drawing; return 1 when a limit is not kept."""
    options = _parser().parse_args(arguments)
    house = draw()
    bars = [*house.shape, *house.dimensions]
    reached: list[Any] = []
    if options.reached:
        from tests.studies.house.reached import measure  # noqa: PLC0415  # needs the extra `bench`

        reached = measure(ROOT)
        lines, hit = sum(file.lines for file in reached), sum(file.reached for file in reached)
        share = 100.0 * hit / lines
        bars.append(Bar("lines reached by flights, %", round(share, 1), ">= 90", share >= 90.0))
    entered: dict[str, list[str]] = {}
    if options.touched:
        from tests.studies.house import touched as files  # noqa: PLC0415  # it imports the product

        entered = {name: sorted(names) for name, names in files.measure().items()}
        bars += [at_most(f"files of a {name}", len(entered[name]), files.LIMITS[name]) for name in entered]
    if options.json:
        sys.stdout.write(json.dumps(_as_json(house, bars, reached) | {"touched": entered}) + "\n")
    else:
        sys.stdout.write(_text(house, bars, reached, entered))
    return int(not all(bar.met for bar in bars))


def _text(
    house: House, bars: Sequence[Bar], reached: Sequence[Any], entered: Mapping[str, Sequence[str]]
) -> str:
    lines = []
    for floor in sorted(set(house.floors.values()), reverse=True):
        for room in sorted(room for room, height in house.floors.items() if height == floor):
            imported = sorted(house.rooms[room], key=lambda other: (-house.floors[other], other))
            lines.append(f"{floor + 1}  {room:14} {'-> ' if imported else ''}{', '.join(imported)}")
    lines += ["", f"{'product lines':34} {house.sizes.total:8}", *map(str, bars), ""]
    lists: dict[str, Sequence[object]] = {
        "arrows back": house.back,
        "circles": [" <-> ".join(circle) for circle in house.circles],
        "largest files": house.sizes.files[:5],
        "largest classes": house.sizes.classes[:5],
        f"functions over {sizes.LONG_FUNCTION} lines": house.sizes.long_functions,
    }
    lists |= {f"files of a {name}": files for name, files in entered.items()}
    for title, entries in lists.items():
        if entries:
            lines += [f"{title}:", *(f"  {entry}" for entry in entries)]
    if reached:
        lines += ["lines not reached, by file:", *(f"  {file}" for file in reached)]
    return "\n".join(lines) + "\n"


def _as_json(house: House, bars: Sequence[Bar], reached: Sequence[Any]) -> dict[str, Any]:
    return {
        "floors": house.floors,
        "rooms": {room: sorted(imported) for room, imported in house.rooms.items()},
        "arrows_back": house.back,
        "circles": house.circles,
        "product_lines": house.sizes.total,
        "figures": [asdict(bar) for bar in bars],
        "long_functions": [asdict(piece) for piece in house.sizes.long_functions],
        "long_classes": [asdict(piece) for piece in house.sizes.long_classes],
        "reached": [asdict(file) for file in reached],
    }


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.house",
        description="Draw rooms, floors, arrows and sizes from the source; check them against their limits.",
    )
    parser.add_argument(
        "--reached", action="store_true", help="also fly, and count the lines of flight/ reached"
    )
    parser.add_argument(
        "--touched",
        action="store_true",
        help="also count the files that a cycle, an opening and a star fix enter",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
