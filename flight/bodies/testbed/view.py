"""The testbed's packets and texts, in q2 and the turn about the thread."""

from __future__ import annotations

import math
from collections.abc import Mapping

from flight.bodies.testbed.planning import Planning
from flight.bodies.testbed.thread_estimate import ThreadReader
from flight.bodies.testbed.thread_law import law_of
from flight.link import events
from flight.link.telemetry.definitions import CONTROL, TARGET
from flight.loop.control_output import KEPT, ControlOutput, Target
from flight.loop.services import Services
from knightcube.gnc.estimation.measurements import MeanRateMeasurement


class ThreadView:
    """Implements `flight.loop.body.BodyView`."""

    def __init__(self, reader: ThreadReader, planning: Planning, services: Services) -> None:
        self._read = reader.read
        self._planning = planning
        self._recorder = services.recorder
        self._events = services.events

    def record_cycle(self, output: ControlOutput) -> None:
        """Record the control packet."""
        estimate = self._read(output.estimate) if output.estimate is not None else None
        steered, sample, written = output.steered, output.steered.reference, output.written
        now_ns, nan = output.cycle.start_ns, math.nan
        self._recorder.record(
            CONTROL,
            now_ns,
            cycle=output.cycle.slot,
            state=int(steered.state),
            estimate_age=(now_ns - estimate.measured_ns) * 1e-9 if estimate else nan,
            angle=estimate.angle if estimate else nan,
            q2=estimate.q2 if estimate else nan,
            rate=estimate.rate if estimate else nan,
            angle_sigma=math.sqrt(estimate.covariance[0, 0]) if estimate else nan,
            rate_sigma=math.sqrt(estimate.covariance[1, 1]) if estimate else nan,
            target_q2=law_of(output.target).q2 if output.target else nan,
            path_q2=math.sin(0.5 * sample.angle) if sample else nan,
            path_rate=sample.rate if sample else nan,
            path_acceleration=sample.acceleration if sample else nan,
            plan=self._planning.flown,
            current_command=steered.currents.tolist(),
            current_written=written.current.tolist(),
            saturated=int(written.saturated or steered.saturated),
        )

    def announce(self, target: Target, now_ns: int) -> None:
        """Record and report a new target, unless the present attitude is held."""
        if target.index == KEPT:
            return
        law = law_of(target)
        self._recorder.record(TARGET, now_ns, index=target.index, q2=law.q2, rate=law.rate)
        self._events.report(events.TARGET, now_ns, f"step {target.index}: q2 = {law.q2:+.2f}")

    def mode_fields(self, wanted: Target | None) -> Mapping[str, float]:
        """Return the body's fields of the mode packet."""
        return {"target_q2": math.nan if wanted is None else law_of(wanted).q2}

    def rate_text(self, rate: MeanRateMeasurement) -> str:
        """Return a rate from streaks as text."""
        return f"{rate.rate[1]:.5f} rad/s +- {math.sqrt(rate.covariance[1, 1]):.1e}"

    def progress(self, output: ControlOutput | None) -> str:
        """Return target and attitude as text, for the progress line."""
        target, estimate = (None, None) if output is None else (output.target, output.estimate)
        wanted = law_of(target).q2 if target else 0.0
        if estimate is None:
            return f"q2   -    -> {wanted:+.2f}"
        now = self._read(estimate)
        return f"q2 {now.q2:+.4f} -> {wanted:+.2f}  {now.rate:+.4f} rad/s"
