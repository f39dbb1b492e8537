"""Opens a flight on a rig: logs, guardian, devices, workers and channels, in this order.

Also starts the flight's external supervisors, and sets the scheduling priorities of its threads.
"""

from __future__ import annotations

import gc
import os
import threading
from collections.abc import Sequence, Set
from contextlib import ExitStack
from pathlib import Path

from flight.app.composition import Opened, build_loop, workers
from flight.app.devices import open_devices
from flight.app.run_folder import open_log
from flight.link import events
from flight.link.commands.channel import Channel, open_udp, open_unix
from flight.link.telemetry.log import FlightLog, Recorder
from flight.loop.executive import memory
from flight.loop.executive.jobs import JobResult, JobRunner, LockStepRunner
from flight.loop.executive.worker_processes import ProcessRunner
from flight.loop.fdir.resources import Board
from flight.loop.fdir.supervision import Supervision
from flight.loop.flight_loop import FlightLoop, Supervisors, nothing
from flight.loop.state.keeper import open_state
from flight.schema.errors import ConfigError
from flight.schema.sections import Config
from hal.buses import linux_process
from hal.buses.linux_process import ServiceManager, worker_cores
from hal.drivers.h_bridge import DEVICE as COILS
from hal.guardian.client import GuardianLine
from hal.interfaces.wires import SECOND_NS, Clock, Rig
from knightcube.vision.camera import images
from knightcube.vision.startracker.index.build import ensure_default_index

CONTROL_PRIORITY = 50
"""SCHED_FIFO priority of the control thread and of the coil driver's thread."""
NEXT_PRIORITY = CONTROL_PRIORITY - 10
"""Priority of the other threads of the control process."""
_COLLECT_NS = 2 * SECOND_NS


def start_guardian(rig: Rig, stack: ExitStack) -> GuardianLine | None:
    """Start the guardian before any coil can be energised; close the guardian last, with the coils off."""
    if rig.reach is None:
        return None
    guardian = GuardianLine(rig.reach)
    stack.callback(guardian.close)
    return guardian


def supervise(guardian: GuardianLine, clock: Clock, recorder: Recorder, stack: ExitStack) -> Supervision:
    """Connect the supervisors, and give the control loop and the coil driver priority."""
    overseer = ServiceManager(os.environ, os.getpid())
    stack.callback(overseer.close)
    first = [thread for thread in threading.enumerate() if thread.name == COILS]
    obtained = linux_process.obtain([0, *(thread.native_id or 0 for thread in first)], CONTROL_PRIORITY)
    stack.callback(linux_process.relinquish)
    stack.callback(overseer.stopping)
    coils = next(ticker for ticker in clock.tickers if ticker.name == COILS)

    stack.callback(gc.enable)
    collector = clock.ticker("garbage", _COLLECT_NS, memory.Collector())
    stack.callback(collector.stop)

    def settle() -> None:
        memory.settle()
        if obtained.priority:
            prioritise_other_threads()

    status = f"flying; {obtained}"
    supervision = Supervision(guardian, overseer, clock, recorder, status, coils, settle)
    stack.callback(supervision.close)
    supervision.note(events.REAL_TIME_REFUSED if obtained.refusals else events.REAL_TIME, str(obtained))
    return supervision


def prioritise_other_threads() -> None:
    """Give the other threads of this process, for log, serial line and disk, the next lower priority.

    A thread that is preempted while it holds the interpreter's lock blocks the control thread too, for a time
    slice or more on a busy machine.
    """
    for thread in threading.enumerate():
        if thread is not threading.main_thread() and thread.name != COILS:
            linux_process.prioritise(thread.native_id or 0, NEXT_PRIORITY)


def open_flight(
    config: Config,
    rig: Rig,
    folder: Path,
    stack: ExitStack,
    *,
    patient: bool = False,
    earlier: Sequence[Path] = (),
) -> tuple[FlightLoop, FlightLog]:
    """Open logs, devices and workers; return the loop, ready to run, and its log.

    `stack` closes everything in the opposite order, the coils at zero. Raises DeviceError for a device that
    does not answer; a `patient` flight waits in BOOT for devices and for a disk that cannot be written.
    `earlier` are folders of earlier runs, which show an old state.
    """
    flight_log = open_log(folder, "flight", rig, config, stack, patient)
    performance_log = open_log(folder, "performance", rig, config, stack, patient)
    # Closed after the devices, with the coils at zero; opened last, so that a boot counts once it flies.
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
