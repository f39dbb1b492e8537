"""Pictures of the RSO campaigns: frames with what was found in them, and detection over magnitude."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from knightcube.astro.arrays import FloatArray, Image
from knightcube.vision.objects.detect import ObjectReport

Shown = tuple[str, Image, ObjectReport | None, FloatArray]
"""A title, a frame, what was found in it, and where the object is: ends (2, 2) px."""


def draw_frames(frames: Sequence[Shown], path: Path) -> Path:
    """Draw frames side by side: the true object in a circle, each found one marked with crosses."""
    from matplotlib.figure import Figure  # noqa: PLC0415 - only here, an extra

    columns = min(len(frames), 4)
    rows = -(-len(frames) // columns)
    figure = Figure(figsize=(4.2 * columns, 4.4 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False)
    for axes in panels.flat:
        axes.set_axis_off()
    for axes, (title, pixels, report, truth) in zip(panels.flat, frames, strict=False):
        low = float(np.median(pixels))
        axes.imshow(np.sqrt(np.maximum(pixels - low, 0.0)), cmap="gray", vmax=np.sqrt(1000.0))
        centre, reach = truth.mean(axis=0), 0.5 * float(np.linalg.norm(truth[1] - truth[0])) + 25.0
        angle = np.linspace(0.0, 2.0 * np.pi, 60)
        axes.plot(centre[0] + reach * np.cos(angle), centre[1] + reach * np.sin(angle), color="#0072B2")
        for item in report.objects if report is not None else ():
            axes.plot(*item.endpoints.T, "x", color="#D55E00", markersize=7)
        axes.set(title=title, xlim=(0, pixels.shape[1]), ylim=(pixels.shape[0], 0))
    figure.savefig(path, dpi=100, facecolor="white")
    return path


def draw_detection_rate(curves: Mapping[str, Sequence[Mapping[str, Any]]], path: Path) -> Path:
    """Draw the share of objects found over their magnitude, with the 95 % that is asked for."""
    from matplotlib.figure import Figure  # noqa: PLC0415 - only here, an extra

    figure = Figure(figsize=(6.0, 4.0), layout="constrained")
    axes = figure.subplots()
    for name, rows in curves.items():
        counted = [row for row in rows if row["frames"]]
        share = [100.0 * row["found"] / row["frames"] for row in counted]
        axes.plot([row["magnitude"] for row in counted], share, "o-", label=name)
    axes.axhline(95.0, color="gray", linestyle="--", label="95 %")
    axes.set(xlabel="magnitude of the object", ylabel="found, %", ylim=(-3.0, 103.0))
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=100, facecolor="white")
    return path
