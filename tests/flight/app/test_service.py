"""Tests that a wrong configuration ends the start on a board, and that other faults only delay the start."""

from __future__ import annotations

import threading
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from flight.app import flight
from flight.app import service as patient_start
from flight.app.cli import main
from flight.app.cli.run import REFUSED
from flight.app.run import RunRequest
from flight.app.service import StartRetry, StoppedError, pauses, retried_start
from flight.link.telemetry.packets import to_text
from flight.loop.state import StateStore
from flight.schema.document import ConfigError, UnreadConfigError
from ground.telemetry import read_run
from hal.interfaces.errors import NotResponding
from knightcube.errors import UsageError
from tests.hal.guardian.live_flight import write_config
from tests.manual_clock import ManualClock


def test_the_pause_doubles_with_each_attempt_up_to_half_a_minute() -> None:
    first = pauses()
    found = [next(first) for _ in range(12)]
    assert found[:8] == [0.2 * 2**number for number in range(8)]
    assert found[8:] == [30.0] * 4


class Attempts:
    """Attempts to start a flight. Each attempt fails.

    The test double checks that the objects of an attempt are closed before the next attempt.
    """

    def __init__(self, *failures: BaseException) -> None:
        self.failures = list(failures)
        self.open = 0

    def judge(self) -> str:
        if self.failures and isinstance(self.failures[0], ConfigError):
            raise self.failures.pop(0)
        return "right"

    def __call__(self, judged: str, stack: ExitStack) -> str:
        assert (judged, self.open) == ("right", 0)
        self.open += 1
        stack.callback(self.close)
        if self.failures:
            raise self.failures.pop(0)
        return "flies"

    def close(self) -> None:
        self.open -= 1


def test_transient_faults_are_waited_for_and_reported(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = ManualClock(0)
    attempts = Attempts(
        OSError(5, "Input/output error"),
        NotResponding("i2c", "another flight"),
        UnreadConfigError("flight.yaml", "no such file"),
        UsageError("commands.udp: not up yet"),
    )
    retry = StartRetry(lambda: False, clock)
    with ExitStack() as stack:
        assert retried_start(attempts.judge, attempts, stack, retry) == "flies"
        assert attempts.open == 1
    assert attempts.open == 0
    assert clock.now_ns() == pytest.approx(3e9)
    assert retry.summary() == "started at attempt 5 after 3.0 s: commands.udp: not up yet"
    assert capsys.readouterr().err.count("knightcube: cannot start yet: ") == 4


@pytest.mark.parametrize("error", [ConfigError("flight.yaml:3", "`coils` is wrong"), ZeroDivisionError()])
def test_a_configuration_judged_wrong_ends_the_start_and_a_defect_the_process(error: Exception) -> None:
    attempts = Attempts(error)
    with ExitStack() as stack, pytest.raises(type(error)):
        retried_start(attempts.judge, attempts, stack, StartRetry(lambda: False, ManualClock()))


def test_a_signal_ends_the_wait() -> None:
    attempts = Attempts(UsageError("not up yet"))
    with ExitStack() as stack, pytest.raises(StoppedError, match="not up yet"):
        retried_start(attempts.judge, attempts, stack, StartRetry(lambda: True, ManualClock()))


@pytest.fixture
def board(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the command line of a run on a board, with short pauses between attempts."""
    monkeypatch.setattr(patient_start, "FIRST_PAUSE_S", 0.01)
    monkeypatch.setattr(patient_start, "LONGEST_PAUSE_S", 0.05)
    config = write_config(tmp_path)
    with config.open("a", encoding="utf-8") as file:
        file.write(f"\ncommands: {{socket: {tmp_path}/later/commands}}\n")
        file.write(f"\nstate: {{folder: {tmp_path}/state}}\n")
    return ["run", str(config), "--archive", str(tmp_path / "runs"), "--duration", "1"]


def test_a_board_waits_for_its_socket_folder_and_leaves_no_run_and_no_boot_of_the_wait(
    board: list[str], tmp_path: Path
) -> None:
    """A board waits for a missing socket folder. A run that has no archive ends at once with an error."""
    bench = [*board[:2], "--out", str(tmp_path / "bench"), "--duration", "1"]
    assert main(bench) == 2
    assert not (tmp_path / "bench").exists()
    timer = threading.Timer(0.3, (tmp_path / "later").mkdir)
    timer.start()
    assert main(board) == 0
    timer.join()
    (run,) = (tmp_path / "runs").iterdir()
    events = {to_text(row["name"]): to_text(row["text"]) for row in read_run(run)["event"]}
    assert events["start-waited"].startswith("started at attempt ")
    assert StateStore(tmp_path / "state", lambda *_: None).load().boot_count == 1


def test_attempts_that_fail_when_the_loop_is_built_are_not_counted_as_crashes(
    board: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "later").mkdir()
    build, failures = flight.build_loop, [OSError(5, "Input/output error"), UsageError("no image")] * 3

    def fail(*arguments: Any) -> Any:
        if failures:
            raise failures.pop()
        return build(*arguments)

    monkeypatch.setattr(flight, "build_loop", fail)
    assert main(board) == 0
    assert StateStore(tmp_path / "state", lambda *_: None).load().unclean == ()


@pytest.mark.parametrize("stores", [True, False])
def test_a_board_flies_after_the_separation_inhibit(board: list[str], tmp_path: Path, stores: bool) -> None:
    """Without a state folder, the inhibit holds at each start."""
    (tmp_path / "later").mkdir()
    config = Path(board[1])
    text = config.read_text(encoding="utf-8") + "\nseparation: {inhibit: 0.4}\n"
    config.write_text(text if stores else text.replace(f"state: {{folder: {tmp_path}/state}}", ""))
    assert main(board) == 0
    assert main(board) == 0
    texts = []
    for run in sorted((tmp_path / "runs").iterdir()):
        events = {to_text(row["name"]): to_text(row["text"]) for row in read_run(run)["event"]}
        texts.append(events.get("start-waited", ""))
    assert "separation inhibit of 0.4 s" in texts[0]
    assert ("separation inhibit of 0.4 s" in texts[1]) is not stores


def test_a_board_that_is_stopped_while_it_waits_ends_well(
    board: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(*_: object) -> Any:
        raise StoppedError("stopped before the flight began")

    monkeypatch.setattr(StartRetry, "wait", stop)
    assert main(board) == 0
    assert "stopped before the flight began" in capsys.readouterr().err


def test_a_board_whose_configuration_is_wrong_ends_with_its_own_status(board: list[str]) -> None:
    Path(board[1]).write_text("name: wrong\n", encoding="utf-8")
    assert main(board) == REFUSED


def test_a_disk_error_at_the_end_of_a_boards_flight_is_not_reported_as_wrong_use(
    board: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def end(request: RunRequest, _: object) -> None:
        raise OSError(5, "Input/output error", str(request.out))

    monkeypatch.setattr("flight.app.flight.fly", end)
    assert main(board) == 1
