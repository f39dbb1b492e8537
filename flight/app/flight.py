"""A flight from its request to its result. The coils are at zero when `fly` returns or raises."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

from flight.app.accepted_config import FlownConfig
from flight.app.devices import check_settings
from flight.app.ending_signals import EndingSignals
from flight.app.linux import linux_rig
from flight.app.mission_time import mission_zero, next_whole_second
from flight.app.opening import open_flight
from flight.app.release import Release
from flight.app.request import RunRequest, RunResult
from flight.app.requested_config import requested_config
from flight.app.run_folder import begin_folder
from flight.app.simulated import injected_faults, simulated_rig
from flight.gnc.errors import UsageError
from flight.link import events
from flight.loop.progress import Progress
from flight.loop.run_label import RunLabel
from flight.loop.state.opening import service_folder
from flight.schema import reader as configuration
from flight.schema.sections import Config
from hal.interfaces.rig import Rig


def fly(request: RunRequest, progress: Callable[[Progress], None] | None = None) -> RunResult:
    """Fly a configuration to its end. Raises UsageError for a user mistake, DeviceError for a device."""
    with EndingSignals() as signals, ExitStack() as stack:
        text, config = requested_config(request)
        stack.enter_context(placing(text, str(request.config_path)))
        check_settings(config)
        request = begin_folder(request, text, config)
        rig = _open_rig(request, text, config, stack)
        loop, flight_log = open_flight(config, rig, request.out, stack, patient=_is_patient(request))
        if progress is not None:
            loop.watch(progress)
        if request.config_problem:
            loop.note(events.CONFIG_DAMAGED, request.config_problem)
        elif rig.realtime and (folder := service_folder(os.environ)) is not None:
            stack.callback(FlownConfig(text, folder).serve(rig.clock).stop)
        release = Release(os.environ)
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
    faults = () if config.simulation is None else injected_faults(request, text)
    return RunResult(request.out, reason, signals.received, flight_log.error(), ending, loop.restart, faults)


@contextmanager
def placing(text: str, name: str) -> Iterator[None]:
    """Have a complaint about a value of the configuration say in which line of which file the value is."""
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
