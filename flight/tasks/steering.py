"""Steering: from the estimate and the path of now to the currents of the coils; zero on any doubt."""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from flight import events
from flight.arrays import FloatArray
from flight.control.controller import Controller
from flight.estimation.estimate import ThreadEstimate
from flight.events import Condition, EventLog
from flight.guidance.guidance import Guidance, GuidanceState
from flight.guidance.path import Sample
from hal.interfaces.devices import TorqueCoils

_NO_CURRENT: FloatArray = np.zeros(3)


class SteeringState(IntEnum):
    """What the coils are used for; the values are those of the control packet."""

    OFF = 0
    FOLLOWING = 1
    HOLDING = 2


class Steering:
    """Commands the coil on body x, the one that turns the body about the thread (Sease 5.4)."""

    def __init__(
        self, guidance: Guidance, controller: Controller, coils: TorqueCoils, event_log: EventLog
    ) -> None:
        self._guidance = guidance
        self._controller = controller
        self._coils = coils
        self.state = SteeringState.OFF
        self.sample: Sample | None = None
        self.command: FloatArray = _NO_CURRENT
        self.saturated = False
        self._lost = Condition(event_log, events.CONTROL_LOST, events.CONTROL_REGAINED)
        self._holding = Condition(event_log, events.HOLDING, None)
        self._coil_fault = Condition(event_log, events.COIL_FAULT, events.COIL_RECOVERED)

    def run(self, estimate: ThreadEstimate | None, now_ns: int, ever_started: bool) -> None:
        """Command the coils for this cycle. `ever_started`: there was an estimate once, so none is a loss."""
        self.sample = self._guidance.sample(now_ns)
        self._lost.update(
            estimate is None and ever_started,
            now_ns,
            "no measurement fresh enough to steer by: coils to zero"
            if estimate is None
            else "steering again",
        )
        if estimate is None or self.sample is None:
            self.state = SteeringState.OFF
            self.command = _NO_CURRENT
            self.saturated = False
            self._controller.reset()
        else:
            following = self._guidance.state(now_ns) is GuidanceState.FOLLOWING
            self.state = SteeringState.FOLLOWING if following else SteeringState.HOLDING
            wanted = self._controller.command(
                self.sample, estimate.angle, estimate.rate, estimate.disturbance
            )
            self.saturated = wanted.saturated
            self.command = np.array([wanted.current, 0.0, 0.0])
        adrift = self.state is SteeringState.HOLDING and self._guidance.is_adrift(now_ns)
        self._holding.update(adrift, now_ns, "no newer path: holding the attitude at the end of the last")
        self._coils.command(self.command)
        error = self._coils.state().error
        self._coil_fault.update(bool(error), now_ns, error or "the PWM chip takes commands again")
