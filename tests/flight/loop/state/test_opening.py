"""A flight remembers how it ended: cleanly, or with an exception passing through."""

from __future__ import annotations

import shutil
from contextlib import ExitStack
from pathlib import Path

import pytest

from flight.app.flight import fly
from flight.app.request import RunRequest
from flight.link.telemetry.packets import to_text
from flight.loop.state.content import StoredState
from flight.loop.state.opening import open_state, state_folder
from flight.loop.state.store import COPIES, StateStore
from flight.schema import reader as configuration
from flight.schema.sections import Config
from ground.telemetry.reader import read_run
from hal.interfaces.errors import NotResponding
from tests.hal.guardian.live_flight import write_config
from tests.manual_clock import ManualClock

CONFIG = Path(__file__).resolve().parents[4] / "config" / "step_demo.yaml"


def stored(folder: Path) -> StoredState:
    """Return the state on disk."""
    return StateStore(folder, lambda *_: None).load()


def simulated(folder: Path | None) -> Config:
    """Return a configuration of simulated devices, with a folder for the state or without."""
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


def test_a_device_that_does_not_answer_is_no_crash(tmp_path: Path) -> None:
    def end() -> None:
        with ExitStack() as stack:
            open_state(simulated(tmp_path), {}, ManualClock(), stack)
            raise NotResponding("vn100", "not one byte")

    with pytest.raises(NotResponding):
        end()
    assert not stored(tmp_path).running


def test_an_exception_that_passes_is_no_clean_end(tmp_path: Path) -> None:
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


def test_a_folder_that_cannot_be_made_is_no_reason_not_to_fly(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with ExitStack() as stack:
        keeper = open_state(simulated(tmp_path / "file" / "state"), {}, ManualClock(), stack)
        assert keeper is not None
        events = [kind.name for kind, _ in keeper.notices()]
        assert events == ["state-lost", "unclean-shutdown", "state-unwritten"]


def begun(folder: Path, runs: list[Path]) -> tuple[StoredState, list[str]]:
    """Return the state after a boot that ended cleanly, and the names of its events."""
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
    """Two short flights; the process of the second finds that the one before was killed."""
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
        killed.pop_all()  # like kill -9: nothing is closed
    second = fly(request)
    assert second.folder.name == "run-000002"
    names = [to_text(name) for name in read_run(second.folder)["event"]["name"]]
    assert "unclean-shutdown" in names
    assert stored(tmp_path / "state").boot_count == 3
    assert not (tmp_path / "unused").exists()
