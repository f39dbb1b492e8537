"""Tests that a flight process stores whether it ended cleanly or by an exception."""

from __future__ import annotations

import errno
import shutil
import threading
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from flight.app.flight import fly
from flight.app.run import RunRequest
from flight.link import events
from flight.link.telemetry.packets import to_text
from flight.loop.state import (
    COPIES,
    KeptTable,
    Learned,
    Notices,
    StateKeeper,
    StateStore,
    StoredState,
    open_state,
    state_folder,
)
from flight.schema import reader as configuration
from flight.schema.sections import Config
from ground.telemetry import read_run
from hal.buses.system import SystemClock
from hal.interfaces.errors import DeviceError, NotResponding
from hal.interfaces.wires import Clock
from knightcube.errors import KnightCubeError
from tests.flight.loop.disk import NO_SPACE, Disk
from tests.hal.guardian.live_flight import write_config
from tests.manual_clock import ManualClock

SECOND = 1_000_000_000
FOLDER = Path("/state")


def keeper_on(disk: Disk | None, clock: Clock, folder: Path = FOLDER) -> StateKeeper:
    """Return a new state keeper, as a flight creates it at its start."""
    notices = Notices()
    return StateKeeper(StateStore(folder, notices.report, disk), notices, clock, period_ns=10 * SECOND)


def test_a_table_survives_a_clean_end_and_a_new_table_does_not_survive_a_crash() -> None:
    disk, clock = Disk(), ManualClock()
    old, new = {"modes.known_for": 3.0}, {"modes.known_for": 2.0}
    keeper = keeper_on(disk, clock)
    keeper.note_table(KeptTable(values=old, loads=1))
    keeper.close(clean=True)
    keeper = keeper_on(disk, clock)
    assert keeper.table.values == old
    keeper.note_table(KeptTable(values=new, before=old, proven=False, loads=2))
    clock.advance(20 * SECOND)
    keeper = keeper_on(disk, clock)
    assert keeper.table.values == old
    assert events.PARAMETERS_LEFT in [kind for kind, _ in keeper.notices()]


def on_disk(disk: Disk) -> StoredState:
    """Return the state that another process would read from the disk."""
    return StateStore(FOLDER, lambda *_: None, disk).load()


def test_running_is_on_disk_before_anything_flies_and_gone_after_a_clean_end() -> None:
    disk = Disk()
    keeper = keeper_on(disk, ManualClock())
    assert on_disk(disk).running
    assert on_disk(disk).boot_count == 1
    keeper.close(clean=True)
    keeper.close(clean=False)
    assert not on_disk(disk).running


@pytest.mark.parametrize("closed", [True, False])
def test_an_end_that_was_not_clean_is_reported_at_the_next_start(closed: bool) -> None:
    """A start reports that the last process was killed, or that an exception ended it."""
    disk, clock = Disk(), ManualClock()
    first = keeper_on(disk, clock)
    first.note("hold")
    clock.advance(20 * SECOND)
    if closed:
        first.close(clean=False)
    second = keeper_on(disk, clock)
    assert (second.record.unclean_recent, second.record.after_unclean) == (1, True)
    assert second.record.mode == "hold"
    ((kind, text),) = second.notices()
    assert kind is events.UNCLEAN_SHUTDOWN
    assert text == "boot 1, last state of 1970-01-01T00:00:21Z; recent unclean shutdowns: 1"
    assert not second.notices(), "reported once"


def test_noted_values_are_on_disk_after_a_period_with_the_operating_time() -> None:
    disk, clock = Disk(), ManualClock()
    keeper = keeper_on(disk, clock)
    learned = Learned.of(np.array([1e-4, 0.0, 0.0]), np.eye(3) * 1e-10)
    calls = disk.calls
    keeper.note("detumble", {"gyro-bias": learned})
    keeper.note("hold")
    assert disk.calls == calls, "noting touches no disk"
    clock.advance(10 * SECOND)
    state = on_disk(disk)
    assert (state.mode, state.operated, state.learned) == ("hold", 10.0, {"gyro-bias": learned})
    clock.advance(10 * SECOND)
    assert on_disk(disk).operated == 20.0
    assert keeper_on(disk, clock).learned == {"gyro-bias": learned}


def test_learned_values_that_are_unfit_are_left_out_and_reported() -> None:
    disk, clock = Disk(), ManualClock()
    keeper = keeper_on(disk, clock)
    keeper.note("hold" * 20, {"gyro-bias": Learned((float("nan"),), ((1.0,),))})
    clock.advance(10 * SECOND)
    ((kind, text),) = keeper.notices()
    assert kind is events.STATE_UNWRITTEN
    assert text == "gyro-bias: a value or its covariance is not finite"
    assert on_disk(disk).operated == 10.0
    clock.advance(10 * SECOND)
    assert not keeper.notices()


def test_a_full_disk_is_reported_and_the_flight_goes_on() -> None:
    disk, clock = Disk(), ManualClock()
    keeper_on(disk, clock).close(clean=True)
    disk.start(0, NO_SPACE)
    keeper = keeper_on(disk, clock)
    assert [kind for kind, _ in keeper.notices()] == [events.STATE_UNWRITTEN]
    disk.start(None)
    clock.advance(10 * SECOND)
    assert on_disk(disk).boot_count == 2


def test_damaged_files_are_reported_through_the_notices(tmp_path: Path) -> None:
    for name in COPIES:
        (tmp_path / name).write_bytes(b"no state")
    keeper = keeper_on(None, ManualClock(), tmp_path)
    assert [kind for kind, _ in keeper.notices()] == [events.STATE_LOST, events.UNCLEAN_SHUTDOWN]
    assert keeper.record.unclean_recent == 1


def test_the_number_of_notices_that_are_not_read_is_limited() -> None:
    notices = Notices()
    for number in range(1000):
        notices.report(events.STATE_UNWRITTEN, str(number))
    taken = notices.drain()
    assert len(taken) <= 64
    assert taken[-1][1] == "999"


class HungDisk(Disk):
    """A disk whose method `sync` blocks until the test releases it."""

    def __init__(self) -> None:
        super().__init__()
        self.hangs = threading.Event()
        self.hung = threading.Event()
        self.let_go = threading.Event()

    def sync(self, file: int) -> None:
        """Wait until the test releases the disk."""
        if self.hangs.is_set():
            self.hung.set()
            self.let_go.wait(20.0)
            raise OSError(errno.EIO, "the disk is gone")
        super().sync(file)


def test_a_hung_disk_delays_neither_note_nor_close(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flight.loop.state._HUNG_DISK_S", 0.1)
    disk, notices = HungDisk(), Notices()
    store = StateStore(FOLDER, notices.report, disk)
    keeper = StateKeeper(store, notices, SystemClock(), period_ns=1_000_000)
    disk.hangs.set()
    assert disk.hung.wait(5.0)
    start = time.monotonic()
    for _ in range(1000):
        keeper.note("hold")
        keeper.notices()
    assert time.monotonic() - start < 0.5
    keeper.close(clean=True)
    assert time.monotonic() - start < 5.0
    assert on_disk(disk).running, "a clean end counts only once it is on the disk"
    disk.let_go.set()


CONFIG = Path(__file__).resolve().parents[3] / "config" / "step_demo.yaml"


def stored(folder: Path) -> StoredState:
    """Return the state on disk."""
    return StateStore(folder, lambda *_: None).load()


def simulated(folder: Path | None) -> Config:
    """Return a configuration of simulated devices, with or without a folder for the state."""
    config = configuration.load(CONFIG)
    if folder is None:
        return config
    return configuration.replace(config, state=configuration.replace(config.state, folder=str(folder)))


def on_devices() -> Config:
    """Return a configuration of real devices."""
    return configuration.replace(simulated(None), simulation=None)


def test_the_configured_folder_comes_first_then_systemds_and_in_simulation_none(tmp_path: Path) -> None:
    service = {"STATE_DIRECTORY": "/var/lib/knightcube:/var/lib/other"}
    assert state_folder(simulated(tmp_path), service) == tmp_path
    assert state_folder(simulated(None), service) is None
    assert state_folder(on_devices(), service) == Path("/var/lib/knightcube")
    assert state_folder(on_devices(), {}) is None


def test_without_a_folder_nothing_is_kept() -> None:
    with ExitStack() as stack:
        assert open_state(simulated(None), {}, ManualClock(), stack) is None


def test_a_device_that_does_not_answer_is_not_counted_as_a_crash(tmp_path: Path) -> None:
    def end() -> None:
        with ExitStack() as stack:
            open_state(simulated(tmp_path), {}, ManualClock(), stack)
            raise NotResponding("vn100", "not one byte")

    with pytest.raises(NotResponding):
        end()
    assert not stored(tmp_path).running


def test_an_exception_that_ends_the_flight_is_not_a_clean_end(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "state"

    def crash() -> None:
        with ExitStack() as stack:
            open_state(simulated(folder), {}, ManualClock(), stack)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        crash()
    assert stored(folder).running
    with ExitStack() as stack:
        keeper = open_state(simulated(folder), {}, ManualClock(), stack)
        assert keeper is not None
        assert keeper.record.unclean_recent == 1
    assert not stored(folder).running


@pytest.mark.parametrize("is_flying", [False, True])
@pytest.mark.parametrize("error", [OSError, KnightCubeError, DeviceError])
def test_an_error_after_which_a_start_is_retried_is_an_unclean_end_of_a_flight(
    tmp_path: Path, error: type[Exception], is_flying: bool
) -> None:
    arguments = ("camera", "silent") if error is DeviceError else ("no image",)

    def crash() -> None:
        with ExitStack() as stack:
            keeper = open_state(simulated(tmp_path), {}, ManualClock(), stack)
            assert keeper is not None
            if is_flying:
                keeper.note("point")
            raise error(*arguments)

    with pytest.raises(error):
        crash()
    assert stored(tmp_path).running is (is_flying and error is not DeviceError)


def test_a_flight_starts_although_its_folder_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with ExitStack() as stack:
        keeper = open_state(simulated(tmp_path / "file" / "state"), {}, ManualClock(), stack)
        assert keeper is not None
        events = [kind.name for kind, _ in keeper.notices()]
        assert events == ["state-lost", "unclean-shutdown", "state-unwritten"]


def begun(folder: Path, runs: list[Path]) -> tuple[StoredState, list[str]]:
    """Return the state after a boot that ended cleanly, and the names of the events of this boot."""
    with ExitStack() as stack:
        keeper = open_state(simulated(folder), {}, ManualClock(), stack, runs)
        assert keeper is not None
        names = [kind.name for kind, _ in keeper.notices()]
    return stored(folder), names


@pytest.mark.parametrize("vanished", ["copies", "folder", "newest"])
def test_a_state_that_vanished_or_is_older_than_a_run_counts_as_an_unclean_stop(
    tmp_path: Path, vanished: str
) -> None:
    folder, runs = tmp_path / "state", [tmp_path / f"run-{number}" for number in range(4)]
    for number, run in enumerate(runs[:3]):
        run.mkdir()
        assert begun(folder, runs[: number + 1])[1] == []
        if number == 0:
            shutil.copytree(folder, tmp_path / "old")
    if vanished == "copies":
        for copy in COPIES:
            (folder / copy).unlink()
    else:
        shutil.rmtree(folder)
    if vanished == "newest":
        shutil.copytree(tmp_path / "old", folder)
    state, names = begun(folder, runs)
    assert names == ["state-old", "unclean-shutdown"]
    assert (state.boot_count, [shutdown.boot for shutdown in state.unclean]) == (4, [3])
    assert begun(folder, runs)[1] == []


def test_a_service_flies_run_after_run_into_its_archive_and_shows_a_crash_before(tmp_path: Path) -> None:
    """Two short runs of a service end cleanly. After a kill, the next process reports an unclean shutdown."""
    path = write_config(tmp_path)
    with path.open("a", encoding="utf-8") as file:
        file.write(f"\nstate: {{folder: {tmp_path / 'state'}}}\n")
    request = RunRequest(path, tmp_path / "unused", duration=2.0, archive=tmp_path / "runs")
    assert fly(request).folder == tmp_path / "runs" / "run-000001"
    state = stored(tmp_path / "state")
    assert (state.boot_count, state.running) == (1, False)
    assert set(state.learned) == {"gyro-bias", "plant", "imu-latency", "magnetometer-bias"}
    assert state.operated == pytest.approx(3.0, abs=1.1), "a second of preparation and two of flight"
    with ExitStack() as killed:
        open_state(configuration.load(path), {}, ManualClock(), killed)
        killed.pop_all()  # as after `kill -9`, nothing is closed
    second = fly(request)
    assert second.folder.name == "run-000002"
    names = [to_text(name) for name in read_run(second.folder)["event"]["name"]]
    assert "unclean-shutdown" in names
    assert stored(tmp_path / "state").boot_count == 3
    assert not (tmp_path / "unused").exists()
