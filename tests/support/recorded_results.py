"""Results of estimators and planners, compared with a record of their numbers.

A test module that compares results with a record has one test function per case. `check(__file__, name,
result)` compares a result with the file `recorded_results.json` beside the module. `KNIGHTCUBE_RECORD=1
python -m pytest -n 0 MODULE` writes the record again, after an intended change of the results.

The record of an array contains its shape, the number of finite values, and their mean, root mean square and
weighted mean. Texts are not recorded, because their wording may change.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

from knightcube.compiled import in_use

TOLERANCE = 1e-5
"""Largest accepted relative difference of the `ANSWERS` from the record, for rounding in another order."""
OTHER_TOLERANCE = 2e-3
"""Largest accepted relative difference of all other values from the record.

Processors round sums differently, which may change the step at which an iteration stops.

The largest difference found is 0.06 %, in a misfit (1 of 68 cases of `tests/knightcube/vision`, 2026-11-29).
"""
COMPILED_TOLERANCE = 1e-2
"""Largest accepted relative difference of all other values from the record if compiled functions are used.

The largest difference found, of a covariance or a faint star, is 0.7 % (5 of 68 cases of
`tests/knightcube/vision`, 2026-11-27).
"""
ANSWERS = ("rate", "quaternion")
"""Names of the values that agree within `TOLERANCE` on all processors, even with compiled functions."""
COMPILED = in_use()
ZERO = 1e-15
CURE = "if the change is intended, set KNIGHTCUBE_RECORD=1 and run the test to write the record again"
_DEPTH = 6


def figures_of(value: Any, depth: int = 0) -> Any:
    """Return the numbers of a result as JSON: dataclasses and mappings by name, and statistics of arrays."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | float | str | Enum):
        return _plain(value)
    if isinstance(value, np.ndarray):
        return _array(value)
    found: Any = type(value).__name__
    if depth < _DEPTH:
        if is_dataclass(value) and not isinstance(value, type):
            value = {field.name: getattr(value, field.name) for field in fields(value)}
        if isinstance(value, Mapping):
            found = {str(key): figures_of(item, depth + 1) for key, item in value.items()}
        elif isinstance(value, list | tuple):
            found = [figures_of(item, depth + 1) for item in value]
    return found


def _plain(value: Any) -> Any:
    if isinstance(value, Enum):
        return f"{type(value).__name__}.{value.name}"
    if isinstance(value, str):
        return bool(value)
    return _number(value) if isinstance(value, float) else value


def _number(value: float) -> Any:
    return float(f"{value:.8g}") if math.isfinite(value) else str(value)


def _array(value: Any) -> Any:
    if value.dtype == object or value.dtype.kind in "USV":
        return [str(value.dtype.kind), len(value)]
    numbers = np.asarray(value, complex if value.dtype.kind == "c" else float).ravel()
    numbers = np.abs(numbers) if value.dtype.kind == "c" else numbers
    finite = np.isfinite(numbers)
    if not finite.any():
        return {"shape": list(value.shape), "finite": 0}
    weights = np.cos(1.0 + np.flatnonzero(finite) % 997)
    known = numbers[finite]
    sums = known.mean(), np.sqrt(np.mean(known**2)), np.mean(weights * known)
    return {
        "shape": list(value.shape),
        "finite": int(finite.sum()),
        "mean": _number(float(sums[0])),
        "rms": _number(float(sums[1])),
        "weighted": _number(float(sums[2])),
    }


def differences(record: Any, found: Any, tolerance: float, place: str = "", zero: float = 0.0) -> list[str]:
    """Return the key paths at which values differ from their record, one path per line.

    Numbers also agree if their difference is at most `zero`, the rounding error of a value that is exactly
    zero.
    """
    if isinstance(record, dict) and isinstance(found, dict):
        lines = [f"{place}.{key}: in one of them only" for key in sorted(record.keys() ^ found.keys())]
        scale = abs(record["rms"]) if isinstance(record.get("rms"), float) else None
        for key in sorted(record.keys() & found.keys()):
            if scale is not None and key in {"mean", "weighted"}:
                alike = abs(record[key] - found[key]) <= tolerance * scale + zero
                lines += [] if alike else [f"{place}.{key}: {found[key]}, recorded {record[key]}"]
            else:
                lines += differences(record[key], found[key], tolerance, f"{place}.{key}", zero)
        return lines
    if isinstance(record, list) and isinstance(found, list):
        if len(record) != len(found):
            return [f"{place}: {len(found)} entries, recorded {len(record)}"]
        pairs = enumerate(zip(record, found, strict=True))
        return [line for k, (a, b) in pairs for line in differences(a, b, tolerance, f"{place}.{k}", zero)]
    if isinstance(record, float) and isinstance(found, float):
        alike = math.isclose(record, found, rel_tol=tolerance, abs_tol=zero)
    else:
        alike = record == found
    return [] if alike else [f"{place}: {found}, recorded {record}"]


def check(module: str, name: str, result: Any, tolerance: float = TOLERANCE, zero: float = ZERO) -> None:
    """Fail if a result differs from its record, a file in the folder of the test module.

    The `ANSWERS` agree if they differ by at most the fraction `tolerance`, or by `zero`. The fraction of
    other values is `OTHER_TOLERANCE` if `tolerance` is not given, and `tolerance` otherwise. If compiled
    functions are used, the fraction of other values is at least `COMPILED_TOLERANCE`.
    """
    path = Path(module).with_name("recorded_results.json")
    records: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    found = json.loads(json.dumps(figures_of(result)))
    if os.environ.get("KNIGHTCUBE_RECORD"):
        records[name] = found
        lines = [f"{json.dumps(key)}: {json.dumps(records[key])}" for key in sorted(records)]
        path.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
        return
    assert unlike(records[name], found, tolerance, zero, COMPILED) == [], CURE


def unlike(record: Any, found: Any, tolerance: float, zero: float, compiled: bool) -> list[str]:
    """Return the key paths at which results differ from their record.

    Values other than the `ANSWERS` have a larger tolerance if `tolerance` is the default, or if compiled
    functions were used (`compiled`).
    """
    lines = differences(record, found, tolerance, zero=zero)
    answers = [line for line in lines if set(line.partition(":")[0].split(".")) & set(ANSWERS)]
    others = COMPILED_TOLERANCE if compiled else OTHER_TOLERANCE if tolerance == TOLERANCE else tolerance
    return answers + differences(record, found, max(tolerance, others), zero=zero)
