"""One flight from its release to its end: begun in every room, run by the executive, closed whatever happens.

It knows devices only by their Protocols; `flight.app` opens them and closes them again.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from flight.app.composition.settings import SECOND_NS, attitude_filter
from flight.app.composition.tasks import build_rooms
from flight.bodies.testbed.plant_model import plant_of
from flight.link import events
from flight.link.commands.channel import Channel
from flight.link.events import EventKind
from flight.link.telemetry.recorder import Recorder
from flight.loop.executive.executive import Executive
from flight.loop.executive.jobs import JobRunner
from flight.loop.executive.rate_group import Cycle
from flight.loop.fdir.event_log import EventLog
from flight.loop.fdir.facts import Facts
from flight.loop.fdir.resources import ResourceReader
from flight.loop.fdir.streams import Streams, streams_of
from flight.loop.health import health_watch
from flight.loop.progress import Progress, progress_of
from flight.loop.rate_groups import LoopTasks, rate_groups
from flight.loop.run_label import RunLabel, record_run
from flight.loop.services import Devices, Surroundings
from flight.loop.state.keeper import StateKeeper
from flight.loop.state.learning import learned_of
from flight.schema.sections import Config
from hal.interfaces.wires import Clock


def nothing() -> None:
    """Feed no watchdog, beat for no guardian: in lock-step nobody watches."""


class FlightLoop:
    """One flight: from the release at mission time zero to the end of the configured duration."""

    def __init__(
        self,
        config: Config,
        clock: Clock,
        devices: Devices,
        jobs: JobRunner,
        recorder: Recorder,
        log_error: Callable[[], str],
        *,
        feed: Callable[[], None] = nothing,
        beat: Callable[[], None] = nothing,
        keeper: StateKeeper | None = None,
        board: ResourceReader | None = None,
        channels: Sequence[Channel] = (),
    ) -> None:
        """Take open devices and logs.

        `feed` is called about four times a second while every rate group and worker makes progress: the
        watchdog's food. `beat` is called at the end of each control cycle that ran well: the guardian's
        heartbeat. `keeper` remembers earlier boots; `board` looks at processor, memory, disk and warmth;
        `channels` are where commands come from.
        """
        self._config = config
        self._beat = beat
        self._board = board
        self._keeper = keeper
        self._duration_ns = round(config.duration * SECOND_NS)
        self._progress: Callable[[Progress], None] | None = None
        self._stop_reason = ""
        self._notes: list[tuple[EventKind, str]] = []
        told = EventLog(recorder.event)
        self._around = Surroundings(
            clock, devices, jobs, recorder, told, Facts(told), Streams(streams_of(config))
        )
        filter_, problems = attitude_filter(config, plant_of(config), keeper.learned if keeper else None)
        self._notes += [(events.LEARNED_REFUSED, problem) for problem in problems]
        self._rooms = build_rooms(config, self._around, channels, log_error, self.stop, filter_)
        tasks = LoopTasks(self._run_control, self._watch_health, self._keep_house)
        commanded = bool(channels or config.commands.timeline)
        self._groups = rate_groups(config, self._rooms, tasks, commanded)
        self._health = health_watch(config, self._around, self._rooms, self._groups, feed)
        # Jobs done on the spot, in lock-step, are no part of a cycle's execution time.
        self._executive = Executive(
            clock, self._groups, self._rooms.observer, lambda: time.perf_counter_ns() - jobs.borrowed_ns
        )

    @property
    def restart(self) -> str:
        """Why the process should be started again after this flight; empty when it should not."""
        return self._rooms.modes.restart

    def stop(self, reason: str) -> None:
        """End the flight after the running cycle. Safe from a signal handler."""
        self._stop_reason = reason
        self._executive.stop()

    def note(self, kind: EventKind, text: str) -> None:
        """Have an event of the time before the flight told at its start."""
        self._notes.append((kind, text))

    def watch(self, progress: Callable[[Progress], None]) -> None:
        """Have `progress` called once a second of mission time."""
        self._progress = progress

    def run(self, epoch_ns: int, label: RunLabel) -> str:
        """Fly from `epoch_ns` on; return why it ended. The coils are at zero when this returns or raises."""
        around = self._around
        self._begin(epoch_ns, label)
        try:
            self._executive.run(epoch_ns, epoch_ns + self._duration_ns)
        finally:
            around.devices.coils.off()
            self._health.close()
            now_ns = around.clock.now_ns()
            reason = self._stop_reason or "the configured duration is over"
            around.events.flush(now_ns)
            around.events.tell(events.STOPPED, now_ns, reason)
            self._tell_performance(now_ns)
        return reason

    def _begin(self, epoch_ns: int, label: RunLabel) -> None:
        """Tell every room when mission time zero is, and the log what is flown."""
        config, around, rooms = self._config, self._around, self._rooms
        around.recorder.epoch_ns = epoch_ns
        rooms.navigation.begin(epoch_ns)
        if rooms.imaging is not None:
            rooms.imaging.begin(epoch_ns)
        around.streams.begin(epoch_ns)
        utc_ns = around.clock.utc_ns() - (around.clock.now_ns() - epoch_ns)
        record_run(around.recorder, config, label, epoch_ns, utc_ns, self._groups[0].period_ns)
        rooms.modes.begin(epoch_ns, self._keeper.record.unclean_recent if self._keeper else 0)
        around.events.tell(events.STARTED, epoch_ns, f"{config.name}, {config.duration:g} s")
        for kind, text in self._notes:
            around.events.tell(kind, epoch_ns, text)
        self._health.begin(epoch_ns)
        if self._board is not None:
            self._health.read_resources(
                around.clock, self._board, round(config.health.look_period * SECOND_NS)
            )

    def _run_control(self, cycle: Cycle) -> None:
        self._rooms.control.run(cycle)
        self._beat()

    def _watch_health(self, cycle: Cycle) -> None:
        self._health.run(cycle)

    def _keep_house(self, cycle: Cycle) -> None:
        now_ns = cycle.start_ns
        self._rooms.housekeeping.run(cycle)
        self._keep_state(now_ns)
        self._tell_performance(now_ns)
        if self._progress is not None:
            mission_time = (now_ns - self._around.recorder.epoch_ns) * 1e-9
            duration, told = self._config.duration, self._around.events.count
            self._progress(progress_of(self._rooms, self._groups, mission_time, duration, told))

    def _keep_state(self, now_ns: int) -> None:
        """Note what is to outlive the process, and tell what became of it; touches no disk."""
        if self._keeper is None:
            return
        for kind, text in self._keeper.notices():
            self._around.events.tell(kind, now_ns, text)
        estimate = self._rooms.navigation.attitude(now_ns)
        self._keeper.note(self._rooms.modes.mode.label, learned_of(estimate) if estimate else None)

    def _tell_performance(self, now_ns: int) -> None:
        for group in self._groups:
            self._rooms.observer.group(group, now_ns)
