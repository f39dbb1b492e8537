"""A flight from its request to its result. The coils are at zero when `fly` returns or raises."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from shutil import rmtree

from flight.app.accepted_config import Chosen, FlownConfig, accepted_config, requested_config
from flight.app.devices import check_settings, linux_rig
from flight.app.opening import open_flight
from flight.app.request import RunRequest, RunResult
from flight.app.run_folder import begin_folder
from flight.app.service import EndingSignals, FlownRelease, StartRetry, retried_start
from flight.app.simulated import injected_faults, simulated_rig
from flight.link import events
from flight.link.telemetry.log import FlightLog
from flight.loop.flight_loop import FlightLoop
from flight.loop.flight_status import FlightProgress, RunLabel
from flight.loop.state.keeper import service_folder
from flight.schema import reader as configuration
from flight.schema.document import read_text
from flight.schema.sections import Config
from hal.interfaces.wires import SECOND_NS, Clock, Rig
from knightcube.errors import UsageError

_GRID_NS = 25_000_000


def next_whole_second(clock: Clock) -> int:
    """Return mission time zero in lock-step: the next whole second at least half a second ahead."""
    return -(-(clock.now_ns() + SECOND_NS // 2) // SECOND_NS) * SECOND_NS


def mission_zero(clock: Clock) -> int:
    """Return mission time zero in real time: the third next slot of the 40 Hz grid."""
    return (clock.now_ns() // _GRID_NS + 3) * _GRID_NS


@dataclass(frozen=True, slots=True)
class _Judged:
    """A request whose configuration was read from the file of `chosen`, and validated."""

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
    """Fly a configuration to its end. Raises UsageError for a user mistake, DeviceError for a device.

    On a board the start is retried until it succeeds. Raises StoppedError if a signal ends the attempts.
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
    """Return a flight that is ready; `stack` closes it. A board tries again until it is."""
    judge = partial(_judge, request)
    if not _is_patient(request):
        return _open(judge(), stack)
    retry = StartRetry(lambda: signals.received)
    stack.callback(retry.close)
    opened = retried_start(judge, _open, stack, retry)
    if summary := retry.summary():
        opened.loop.note(events.START_WAITED, summary)
    return opened


def _judge(request: RunRequest) -> _Judged:
    """Read the configuration once, and judge it. Raises UnreadConfigError, UsageError for a wrong one."""
    path = request.config_path
    chosen = accepted_config(path, os.environ) if request.accepted else Chosen(path, read_text(path))
    request = replace(request, config_path=chosen.path)
    text, config = requested_config(request, chosen.text)
    with placing(text, str(chosen.path)):
        check_settings(config)
    return _Judged(request, chosen, text, config)


def _open(judged: _Judged, stack: ExitStack) -> _Opened:
    """Open a flight. The run folder in an archive is removed if the opening fails."""
    chosen, text, config = judged.chosen, judged.text, judged.config
    stack.enter_context(placing(text, str(chosen.path)))
    request, earlier = begin_folder(judged.request, text, config)
    unflown = stack.enter_context(ExitStack())
    if request.archive is not None:
        unflown.callback(rmtree, request.out, ignore_errors=True)
    rig = _open_rig(request, text, config, stack)
    patient = _is_patient(request)
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
    """Return the configured hardware."""
    if config.simulation is not None:
        return simulated_rig(request, text, config, stack)
    if request.seed is not None:
        raise UsageError("--seed: this configuration flies real devices, which draw their own noise")
    if request.devices is not None:
        raise UsageError("--devices: this configuration flies real devices, not simulated ones")
    return linux_rig(config, stack, _is_patient(request))


def _is_patient(request: RunRequest) -> bool:
    """Return whether the flight waits for missing devices: on a board, where nobody can reconnect them."""
    return request.archive is not None
