"""The controllers by name: which one a configuration means."""

from __future__ import annotations

from flight.gnc.control.one_axis.adaptive import AdaptiveController, AdaptiveSettings
from flight.gnc.control.one_axis.controller import Controller
from flight.gnc.control.one_axis.excitation import ExcitationController, ExcitationSettings
from flight.gnc.control.one_axis.lq_tracker import LqTracker
from flight.gnc.control.one_axis.pid import PidController
from flight.gnc.guidance.one_axis.plant import SingleAxisPlant
from flight.schema.sections import Control, Identification


def controller_of(
    section: Control,
    plant: SingleAxisPlant,
    period: float,
    identification: Identification = Identification(),  # noqa: B008 - frozen
) -> Controller:
    """Return the controller that `section` chooses for `plant`, commanded every `period` s."""
    if section.tracker == "excitation":
        move = identification
        return ExcitationController(
            plant, period, ExcitationSettings(move.current_share, move.largest_q2, move.swing)
        )
    if section.tracker == "pid":
        return PidController(plant, period, section.bandwidth, section.target_weight)
    if section.tracker == "adaptive":
        settings = AdaptiveSettings(section.bandwidth, section.adaptation, section.reference_bandwidth)
        return AdaptiveController(plant, period, settings)
    return LqTracker(
        plant, section.state_weight, section.control_weight, as_in_thesis=section.tracker == "thesis"
    )
