"""Plot of a campaign: each performance measure of the flights against each randomly drawn value."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from textwrap import fill

import numpy as np

from ground.campaigns.runner import Result
from ground.campaigns.varied import figures_of, numbers_drawn
from ground.report import drawing

_LABEL = 22  # maximum number of characters in a line of an axis label
_MOST = 6  # maximum number of rows and of columns of panels in the plot


def draw_campaign(results: Sequence[Result], file: Path) -> bool:
    """Plot the performance measures of all flights against the random parameters, as a PNG.

    Returns False and writes no file if the results have no performance measures or no random parameters. At
    most six measures are plotted against at most six parameters. Crosses mark flights beyond the limit of a
    measure; infinite measures are at the upper edge. Raises UsageError if matplotlib is not installed or the
    file cannot be written.
    """
    drawn = list(numbers_drawn(results).items())[:_MOST]
    figures = [one for one in figures_of(results).items() if np.any(np.isfinite(one[1][2]))][:_MOST]
    if not (drawn and figures):
        return False
    with drawing(file):
        from matplotlib.figure import Figure  # noqa: PLC0415 - an extra
        from matplotlib.ticker import MaxNLocator  # noqa: PLC0415

        from ground.report import panels  # noqa: PLC0415
        from ground.report.figures import save  # noqa: PLC0415

        size = (2.0 + 3.2 * len(drawn), 0.8 + 2.4 * len(figures))
        figure = Figure(figsize=size, layout="constrained")
        grid = figure.subplots(len(figures), len(drawn), squeeze=False, sharex="col", sharey="row")
        for row, (name, (limit, unit, listed)) in enumerate(figures):
            values = np.array(listed)
            for axes, (key, numbers) in zip(grid[row], drawn, strict=True):
                chosen = np.array(numbers)
                good = values <= limit
                beyond = np.isfinite(values) & ~good
                axes.plot(chosen[good], values[good], ".", color=panels.BLUE, markersize=5)
                axes.plot(chosen[beyond], values[beyond], "x", color=panels.VERMILLION, markersize=6)
                infinite = chosen[np.isinf(values)]
                if len(infinite):
                    edge = axes.get_xaxis_transform()
                    axes.plot(infinite, np.ones_like(infinite), "x", color=panels.VERMILLION, transform=edge)
                axes.axhline(limit, color=panels.GREY, linestyle=panels.DASHED, linewidth=1.0)
                label = fill(f"{name}, {unit}", _LABEL) if axes is grid[row][0] else ""
                panels.style(axes, label, "", key if row == len(figures) - 1 else "")
                axes.margins(0.06)
                axes.xaxis.set_major_locator(MaxNLocator(4))
            known = values[np.isfinite(values)]
            if known.min() > 0.0 and known.max() > 30.0 * known.min():
                grid[row][0].set_yscale("log")
        save(figure, file)
    return True
