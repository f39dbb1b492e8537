"""The signals of a run that the report judges and draws: from the truth where it is known, else as flown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flight.link.telemetry.packets import PacketArray
from ground.telemetry.reader import Run
from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.gnc.coil_power import steady_heat, supply_power


@dataclass(frozen=True)
class Attitude:
    """The turn about the thread: time (n,) in s, q2 (n,), rate (n,) in rad/s.

    `source` is "truth" or "estimate".
    """

    time: FloatArray
    q2: FloatArray
    rate: FloatArray
    source: str


@dataclass(frozen=True)
class CoilPower:
    """The power of all coils together over the intervals of a run (`knightcube.gnc.coil_power`).

    Attributes:
        time: (n,) s, the beginning of each interval; the last one ends at `end`.
        end: s.
        supply: (n,) W, mean of V |I| over each interval: what the coils take from their supply.
        heat: (n,) W, mean of R I^2 over each interval: the heat of steady currents, the planner's cost.
        source: "truth", or "written" for the currents on the wire.
    """

    time: FloatArray
    end: float
    supply: FloatArray
    heat: FloatArray
    source: str

    @property
    def spans(self) -> FloatArray:
        """Lengths (n,) of the intervals, s."""
        return np.diff(np.append(self.time, self.end))

    @property
    def duration(self) -> float:
        """The time covered, s."""
        return float(np.sum(self.spans))

    def energy(self, power: FloatArray) -> float:
        """Return the integral of `supply` or `heat`, J."""
        return float(power @ self.spans)

    def average(self, power: FloatArray) -> float:
        """Return the mean of `supply` or `heat` over the run, W."""
        return self.energy(power) / self.duration

    def average_so_far(self, power: FloatArray) -> FloatArray:
        """Return the mean of `supply` or `heat` from the start to the end of each interval (n,), W."""
        return np.asarray(np.cumsum(power * self.spans) / np.cumsum(self.spans))


def seconds(packets: PacketArray) -> FloatArray:
    """Return the mission times (n,) of packets, in s."""
    return np.asarray(packets["time_ns"] / 1e9)


def true_rows(truth: PacketArray, packets: PacketArray) -> IntArray:
    """Return for each packet (n,) the row of the truth at the same time, -1 where there is none."""
    if not len(truth):
        return np.full(len(packets), -1)
    place = np.minimum(np.searchsorted(truth["time_ns"], packets["time_ns"]), len(truth) - 1)
    return np.where(truth["time_ns"][place] == packets["time_ns"], place, -1)


def true_attitude(run: Run) -> Attitude | None:
    """Return what the simulated body did, None where no truth is known."""
    truth = run["truth"]
    if not len(truth):
        return None
    quaternion = truth["quaternion"].astype(float)
    # q and -q are one attitude: q2 = sin(theta/2) of the turn in (-pi, pi) has the scalar part positive.
    q2 = quaternion[:, 1] * np.where(quaternion[:, 3] < 0.0, -1.0, 1.0)
    return Attitude(seconds(truth), q2, truth["rate"][:, 1].astype(float), "truth")


def estimated_attitude(run: Run) -> Attitude:
    """Return what the estimator believed, cycles without an estimate left out."""
    control = run["control"]
    known = np.isfinite(control["q2"]) & np.isfinite(control["rate"])
    control = control[known]
    return Attitude(seconds(control), control["q2"].astype(float), control["rate"].astype(float), "estimate")


def coil_power(run: Run) -> CoilPower | None:
    """Return the coils' power, None when neither the truth nor the coils' resistance is known."""
    return _true_power(run["truth"]) or _written_power(run["control"], run["run"])


def bus_power(run: Run) -> tuple[FloatArray, FloatArray]:
    """Return the times (n,), s, and the power (n,), W, that a monitor in the coils' supply measured.

    The power is the voltage of the bus, before the losses of the bridges, times the current of all coils.
    Both arrays are empty without a monitor.
    """
    packets = run["housekeeping"]
    packets = packets[np.isfinite(packets["coil_power"])]
    return seconds(packets), packets["coil_power"].astype(float)


def _true_power(truth: PacketArray) -> CoilPower | None:
    time = seconds(truth)
    if len(time) < 2 or not np.all(np.diff(time) > 0.0):
        return None
    spans = np.diff(time)
    supply = np.diff(truth["supply_energy"]) / spans
    heat = np.diff(truth["energy"]) / spans
    return CoilPower(time[:-1], float(time[-1]), supply, heat, "truth")


def _written_power(control: PacketArray, run: PacketArray) -> CoilPower | None:
    """Take each written current to stand until the next cycle writes its own."""
    time = seconds(control)
    if len(time) < 2 or not len(run):
        return None
    resistance = np.nan_to_num(run["coil_resistance"][0].astype(float))
    current = control["current_written"][:-1].astype(float)
    supply = supply_power(current, float(run["supply_voltage"][0])).sum(axis=1)
    heat = steady_heat(current, resistance).sum(axis=1)
    return CoilPower(time[:-1], float(time[-1]), supply, heat, "written")
