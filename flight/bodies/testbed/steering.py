"""Steering: from the estimate and the path of now to the currents of the coils; zero on any doubt."""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from flight.gnc.control.detumble import Detumbler
from flight.gnc.control.one_axis.controller import Controller
from flight.gnc.estimation.estimate import ThreadEstimate
from flight.gnc.guidance.one_axis.guidance import Guidance, GuidanceState
from flight.gnc.guidance.one_axis.path import Sample
from flight.gnc.math.arrays import FloatArray
from flight.loop.coil_drive import CoilDrive
from flight.loop.fdir import facts
from flight.loop.fdir.facts import Facts
from flight.loop.navigation import Navigation
from hal.interfaces.devices import TorqueCoils


class SteeringState(IntEnum):
    """What the coils are used for; the values are those of the control packet."""

    OFF = 0
    FOLLOWING = 1
    HOLDING = 2
    BRAKING = 3


class Steering:
    """Turns the body about the thread by the coil on body x (Sease 5.4), brakes it, or rests.

    Control is lost when no reading within its age limit agrees with the estimate, or, while braking, when
    there is none. The model carries the estimate on over a silence, so that control comes back smoothly, but
    a current that flows meanwhile is nobody's: within a tenth of a second of the last reading it is zero.
    A planner that is gone is no loss while there is a path: the body is steered along it by the readings, and
    at its end held there, which is told (`holding`). Without a path no current flows.
    """

    def __init__(
        self,
        guidance: Guidance,
        controller: Controller,
        detumbler: Detumbler,
        navigation: Navigation,
        coils: TorqueCoils,
        drive: CoilDrive,
        facts_: Facts,
    ) -> None:
        self._guidance = guidance
        self._controller = controller
        self._detumbler = detumbler
        self._navigation = navigation
        self._coils = coils
        self._drive = drive
        self._facts = facts_
        self.state = SteeringState.OFF
        self.sample: Sample | None = None
        self.saturated = False

    @property
    def command(self) -> FloatArray:
        """The currents (3,) A asked of the coils in this cycle."""
        return self._drive.command

    def run(self, estimate: ThreadEstimate | None, now_ns: int, ever_started: bool) -> None:
        """Follow or hold in this cycle, by an `estimate` that is measured.

        `ever_started`: there was an estimate once, so none is a loss.
        """
        self.sample = self._guidance.sample(now_ns)
        text = "steering again" if estimate else "no measurement fresh enough to steer by: coils to zero"
        self._facts.state(facts.CONTROL_LOST, estimate is None and ever_started, now_ns, text)
        if estimate is None or self.sample is None:
            self._let_go(now_ns)
            adrift = False
        else:
            following = self._guidance.state(now_ns) is GuidanceState.FOLLOWING
            self.state = SteeringState.FOLLOWING if following else SteeringState.HOLDING
            wanted = self._controller.command(
                self.sample, estimate.angle, estimate.rate, estimate.disturbance
            )
            self.saturated = wanted.saturated
            current = np.array([wanted.current, 0.0, 0.0])
            self._drive.send(current, lambda: self._navigation.field(estimate.angle))
            adrift = not following and self._guidance.is_adrift(now_ns)
        self._facts.state(
            facts.HOLDING, adrift, now_ns, "no newer path: holding the attitude at the end of the last"
        )
        self._look_at_coils(now_ns)

    def begin_braking(self, now_ns: int) -> None:
        """Begin the windows of detumbling anew."""
        self._detumbler.begin(now_ns)

    def brake(self, now_ns: int) -> None:
        """Detumble in this cycle, by the magnetometer alone."""
        for reading in self._navigation.readings:
            self._detumbler.sample(reading.time_ns, reading.field)
        heard = self._navigation.is_heard(now_ns)
        text = "braking again" if heard else "no reading fresh enough to brake by: coils to zero"
        self._facts.state(facts.CONTROL_LOST, not heard, now_ns, text)
        self._controller.reset()
        self.sample, self.saturated = None, False
        self.state = SteeringState.BRAKING if heard else SteeringState.OFF
        if heard:
            self._drive.send(self._detumbler.current(now_ns), lambda: self._detumbler.field(now_ns))
        else:
            self._drive.zero()
        self._look_at_coils(now_ns)

    def rest(self, now_ns: int) -> None:
        """Keep the coils at zero in this cycle."""
        self.sample = None
        self._let_go(now_ns)
        self._look_at_coils(now_ns)

    def _let_go(self, now_ns: int) -> None:
        self.state = SteeringState.OFF
        self.saturated = False
        self._drive.zero()
        self._controller.reset()

    def _look_at_coils(self, now_ns: int) -> None:
        error = self._coils.state().error
        text = error or "the PWM chip takes commands again"
        self._facts.state(facts.COIL_FAULT, bool(error), now_ns, text)
