"""Steering: from the estimate and the path to a coil command; zero without a trusted estimate."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from flight.loop.body import Body, Brake
from flight.loop.control_output import CoilCommand, Steered, SteeringState
from flight.loop.fdir import facts
from flight.loop.services import Services
from flight.loop.tasks.coil_drive import CoilDrive
from hal.interfaces.readings import ImuReading
from knightcube.astro.arrays import FloatArray
from knightcube.gnc.estimation.estimate import Estimate

_NO_DIPOLE: FloatArray = np.zeros(3)


class Steering:
    """Steers the body along its path, brakes it, or rests.

    Control is lost when no reading within its age limit agrees with the estimate, or, while braking, when
    there is no such reading. The model carries the estimate on over a silence, so that control returns
    smoothly, but no current flows meanwhile: it is zero within a tenth of a second of the last reading.
    Without a planner the body is steered along its last path and held at its end (event `holding`). Without a
    path no current flows.
    """

    def __init__(self, body: Body, drive: CoilDrive, services: Services) -> None:
        self._body = body
        self._drive = drive
        self._facts = services.facts

    def run(self, estimate: Estimate | None, now_ns: int, ever_started: bool) -> Steered:
        """Follow or hold in this cycle; `estimate` is None unless measured.

        `ever_started`: there was an estimate before, so that None is a loss of control.
        """
        body = self._body
        reference = body.paths.sample(now_ns)
        text = "steering again" if estimate else "no measurement fresh enough to steer by: coils to zero"
        self._facts.update(facts.CONTROL_LOST, estimate is None and ever_started, now_ns, text)
        state, dipole, saturated, adrift = SteeringState.OFF, _NO_DIPOLE, False, False
        if estimate is None or reference is None:
            self._release()
        else:
            following = body.paths.is_following(now_ns)
            state = SteeringState.FOLLOWING if following else SteeringState.HOLDING
            wanted: CoilCommand = body.tracker.command(estimate, reference)
            dipole, saturated = wanted.dipole, wanted.saturated
            self._drive.send(wanted.currents, lambda: body.field(estimate))
            adrift = not following and body.paths.is_adrift(now_ns)
        self._facts.update(
            facts.HOLDING, adrift, now_ns, "no newer path: holding the attitude at the end of the last"
        )
        return self._steered(state, now_ns, reference, dipole, saturated)

    def begin_braking(self, now_ns: int) -> None:
        """Begin the measuring and acting windows of detumbling."""
        self._body.brake.begin(now_ns)

    def begin_seeking(self, now_ns: int) -> None:
        """Begin the windows of turning to the Sun, where the body can."""
        if self._body.seeker is not None:
            self._body.seeker.begin(now_ns)

    def brake(self, readings: Sequence[ImuReading], heard: bool, now_ns: int) -> Steered:
        """Detumble in this cycle; `heard`: its newest reading is fresh enough."""
        return self._drive_by(self._body.brake, SteeringState.BRAKING, readings, heard, now_ns)

    def seek(self, readings: Sequence[ImuReading], heard: bool, now_ns: int) -> Steered:
        """Turn to the Sun in this cycle, without an attitude; rest where nothing does that."""
        if self._body.seeker is None:
            return self.rest(now_ns)
        return self._drive_by(self._body.seeker, SteeringState.BRAKING, readings, heard, now_ns)

    def _drive_by(
        self, brake: Brake, acting: SteeringState, readings: Sequence[ImuReading], heard: bool, now_ns: int
    ) -> Steered:
        """Command what needs no estimate."""
        for reading in readings:
            brake.sample(reading.time_ns, reading.field, reading.rate)
        text = "braking again" if heard else "no reading fresh enough to brake by: coils to zero"
        self._facts.update(facts.CONTROL_LOST, not heard, now_ns, text)
        state, dipole = SteeringState.OFF, _NO_DIPOLE
        if heard:
            self._body.tracker.reset()
            state, wanted = acting, brake.command(now_ns)
            dipole = wanted.dipole
            self._drive.send(wanted.currents, lambda: brake.field(now_ns))
            brake.sent(self._drive.command)
        else:
            self._release()
        return self._steered(state, now_ns, None, dipole)

    def rest(self, now_ns: int) -> Steered:
        """Keep the coils at zero in this cycle."""
        self._release()
        return self._steered(SteeringState.OFF, now_ns, None, _NO_DIPOLE)

    def zero(self) -> None:
        """Command zero current."""
        self._drive.zero()

    def isolate(self) -> None:
        """Exclude the coils that have a verdict."""
        self._drive.isolate()

    def _release(self) -> None:
        self._drive.zero()
        self._body.tracker.reset()

    def _steered(
        self,
        state: SteeringState,
        now_ns: int,
        reference: Any | None,
        dipole: FloatArray,
        saturated: bool = False,
    ) -> Steered:
        """Check the PWM chip, which may switch the coils off; return the currents commanded in the end."""
        error = self._drive.fault()
        text = error or "the PWM chip takes commands again"
        self._facts.update(facts.COIL_FAULT, bool(error), now_ns, text)
        return Steered(state, reference, dipole, self._drive.command, saturated)
