"""The tracker of the testbed: a controller of the turn about the thread."""

from __future__ import annotations

import numpy as np

from flight.bodies.testbed.thread_estimate import ThreadReader
from flight.loop.control_output import CoilCommand
from flight.schema.testbed import Control, Identification
from knightcube.gnc.control.one_axis.excitation import ExcitationController, ExcitationSettings
from knightcube.gnc.control.one_axis.lq_tracker import AngleController, LqTracker
from knightcube.gnc.estimation.estimate import Estimate
from knightcube.gnc.guidance.one_axis.path import PathSample
from knightcube.gnc.guidance.one_axis.plant import SingleAxisPlant
from knightcube.reference.control import AdaptiveController, AdaptiveSettings, PidController, PidSettings


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
