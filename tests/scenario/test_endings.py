"""Tests that the coil current is zero after any end of a run, as `tests.support.flights.fly` checks."""

from __future__ import annotations

from pathlib import Path

import pytest

from ground.telemetry import read_run
from tests.support.flights import Rigged, demo_config, event_names, fly


def test_the_configured_end(tmp_path: Path) -> None:
    run = fly(demo_config(3.0, camera=False), tmp_path)
    assert abs(run["control"]["current_written"][-1, 0]) > 0.0, "the coils were in use until then"


def test_a_requested_stop(tmp_path: Path) -> None:
    def prepare(rigged: Rigged) -> None:
        rigged.at(2.0, lambda: rigged.loop.stop("asked to"))

    run = fly(demo_config(20.0, camera=False), tmp_path, prepare)
    assert run["event"]["text"][-1] == b"asked to"
    assert run["control"]["time_ns"][-1] < 2_100_000_000


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit, MemoryError])
def test_an_exception_that_ends_the_process(tmp_path: Path, error: type[BaseException]) -> None:
    def prepare(rigged: Rigged) -> None:
        def fail() -> None:
            raise error("in the middle of a flight")

        rigged.at(2.0, fail)

    with pytest.raises(error):
        fly(demo_config(20.0, camera=False), tmp_path, prepare)
    run = read_run(tmp_path)
    assert run.flight.intact
    assert event_names(run)[-1] == "stopped"
    assert run["control"]["time_ns"][-1] > 1_900_000_000


def test_a_control_task_that_fails_zeroes_the_coils_in_that_cycle_and_flies_on(tmp_path: Path) -> None:
    def prepare(rigged: Rigged) -> None:
        port = rigged.lock.line.host
        receive = port.receive

        def fail_for_a_second() -> list[tuple[int, bytes]]:
            since = rigged.lock.clock.now_ns() - rigged.epoch_ns
            if 2_000_000_000 <= since < 3_000_000_000:
                raise ZeroDivisionError("a defect")
            return receive()

        port.receive = fail_for_a_second  # type: ignore[method-assign]  # a replaced method

    run = fly(demo_config(6.0, camera=False), tmp_path, prepare)
    assert "task-failed" in event_names(run)
    truth = run["truth"]
    during = (truth["time_ns"] > 2_030_000_000) & (truth["time_ns"] < 3_000_000_000)
    assert not truth["current"][during].any()
    after = truth["time_ns"] > 3_500_000_000
    assert truth["current"][after].any()
