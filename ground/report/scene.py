"""The signals that the panels draw, taken from a run's packets."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from flight.link.telemetry.packets import PacketArray
from ground.report import performance as limits
from ground.report.sensing import covariance_matrices, mean_rates, with_rate
from ground.report.signals import (
    Attitude,
    CoilPower,
    bus_power,
    coil_power,
    estimated_attitude,
    seconds,
    true_attitude,
)
from ground.telemetry.reader import Run
from knightcube.astro.arrays import FloatArray
from knightcube.gnc.guidance.one_axis.path import lgl_rule


@dataclass(frozen=True)
class Scene:
    """The signals of one run, computed once for all panels."""

    run: Run

    @cached_property
    def truth(self) -> Attitude | None:
        """The true attitude, None when not known."""
        return true_attitude(self.run)

    @cached_property
    def estimate(self) -> Attitude:
        """The estimated attitude."""
        return estimated_attitude(self.run)

    @cached_property
    def flown(self) -> Attitude:
        """The true attitude, the estimated one where the truth is not known."""
        return self.truth or self.estimate

    @cached_property
    def power(self) -> CoilPower | None:
        """The coils' power."""
        return coil_power(self.run)

    @cached_property
    def bus_power(self) -> tuple[FloatArray, FloatArray]:
        """Times (n,), s, and power (n,), W, of the monitor in the coils' supply."""
        return bus_power(self.run)

    @cached_property
    def end(self) -> float:
        """The last moment of the flight log, s."""
        ends = [seconds(self.run[name])[-1] for name in ("control", "truth") if len(self.run[name])]
        return max(ends, default=0.0)

    @cached_property
    def current_limit(self) -> float:
        """The limit of a coil's current as configured, the thesis's where that is not known."""
        run = self.run["run"]
        return float(run["current_limit"][0]) if len(run) else limits.CURRENT_LIMIT_A


def planned_path(plan: PacketArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return time (m,) s and q2 (m,) along a plan packet's path, and both on its nodes (n,)."""
    nodes = int(plan["nodes"])
    values = plan["node_q2"][:nodes].astype(float)
    rule = lgl_rule(nodes)
    points = np.linspace(-1.0, 1.0, 201)
    origin, horizon = float(plan["origin_ns"]) / 1e9, float(plan["horizon"])

    def at(x: FloatArray) -> FloatArray:
        return np.asarray(origin + 0.5 * horizon * (x + 1.0))

    return at(points), rule.interpolation(points) @ values, at(rule.nodes), values


def streak_rates(run: Run) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the rates (n,) about the thread from streaks.

    In order: middle of the exposure, s; rate, its standard deviation, and rate less the true mean, rad/s.
    The standard deviation is 0 and the difference NaN where not known.
    """
    rated = with_rate(run["streak"])
    start = rated["exposure_start_ns"] / 1e9
    stop = start + rated["exposure"]
    variance = np.nan_to_num(covariance_matrices(rated["covariance"])[:, 1, 1])
    difference = rated["rate"][:, 1] - mean_rates(run["truth"], start, stop)[:, 1]
    value = rated["rate"][:, 1].astype(float)
    return 0.5 * (start + stop), value, np.sqrt(np.maximum(variance, 0.0)), difference
