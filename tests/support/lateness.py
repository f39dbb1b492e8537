"""Lateness and lost slots of a periodic loop, and the slots that were lost because the machine was busy."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

Times = npt.NDArray[np.int64]
QUANTILES = {"p50": 0.5, "p99": 0.99, "p99.9": 0.999, "max": 1.0}


@dataclass(frozen=True)
class Grid:
    """Lateness (s) of a loop at each slot. Slot k is due at (first + k) periods of monotonic time."""

    first: int
    period_ns: int
    lateness: npt.NDArray[np.float64]

    @property
    def lost(self) -> npt.NDArray[np.bool_]:
        """Slots that the loop reached at least half a period late (`flight.loop.executive`)."""
        return np.asarray(2.0 * self.lateness >= self.period_ns * 1e-9)

    def figures(self) -> dict[str, float]:
        """Return quantiles (s) of the lateness. A lost slot's lateness is counted until the loop resumes."""
        return {name: float(np.quantile(self.lateness, part)) for name, part in QUANTILES.items()}


def on_grid(starts_ns: Times, period_ns: int, first: int, count: int) -> Grid:
    """Return the lateness of `count` slots from `first`: the delay from each due time to the next start.

    `starts_ns` are in monotonic time and sorted. Slots after the last start are infinitely late.
    """
    due_ns = (first + np.arange(count, dtype=np.int64)) * period_ns
    place = np.searchsorted(starts_ns, due_ns)
    lateness = np.full(count, np.inf)
    served = place < len(starts_ns)
    lateness[served] = (starts_ns[place[served]] - due_ns[served]) * 1e-9
    return Grid(first, period_ns, lateness)


def stalled(machine: Grid) -> npt.NDArray[np.bool_]:
    """Return the slots that the bare loop lost, and their neighbours.

    A stall of the machine may begin and end in different slots of the two loops, because one loop may be
    working while the other sleeps.
    """
    return np.asarray(np.convolve(machine.lost, np.ones(3), mode="same") > 0.5)


def robbed(loop: Grid, noted_ns: Times, stolen_ns: Times) -> npt.NDArray[np.bool_]:
    """Return the slots that are late because the virtual machine's host took the processor (stolen time).

    The stolen time of a returned slot is at least half the period and at least half the lateness. A slot
    lasts from the due time of its predecessor to the first sample after the slot was served. `stolen_ns` is
    the stolen time of all cores since boot, sampled at `noted_ns`.
    """
    due_ns = (loop.first + np.arange(len(loop.lateness))) * loop.period_ns
    late_ns = 1e9 * np.minimum(loop.lateness, 60.0)
    before = np.searchsorted(noted_ns, due_ns - loop.period_ns, side="right") - 1
    after = np.searchsorted(noted_ns, due_ns + late_ns)
    last = len(noted_ns) - 1
    taken = stolen_ns[np.minimum(after, last)] - stolen_ns[np.maximum(before, 0)]
    return np.asarray(2.0 * taken >= np.maximum(loop.period_ns, late_ns))


def slope_per_hour(
    seconds: npt.ArrayLike, values: npt.ArrayLike, blocks: int = 20
) -> tuple[float, float, float]:
    """Return the slope per hour of a noisy level and its 95 % interval (low, high), or NaN.

    The slope is NaN if the samples cover too short a time. The level is noisy, because a process allocates
    and frees memory as it works. The level of each block of time is its 10 % quantile, which also increases
    with a leak. The slope is the median of all pairwise slopes of the blocks, and its interval follows from
    Kendall's tau (Sen 1968, doi 10.1080/01621459.1968.10480934).
    """
    from scipy import stats  # noqa: PLC0415 - sharing its pages would change the flight's measured memory

    times, levels = np.asarray(seconds, dtype=np.float64), np.asarray(values, dtype=np.float64)
    if len(times) < 3 * blocks:
        return np.nan, np.nan, np.nan
    parts = np.array_split(np.arange(len(times)), blocks)
    middles = [float(times[part].mean()) / 3600.0 for part in parts]
    floors = [float(np.quantile(levels[part], 0.1)) for part in parts]
    found = stats.theilslopes(floors, middles, 0.95)
    return float(found.slope), float(found.low_slope), float(found.high_slope)


def draw(grids: dict[str, Grid], path: Path) -> None:
    """Draw histograms of the lateness with two logarithmic axes."""
    from matplotlib.figure import Figure  # noqa: PLC0415 - an extra

    figure = Figure(figsize=(8.0, 4.5), layout="constrained")
    axes = figure.subplots()
    edges = np.geomspace(1e-2, 1e3, 101)
    for (name, grid), colour in zip(
        grids.items(), ("#0072B2", "#D55E00", "#56B4E9", "#E69F00"), strict=False
    ):
        finite = 1e3 * grid.lateness[np.isfinite(grid.lateness)]
        axes.hist(
            np.clip(finite, edges[0], edges[-1]), edges.tolist(), histtype="step", color=colour, label=name
        )
    half = 0.5e-6 * next(iter(grids.values())).period_ns
    axes.axvline(half, color="0.3", linestyle=":", linewidth=1)
    axes.annotate(" lost", (half, 0.9), xycoords=("data", "axes fraction"), color="0.3")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("lateness (ms)")
    axes.set_ylabel("slots")
    axes.legend(frameon=False)
    figure.savefig(path, dpi=150)
