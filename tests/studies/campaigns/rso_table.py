"""Tables 4.1 and 4.2 with the thesis's own columns: rate, displacement and axis, estimated and true."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from knightcube.astro.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class Printed:
    """A table of the thesis: its number, its angle's unit and rad in it, its values as printed."""

    number: str
    unit: str
    scale: float
    rate: float
    displacement: float
    axis: tuple[float, float, float]


PRINTED = {
    "rso-track": Printed("4.1", "deg", float(np.deg2rad(1.0)), 1.986, 0.993, (0.02, 0.99, 0.00)),
    "rso-slew": Printed("4.2", "rad", 1.0, 0.0497, 0.0248, (-0.003, 0.999, 0.000)),
}


def columns(rate: FloatArray, exposure: float, scale: float) -> dict[str, Any]:
    """Return a table's column for a rate (3,) rad/s: magnitude and displacement in units of `scale`, axis."""
    size = float(np.linalg.norm(rate))
    axis = [float(part) for part in rate / size]
    return {"rate": size / scale, "displacement": size * exposure / scale, "axis": axis}


def thesis_table(
    name: str, exposure: float, true: FloatArray, estimated: Mapping[str, Sequence[float] | None]
) -> tuple[list[str], dict[str, Any]]:
    """Return the table of one frame as lines and as facts.

    `true` (3,) and each of `estimated` are rates in rad/s, the camera's axes; None where none was given.
    """
    printed = PRINTED[name]
    facts: dict[str, Any] = {"thesis": columns_as_printed(printed)}
    for estimator, rate in estimated.items():
        facts[estimator] = None if rate is None else columns(np.array(rate), exposure, printed.scale)
    facts["true"] = columns(true, exposure, printed.scale)
    head = f"Table {printed.number}, one frame"
    lines = [f"{head:28}" + "".join(f"{column:>26}" for column in facts)]
    for label, key in (
        (f"rate, {printed.unit}/s", "rate"),
        (f"displacement, {printed.unit}", "displacement"),
    ):
        cells = ["-" if column is None else f"{column[key]:.5f}" for column in facts.values()]
        lines.append(f"  {label:26}" + "".join(f"{cell:>26}" for cell in cells))
    cells = ["-" if column is None else _vector(column["axis"]) for column in facts.values()]
    lines.append(f"  {'rotation axis':26}" + "".join(f"{cell:>26}" for cell in cells))
    return lines, facts


def columns_as_printed(printed: Printed) -> dict[str, Any]:
    """Return the thesis's estimated column."""
    return {"rate": printed.rate, "displacement": printed.displacement, "axis": list(printed.axis)}


def _vector(axis: Sequence[float]) -> str:
    return "(" + ", ".join(f"{round(part, 3) + 0.0:.3f}" for part in axis) + ")"
