"""The control laws of the testbed: B-dot detumbling, and a controller of the turn about the thread."""

from __future__ import annotations

import numpy as np

from flight.bodies.testbed.thread import ThreadReader
from flight.loop.body import CoilCommand
from flight.schema.testbed import Control, Identification
from knightcube.astro.arrays import FloatArray
from knightcube.gnc.control.detumble import Detumbler
from knightcube.gnc.control.one_axis.excitation import ExcitationController, ExcitationSettings
from knightcube.gnc.control.one_axis.lq_tracker import AngleController, LqTracker
from knightcube.gnc.estimation.estimate import Estimate
from knightcube.gnc.guidance.one_axis.path import PathSample
from knightcube.gnc.guidance.one_axis.plant import SingleAxisPlant
from knightcube.reference.control import AdaptiveController, AdaptiveSettings, PidController, PidSettings


class BdotBrake:
    """Commands the detumbler's currents; implements `flight.loop.body.Brake`."""

    def __init__(self, detumbler: Detumbler, dipole_per_ampere: float) -> None:
        """Take n A of each coil, m^2."""
        self._detumbler = detumbler
        self._dipole_per_ampere = dipole_per_ampere

    def begin(self, now_ns: int) -> None:
        """Begin with no knowledge of the field."""
        self._detumbler.begin(now_ns)

    def sample(self, time_ns: int, field: FloatArray, rate: FloatArray) -> None:
        """Accept a field (3,) T measured at `time_ns`; the law needs no rate of the gyro."""
        self._detumbler.sample(time_ns, field)

    def command(self, now_ns: int) -> CoilCommand:
        """Return the command now."""
        currents = self._detumbler.current(now_ns)
        return CoilCommand(currents * self._dipole_per_ampere, currents)

    def sent(self, currents: FloatArray) -> None:
        """Do nothing: B-dot needs no model of the motion."""

    def field(self, now_ns: int) -> FloatArray | None:
        """Return the field (3,) T in body axes now; None before it is known."""
        return self._detumbler.field(now_ns)


def controller_of(
    section: Control,
    plant: SingleAxisPlant,
    period: float,
    identification: Identification,
) -> AngleController:
    """Return the controller of `plant` that `section` chooses, called every `period` s."""
    if section.tracker == "excitation":
        move = identification
        return ExcitationController(
            plant, period, ExcitationSettings(move.current_share, move.largest_q2, move.swing)
        )
    if section.tracker == "pid":
        free = section.gains
        gains = (
            PidSettings.placed(section.bandwidth)
            if free is None
            else PidSettings(free.proportional, free.integral, free.derivative)
        )
        return PidController(plant, period, gains, section.target_weight)
    if section.tracker == "adaptive":
        settings = AdaptiveSettings(section.bandwidth, section.adaptation, section.reference_bandwidth)
        return AdaptiveController(plant, period, settings)
    return LqTracker(
        plant, section.state_weight, section.control_weight, as_in_thesis=section.tracker == "thesis"
    )


class ThreadTracker:
    """Implements `flight.loop.body.Tracker` with the coil on body x (Sease 5.4)."""

    def __init__(self, controller: AngleController, reader: ThreadReader, dipole_per_ampere: float) -> None:
        self._controller = controller
        self._read = reader.read
        self._dipole = dipole_per_ampere

    def command(self, estimate: Estimate, reference: PathSample) -> CoilCommand:
        """Return the command that keeps the body on the reference."""
        now = self._read(estimate)
        wanted = self._controller.command(reference, now.angle, now.rate, now.disturbance)
        currents = np.array([wanted.current, 0.0, 0.0])
        return CoilCommand(self._dipole * currents, currents, wanted.saturated)

    def reset(self) -> None:
        """Forget integrated errors."""
        self._controller.reset()
