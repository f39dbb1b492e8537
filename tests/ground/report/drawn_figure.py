"""Description of a matplotlib figure as plain numbers, for comparison with a recorded description.

The description of a text contains only its numbers and its style, because the wording may change. The
description of a curve contains only five points and the mean.
"""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.collections import Collection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.text import Annotation, Text
from matplotlib.ticker import FixedLocator, LogLocator

FRACTIONS = (0.0, 0.21, 0.5, 0.83, 1.0)
"""Positions of the recorded points of a curve, as fractions of its number of points."""


def described(figure: Figure) -> dict[str, Any]:
    """Return a figure as numbers and short texts."""
    axes = figure.axes
    shared = [[k for k, other in enumerate(axes) if ax.get_shared_x_axes().joined(ax, other)] for ax in axes]
    return {
        "size": figure.get_size_inches().tolist(),
        "layout": type(figure.get_layout_engine()).__name__,
        "shared": shared,
        "axes": [_axes(ax) for ax in axes],
    }


def _axes(ax: Axes) -> dict[str, Any]:
    spec = ax.get_subplotspec()
    assert spec is not None
    grid = spec.get_gridspec()
    found: dict[str, Any] = {
        "kind": type(ax).__name__,
        "place": [*spec.get_geometry(), grid.get_height_ratios(), grid.get_width_ratios()],
        "limits": [*ax.get_xlim(), *ax.get_ylim()],
        "scales": [ax.get_xscale(), ax.get_yscale(), str(ax.get_aspect()), ax.get_adjustable()],
        "margins": list(ax.margins() or ()),
        "below": ax.get_axisbelow(),
        "x": _axis(ax.xaxis),
        "y": _axis(ax.yaxis),
        "spines": {
            name: [spine.get_visible(), _colour(spine.get_edgecolor())] for name, spine in ax.spines.items()
        },
        "texts": [_text(text) for text in ax.get_children() if isinstance(text, Text) and text.get_text()],
        "lines": [_line(line) for line in ax.get_lines()],
        "areas": [_collection(area) for area in ax.collections],
        "patches": [_patch(patch) for patch in ax.patches],
    }
    legend = ax.get_legend()
    if legend is not None:
        found["legend"] = {
            "texts": [_words(text.get_text()) for text in legend.get_texts()],
            "style": [legend._ncols, legend.get_frame_on(), legend._loc_real, legend.borderaxespad],  # type: ignore[attr-defined]  # it has no reader of its style
            "spacing": legend.columnspacing,
            "size": legend.get_texts()[0].get_fontsize() if legend.get_texts() else 0,
            "anchor": list(legend.get_bbox_to_anchor().transformed(ax.transAxes.inverted()).bounds),
            "marks": [_mark(mark) for mark in legend.legend_handles],
        }
    return found


def _axis(axis: Axis) -> dict[str, Any]:
    grid, label = axis.get_gridlines(), axis.get_ticklabels()
    locator, formatter = axis.get_major_locator(), axis.get_major_formatter()
    found: dict[str, Any] = {
        "label": _words(axis.label.get_text()),
        "grid": [bool(grid[0].get_visible()), _colour(grid[0].get_color()), grid[0].get_linewidth()]
        if grid
        else [],
        "ticks": [_colour(label[0].get_color()), label[0].get_fontsize()] if label else [],
    }
    if isinstance(locator, FixedLocator):
        found["at"] = np.asarray(locator()).tolist()
        found["words"] = [len(str(text.get_text())) for text in label]
    if type(formatter).__name__ == "FuncFormatter":
        found["shown"] = [formatter(value, 0) for value in (0.25, 1.5e-3)]
    if isinstance(locator, LogLocator):
        found["log"] = [[float(part) for part in locator._subs], locator.numticks]  # type: ignore[attr-defined]  # as above
    if axis.get_scale() == "symlog":
        found["linear"] = axis.get_transform().linthresh  # type: ignore[attr-defined]  # a symlog transform
    return found


def _text(text: Text) -> list[Any]:
    found = [_words(text.get_text()), text.get_fontsize(), text.get_fontweight(), _colour(text.get_color())]
    if isinstance(text, Annotation):
        return [
            *found,
            _numbers(text.xy),
            _numbers(text.get_position()),
            text.get_verticalalignment(),
            str(text.xycoords),
        ]
    return found


def _line(line: Line2D) -> dict[str, Any]:
    x, y = (np.asarray(values, float) for values in line.get_data(orig=False))
    return {
        "x": _curve(x),
        "y": _curve(y),
        "style": [
            _colour(line.get_color()),
            line.get_linewidth(),
            line.get_linestyle(),
            line.get_drawstyle(),
        ],
        "dashes": _dashes(line),
        "marks": [
            line.get_marker(),
            line.get_markersize(),
            _colour(line.get_markerfacecolor()),
            line.get_alpha(),
            line.get_zorder(),
        ],
        "label": _words(str(line.get_label())),
    }


def _dashes(line: Line2D) -> list[Any]:
    offset, dashes = line._dash_pattern  # type: ignore[attr-defined]  # it has no reader
    return [offset, list(dashes or ())]


def _collection(area: Collection) -> dict[str, Any]:
    outlines = [np.asarray(path.vertices, float) for path in area.get_paths()]
    corners = np.concatenate([np.zeros((0, 2)), *outlines])
    return {
        "kind": type(area).__name__,
        "corners": [_curve(corners[:, 0]), _curve(corners[:, 1])],
        "colours": [
            [_colour(c) for c in colours[:1]] for colours in (area.get_facecolor(), area.get_edgecolor())
        ],
        "style": [
            area.get_alpha(),
            [float(w) for w in np.atleast_1d(area.get_linewidth())[:1]],
            area.get_zorder(),
        ],
        "dashes": str(area.get_linestyle()[0])[:40],
        "label": _words(str(area.get_label())),
    }


def _patch(patch: Patch) -> dict[str, Any]:
    path = patch.get_patch_transform().transform(patch.get_path().vertices)
    return {
        "corners": [_curve(path[:, 0]), _curve(path[:, 1])],
        "style": [
            _colour(patch.get_facecolor()),
            _colour(patch.get_edgecolor()),
            patch.get_alpha(),
            patch.get_linewidth(),
        ],
        "label": _words(str(patch.get_label())),
    }


def _mark(mark: Artist | None) -> list[Any]:
    if isinstance(mark, Line2D):
        style = [
            mark.get_linewidth(),
            mark.get_marker(),
            mark.get_linestyle(),
            _colour(mark.get_markerfacecolor()),
        ]
        return [_colour(mark.get_color()), *style]
    return [type(mark).__name__, mark.get_alpha() if mark is not None else None]


def _curve(values: Any) -> list[Any]:
    """Return the length of an array, the mean of its finite values, and five of its values."""
    values = np.ma.filled(np.ma.asarray(values, float), np.nan)
    if not len(values):
        return [0]
    finite = values[np.isfinite(values)]
    places = [round(fraction * (len(values) - 1)) for fraction in FRACTIONS]
    return [len(values), float(finite.mean()) if len(finite) else None, *_numbers(values[places])]


def _numbers(values: Any) -> list[float | None]:
    return [float(value) if math.isfinite(value) else None for value in values]


def _words(text: str) -> Any:
    """Return the numbers in a text, or, if it has none, whether it is a visible text."""
    return re.findall(r"\d+\.?\d*", text) or bool(text and not text.startswith("_child"))


def _colour(colour: Any) -> str:
    return (
        str(to_hex(colour, keep_alpha=True))
        if len(np.shape(colour)) < 2
        else str(to_hex(np.asarray(colour)[0], True))
    )


def unlike(record: Any, found: Any, place: str = "") -> list[str]:
    """Return the keys at which a description differs from its record."""
    if isinstance(record, dict) and isinstance(found, dict):
        lines = [f"{place}.{key}: in one of them only" for key in sorted(record.keys() ^ found.keys())]
        return lines + [
            line
            for key in record.keys() & found.keys()
            for line in unlike(record[key], found[key], f"{place}.{key}")
        ]
    if isinstance(record, list) and isinstance(found, list):
        if len(record) != len(found):
            return [f"{place}: {len(found)} entries, recorded {len(record)}"]
        return [
            line
            for k, pair in enumerate(zip(record, found, strict=True))
            for line in unlike(*pair, f"{place}.{k}")
        ]
    if isinstance(record, float) and isinstance(found, float | int):
        alike = math.isclose(record, found, rel_tol=1e-4, abs_tol=1e-6)
    else:
        alike = record == found
    return [] if alike else [f"{place}: {found}, recorded {record}"]
