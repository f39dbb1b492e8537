"""The packets and texts of a satellite in orbit."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from flight.bodies.orbit.control import FieldBrake
from flight.bodies.orbit.environment import OrbitEnvironment
from flight.bodies.orbit.filter import OrbitFilter
from flight.link import events
from flight.link.modes import Mode
from flight.link.telemetry.definitions import NAVIGATION, SPIN
from flight.loop.body import ControlOutput, Target
from flight.loop.fdir import facts
from flight.loop.services import Services
from knightcube.gnc.estimation.estimate import Knowledge
from knightcube.gnc.estimation.measurements import MeanRateMeasurement

SPIN_EVERY = 10
"""Control cycles from one spin packet to the next."""
NAVIGATION_EVERY = 40
"""Control cycles from one navigation packet to the next."""
LEVELS = (Knowledge.LOST, Knowledge.COARSE, Knowledge.FINE)
"""The knowledge by its number in the packet."""
_NAN3 = [math.nan] * 3


class OrbitView:
    """Implements `flight.loop.body.BodyView`."""

    def __init__(
        self, brake: FieldBrake, filter_: OrbitFilter, environment: OrbitEnvironment, services: Services
    ) -> None:
        self._filter = filter_
        self._environment = environment
        self._events = services.events
        self._facts = services.facts
        self._knowledge = Knowledge.LOST
        self._detumbler = brake.detumbler
        self._recorder = services.recorder

    def record_cycle(self, output: ControlOutput) -> None:
        """Record how well the attitude is known, and the spin packet while the body is braked."""
        self._record_knowledge(output)
        if output.mode is not Mode.DETUMBLE or output.cycle.slot % SPIN_EVERY:
            return
        found = self._detumbler
        rate, field = found.rate, found.field
        self._recorder.record(
            SPIN,
            output.cycle.start_ns,
            known=int(rate is not None),
            rate=_NAN3 if rate is None else rate.tolist(),
            rate_sigma=found.rate_sigma,
            field=_NAN3 if field is None else field.tolist(),
            restarts=found.restarts,
            dipole=output.steered.dipole.tolist(),
        )

    def _record_knowledge(self, output: ControlOutput) -> None:
        """Record the navigation packet; report another knowledge as an event."""
        found, now_ns, estimate = self._filter, output.cycle.start_ns, output.estimate
        known = found.knowledge
        if known is not self._knowledge:
            text = f"{self._knowledge.value} -> {known.value}"
            self._events.report(events.ATTITUDE_KNOWLEDGE, now_ns, text)
            self._knowledge = known
        if output.cycle.slot % NAVIGATION_EVERY:
            return
        doubt = found.field_doubt
        self._facts.update(
            facts.FIELD_REFUSED, bool(doubt), now_ns, doubt or "the magnetometer agrees with the estimate"
        )
        self._recorder.record(
            NAVIGATION,
            now_ns,
            knowledge=LEVELS.index(known),
            placed=int(self._environment.known),
            refused=found.refused,
            fixes_refused=self._environment.refused,
            restarts=found.restarts,
            gyro_bias=_NAN3 if estimate is None else estimate.bias.tolist(),
            field_bias=_NAN3 if estimate is None else estimate.field_bias.tolist(),
            residual_dipole=_NAN3 if estimate is None else found.residual_dipole.tolist(),
        )

    def announce(self, target: Target, now_ns: int) -> None:
        """Report a new target as an event."""
        self._events.report(events.TARGET, now_ns, target.law.text)

    def mode_fields(self, wanted: Target | None) -> Mapping[str, float]:
        """Return the body's fields of the mode packet."""
        return {"target_q2": math.nan}

    def rate_text(self, rate: MeanRateMeasurement) -> str:
        """Return a rate from streaks as text."""
        return f"{np.rad2deg(rate.rate).round(3).tolist()} deg/s"

    def progress(self, output: ControlOutput | None) -> str:
        """Return mode and rate as text, for the progress line."""
        mode = output.mode if output else Mode.BOOT
        if self._knowledge is not Knowledge.LOST:
            return f"{mode.label}, attitude {self._knowledge.value}"
        rate = self._detumbler.rate if mode is Mode.DETUMBLE else None
        if rate is None:
            return mode.label
        return f"{mode.label} {math.degrees(float(np.linalg.norm(rate))):.2f} deg/s by the magnetometer"
