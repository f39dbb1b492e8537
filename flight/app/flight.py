"""A flight from request to result.

The coils are at zero when the function `fly` returns or raises an exception.

The function `open_flight` opens logs, guardian, devices, workers and channels, in this order.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Sequence, Set
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from shutil import rmtree

from flight.app.accepted_config import Chosen, FlownConfig, accepted_config, requested_config
from flight.app.composition import Opened, build_loop, workers
from flight.app.devices import check_settings, injected_faults, linux_rig, open_devices, simulated_rig
from flight.app.run import RunRequest, RunResult, begin_folder, open_log
from flight.app.service import (
    EndingSignals,
    FlownRelease,
    StartRetry,
    retried_start,
    start_guardian,
    supervise,
)
from flight.link import events
from flight.link.commands import Channel, open_udp, open_unix
from flight.link.telemetry.log import FlightLog, Recorder
from flight.loop.executive import JobResult, JobRunner, LockStepRunner
from flight.loop.flight_loop import FlightLoop, FlightProgress, RunLabel, Supervisors, nothing
from flight.loop.health import Board
from flight.loop.state import open_state, service_folder
from flight.loop.worker_processes import ProcessRunner
from flight.schema import reader as configuration
from flight.schema.document import ConfigError, read_text
from flight.schema.sections import Config
from hal.buses.linux_process import worker_cores
from hal.interfaces.wires import SECOND_NS, Clock, Rig
from knightcube.errors import UsageError
from knightcube.vision.camera import images
from knightcube.vision.startracker.index.build import ensure_default_index


def open_flight(
    config: Config,
    rig: Rig,
    folder: Path,
    stack: ExitStack,
    *,
    patient: bool = False,
    earlier: Sequence[Path] = (),
) -> tuple[FlightLoop, FlightLog]:
    """Open logs, devices and workers, and return the loop, which is ready to run, and the flight log.

    The stack closes everything in the opposite order, with the coils at zero. Raises DeviceError for a device
    that does not answer, unless the flight is `patient`: then it waits in BOOT for its devices, and for a
    disk that cannot be written. The folders `earlier` of earlier runs serve to detect that the stored state
    is outdated.
    """
    flight_log = open_log(folder, "flight", rig, config, stack, patient)
    performance_log = open_log(folder, "performance", rig, config, stack, patient)
    # The stored state is closed after the devices, and opened last, so that only a boot that flies counts.
    after_coils = stack.enter_context(ExitStack())
    guardian = start_guardian(rig, stack)
    devices = open_devices(config, rig, stack, patient)
    tracker = config.camera.star_tracker if config.camera is not None else None
    if tracker is not None and tracker.index is None:
        ensure_default_index()
    elif tracker is not None and not patient and not Path(tracker.index or "").is_file():
        raise ConfigError("camera.star_tracker.index", f"is {tracker.index!r}: there is no such file")
    jobs = _open_jobs(config, rig, stack, worker_cores() if patient else frozenset())
    recorder = Recorder(flight_log, performance_log)
    feed, beat = nothing, nothing
    if guardian is not None:
        guardian.wait_ready(patient=patient)
        supervision = supervise(guardian, rig.clock, recorder, stack)
        feed, beat = supervision.feed, supervision.beat
    channels = _open_channels(config, stack)
    keeper = open_state(config, os.environ, rig.clock, after_coils, [*earlier, folder])
    frames = folder / images.KEPT_FRAMES_FOLDER
    opened = Opened(rig.clock, devices, jobs, recorder, flight_log.error, channels, feed, frames)
    board = Board(folder) if rig.realtime else None
    loop = build_loop(config, opened, Supervisors(beat, keeper, board))
    return loop, flight_log


def _open_jobs(config: Config, rig: Rig, stack: ExitStack, cores: Set[int]) -> JobRunner:
    specs = workers(config, *rig.latency)
    made = specs if rig.host is None else rig.host.workers(specs)
    runner: JobRunner = (
        ProcessRunner(rig.clock, made, cores) if rig.realtime else LockStepRunner(rig.clock, made)
    )
    stack.callback(runner.close)
    return runner if rig.host is None else rig.host.jobs(runner, specs, JobResult)


def _open_channels(config: Config, stack: ExitStack) -> list[Channel]:
    """Open the configured command channels."""
    channels: list[Channel] = []
    if config.commands.socket is not None:
        channels.append(open_unix(Path(config.commands.socket)))
    if config.commands.udp is not None:
        channels.append(open_udp(config.commands.udp))
    for channel in channels:
        stack.callback(channel.close)
    return channels


_GRID_NS = 25_000_000


def next_whole_second(clock: Clock) -> int:
    """Return mission time zero in lock-step: the next whole second at least half a second ahead."""
    return -(-(clock.now_ns() + SECOND_NS // 2) // SECOND_NS) * SECOND_NS


def mission_zero(clock: Clock) -> int:
    """Return mission time zero in real time: the start of the third next slot of the 40 Hz grid."""
    return (clock.now_ns() // _GRID_NS + 3) * _GRID_NS


@dataclass(frozen=True, slots=True)
class _Judged:
    """A request whose configuration was read from the file in `chosen`, and validated."""

    request: RunRequest
    chosen: Chosen
    text: str
    config: Config


@dataclass(frozen=True, slots=True)
class _Opened:
    """A flight that is ready to begin."""

    request: RunRequest
    text: str
    config: Config
    rig: Rig
    loop: FlightLoop
    log: FlightLog


def fly(request: RunRequest, progress: Callable[[FlightProgress], None] | None = None) -> RunResult:
    """Fly a configuration to its end.

    Raises UsageError for a mistake of the user, and DeviceError for a device that fails.

    On a board, the start is retried until it succeeds. Raises StoppedError if a signal ends the attempts to
    start.
    """
    with EndingSignals() as signals, ExitStack() as stack:
        opened = _start(request, signals, stack)
        loop, rig, config, text = opened.loop, opened.rig, opened.config, opened.text
        if progress is not None:
            loop.watch(progress)
        release = FlownRelease(os.environ)
        if release.note:
            loop.note(events.RELEASE_LEFT, release.note)
        if rig.realtime:
            release.serve(rig.clock, stack)
        label = RunLabel(text, rig.seed, config.simulation is not None, rig.realtime)
        epoch_ns = mission_zero(rig.clock) if rig.realtime else next_whole_second(rig.clock)
        rig.release(epoch_ns)
        signals.end(loop)
        reason = loop.run(epoch_ns, label)
        if not loop.restart:
            release.end()
        ending = loop.ending()
    faults = () if config.simulation is None else injected_faults(opened.request, text)
    folder, error = opened.request.out, opened.log.error()
    return RunResult(folder, reason, signals.received, error, ending, loop.restart, faults)


def _start(request: RunRequest, signals: EndingSignals, stack: ExitStack) -> _Opened:
    """Return a flight that is ready to begin. `stack` closes it.

    A board, which has an archive, retries the start until it succeeds.
    """
    judge = partial(_judge, request)
    if request.archive is None:
        return _open(judge(), stack)
    retry = StartRetry(lambda: signals.received)
    stack.callback(retry.close)
    opened = retried_start(judge, _open, stack, retry)
    if summary := retry.summary():
        opened.loop.note(events.START_WAITED, summary)
    return opened


def _judge(request: RunRequest) -> _Judged:
    """Read the configuration once, and validate it.

    Raises UnreadConfigError, and UsageError for an invalid configuration.
    """
    path = request.config_path
    chosen = accepted_config(path, os.environ) if request.accepted else Chosen(path, read_text(path))
    request = replace(request, config_path=chosen.path)
    text, config = requested_config(request, chosen.text)
    with placing(text, str(chosen.path)):
        check_settings(config)
    return _Judged(request, chosen, text, config)


def _open(judged: _Judged, stack: ExitStack) -> _Opened:
    """Open a flight. The run folder is removed from the archive if the opening fails."""
    chosen, text, config = judged.chosen, judged.text, judged.config
    stack.enter_context(placing(text, str(chosen.path)))
    request, earlier = begin_folder(judged.request, text, config)
    unflown = stack.enter_context(ExitStack())
    if request.archive is not None:
        unflown.callback(rmtree, request.out, ignore_errors=True)
    rig = _open_rig(request, text, config, stack)
    patient = request.archive is not None
    loop, log = open_flight(config, rig, request.out, stack, patient=patient, earlier=earlier)
    if chosen.problem:
        sys.stderr.write(f"flight: {chosen.problem}\n")
        loop.note(events.CONFIG_DAMAGED, chosen.problem)
    elif chosen.accepted and rig.realtime and (folder := service_folder(os.environ)) is not None:
        stack.callback(FlownConfig(text, folder).serve(rig.clock).stop)
    unflown.pop_all()
    return _Opened(request, text, config, rig, loop, log)


@contextmanager
def placing(text: str, name: str) -> Iterator[None]:
    """Add file and line to configuration errors."""
    try:
        yield
    except UsageError as error:
        raise configuration.placed(error, text, name) from error


def _open_rig(request: RunRequest, text: str, config: Config, stack: ExitStack) -> Rig:
    """Return the real or simulated hardware of a configuration."""
    if config.simulation is not None:
        return simulated_rig(request, text, config, stack)
    if request.seed is not None:
        raise UsageError("--seed: this configuration flies real devices, whose noise has no seed")
    if request.devices is not None:
        raise UsageError("--devices: this configuration flies real devices, not simulated ones")
    return linux_rig(config, stack, request.archive is not None)
