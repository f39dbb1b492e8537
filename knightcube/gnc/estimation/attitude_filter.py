"""A MEKF of attitude, rate, gyro bias and disturbance that accepts late measurements.

Each measurement is applied at its own time. A late one is inserted where it belongs and those after it are
applied again, at once or a few at a time beside the running estimate (`knightcube.gnc.estimation.replay`). A
rate from a streaked image is the mean over its exposure: the attitude at the exposure's start is kept until
its end. The age of the inertial unit's samples at their stamp may be estimated too
(`knightcube.gnc.estimation.latency`). On the testbed's thread the same filter runs suspended: it uses the
part of each measurement about the thread, and all other states stay exactly constant. The thread's torsion
and damping are known, or estimated beside the disturbance, from which they differ by their dependence on
angle and rate.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.gnc.estimation.checkpoints import CheckpointHistory
from knightcube.gnc.estimation.command_doubt import CommandDoubt
from knightcube.gnc.estimation.commands import CommandHistory
from knightcube.gnc.estimation.estimate import Estimate
from knightcube.gnc.estimation.filter_settings import FilterSettings, process_noise, slow_prior
from knightcube.gnc.estimation.initialisation import first_checkpoint
from knightcube.gnc.estimation.latency import LONGEST_LATENCY
from knightcube.gnc.estimation.measurements import (
    AttitudeMeasurement,
    MeanRateMeasurement,
    Measurement,
    RateMeasurement,
)
from knightcube.gnc.estimation.replay import Checkpoint, Model, Replay
from knightcube.gnc.estimation.rigid_body import RigidBody
from knightcube.gnc.estimation.slow_prior import SlowPrior

OnApplied = Callable[[list[bool]], None]
"""Called with which of the late measurements passed the gate."""


@dataclass(slots=True, eq=False)
class _Branch:
    """A replay from the checkpoint `base` on with late measurements; `applied` is called at its end."""

    base: Checkpoint
    replay: Replay
    late: Sequence[Measurement]
    applied: OnApplied


class AttitudeFilter:
    """Owns the estimate, its recent checkpoints and the recent commands.

    Attributes:
        refused: how many measurements did not pass their gate.
        late: how many were too late to be inserted.
        restarts: how often the filter discarded its estimate.
        nis: normalised innovation squared of the last measurement, NaN without one.
    """

    REJECTIONS_TO_RESTART = 40
    """After this many rejections of attitudes, or of rates, in a row the filter itself is wrong."""
    REJECTIONS_AT_THE_START = 3
    """Enough while no more measurements were accepted than rejected: the filter then started wrong."""

    def __init__(self, body: RigidBody, settings: FilterSettings, prior: SlowPrior | None = None) -> None:
        """Filter for `body`; `prior` of its slow states follows from the settings by default."""
        self._settings = settings
        self._prior = prior or slow_prior(body, settings)
        self._commands = CommandHistory(body, settings.history_ns)
        noise = process_noise(body, settings)
        self._model = Model(body, noise, self._commands, settings.longest_step, settings.gates())
        self._doubt = CommandDoubt(self._model)
        self._history = CheckpointHistory(settings.history_ns)
        self._branch: _Branch | None = None
        self._refused_in_a_row: dict[type[Measurement], int] = {}
        self._accepted: dict[type[Measurement], int] = {}
        self.refused = 0
        self.late = 0
        self.restarts = 0
        self.nis = math.nan

    def command(
        self, time_ns: int, currents: FloatArray, field: FloatArray | None = None, known: bool = True
    ) -> None:
        """Record the coil currents (3,) A in force from `time_ns` on, and the field (3,) T, reference axes.

        Commands come in order of time, each before the measurements under it. Without `field` the body's own
        is used. Currents that are not `known` are only a guess.
        """
        doubt = self._doubt
        self._commands.record(max(time_ns, doubt.ended_ns), currents, field, known and not doubt.active)

    def mark_unknown(self, since_ns: int) -> None:
        """Treat the currents recorded since then as unknown: they may not have flown.

        The measurements since are applied again, a part at each `catch_up`: an apparent disturbance, or a
        plant of other parameters, may have been a current.
        """
        self.catch_up()
        self._commands.mark_unknown(since_ns)
        self._refused_in_a_row = {}
        index = max(self._history.index_before(since_ns), 1)
        again = self._history.measurements_from(index)
        if again:
            base = self._history[index - 1]
            self._branch = _Branch(base, Replay(self._model, base, again), (), lambda _: None)

    def start(self, attitude: AttitudeMeasurement, rate: RateMeasurement) -> None:
        """Start from one attitude and one rate; of a suspended body, from their parts about the thread."""
        first = first_checkpoint(self._model, self._settings, self._prior, attitude, rate)
        self._history.restart(first)
        self._discard_branch()
        self._refused_in_a_row = {}
        self._accepted = {}

    @property
    def started(self) -> bool:
        """Whether there is an estimate."""
        return bool(self._history)

    @property
    def measured_ns(self) -> int:
        """The time of the newest accepted measurement."""
        return self._history.newest_used.time_ns

    def measure(self, measurement: Measurement) -> bool:
        """Apply a measurement at its own time; return whether it passed the gate and was not too late."""
        self.nis = math.nan
        if self._branch is not None:
            if self._is_newest(measurement) and not isinstance(measurement, MeanRateMeasurement):
                self._branch.replay.add(measurement)
            else:
                self.catch_up()
        if self._is_newest(measurement):
            used = self._apply([measurement], measurement)
        elif (index := self._history.index_before(measurement.begin_ns)) > 0:
            used = self._insert(index, measurement)
        else:
            self.late += 1
            return False
        self._count(type(measurement), used)
        if self._history and self._history.newest.measurement is measurement:
            since_ns = self._doubt.judge(self._history.newest)
            if since_ns is not None:
                self.mark_unknown(since_ns)
        if self._branch is None:  # a branch needs its base
            self._history.forget(measurement.time_ns)
        return used

    def measure_late(self, late: Sequence[Measurement], applied: OnApplied) -> None:
        """Insert late measurements where they belong, a part of the work at each `catch_up`.

        `applied` is called at the end, with which of them passed the gate; until then the estimate goes on
        without them.
        """
        self.catch_up()
        index = self._history.index_before(min(m.begin_ns for m in late)) if self._history else 0
        if index == 0:
            self.late += len(late)
            applied([False] * len(late))
            return
        base = self._history[index - 1]
        again = [*self._history.measurements_from(index), *late]
        again.sort(key=lambda m: m.time_ns)
        self._branch = _Branch(base, Replay(self._model, base, again), late, applied)

    def catch_up(self, most: int | None = None) -> None:
        """Continue a replay by `most` measurements, or to its end; at its end it becomes the estimate."""
        branch = self._branch
        if branch is None:
            return
        replay = branch.replay
        replay.advance(most)
        if not replay.done:
            return
        self._branch = None
        self._history.replace_after(branch.base, replay.checkpoints)
        used = [next(c.used for c in replay.checkpoints if c.measurement is m) for m in branch.late]
        for measurement, passed in zip(branch.late, used, strict=True):
            self._count(type(measurement), passed)
        branch.applied(used)

    @property
    def doubts_commands(self) -> bool:
        """Whether the body does not move as commanded, so that the coil currents are unknown."""
        return self._doubt.active

    @property
    def latency(self) -> float:
        """The estimated age of the inertial unit's samples at their stamp, s, limited to plausible values."""
        found = self._history.newest.state.latency if self._history else self._prior.latency
        return min(max(found, 0.0), LONGEST_LATENCY)

    def at(self, time_ns: int) -> Estimate:
        """Return the estimate propagated to `time_ns`; the filter itself does not change."""
        return self._model.estimate(self._history.newest, time_ns, self.measured_ns)

    def past(self, time_ns: int) -> Estimate | None:
        """Return the estimate at a past time, None before the first checkpoint kept."""
        then = self._history.at(time_ns)
        return None if then is None else self._model.estimate(then, time_ns, then.time_ns)

    def rates(self, begin_ns: int, end_ns: int) -> tuple[IntArray, FloatArray] | None:
        """Return times (n,) ns and rates (n, 3) rad/s that span an interval; None beyond the history."""
        return self._history.rates(begin_ns, end_ns)

    def _is_newest(self, measurement: Measurement) -> bool:
        return bool(self._history) and measurement.begin_ns >= self._history.newest.time_ns

    def _insert(self, index: int, measurement: Measurement) -> bool:
        """Return to the first `index` checkpoints; apply the later measurements again with `measurement`."""
        later = self._history.measurements_from(index)
        place = bisect.bisect_right(later, measurement.time_ns, key=lambda other: other.time_ns)
        later.insert(place, measurement)
        self._history.truncate(index)
        return self._apply(later, measurement)

    def _apply(self, measurements: list[Measurement], asked: Measurement) -> bool:
        """Apply measurements in order of time after the newest checkpoint; return if `asked` was used."""
        replay = Replay(self._model, self._history.newest, measurements)
        replay.advance()
        self._history.extend(replay.checkpoints)
        mine = next(c for c in replay.checkpoints if c.measurement is asked)
        self.nis = mine.nis
        return mine.used

    def _count(self, kind: type[Measurement], used: bool) -> None:
        """Count rejections and restart after too many. Mean rates are too rare to restart the filter."""
        in_a_row = 0 if used else self._refused_in_a_row.get(kind, 0) + 1
        self._refused_in_a_row[kind] = in_a_row
        self.refused += not used
        accepted = self._accepted.get(kind, 0) + used
        self._accepted[kind] = accepted
        enough = min(max(accepted, self.REJECTIONS_AT_THE_START), self.REJECTIONS_TO_RESTART)
        if kind is not MeanRateMeasurement and in_a_row >= enough:
            self._history.restart(None)
            self._refused_in_a_row = {}
            self.restarts += 1
            self._discard_branch()

    def _discard_branch(self) -> None:
        branch, self._branch = self._branch, None
        if branch is not None:
            branch.applied([False] * len(branch.late))
