"""Tests of `knightcube run`: summary, elapsed time, progress and seed."""

from __future__ import annotations

import argparse
import errno
import io
import json
import math
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest

from flight.app import flight
from flight.app.cli import main, to_json
from flight.app.cli.run import configure, counts_text, progress_on, seed_number, summary_facts, summary_text
from flight.app.run import RunRequest, RunResult
from flight.loop.flight_loop import FlightEnding, FlightProgress

ENDED = FlightEnding(
    120.0,
    4800,
    "hold",
    alarms=("blind", "holding"),
    faults={"coil-broken": 1, "camera-lost": 3},
    warnings={"cycle-slip": 2},
    coils_left_out=("x", "z"),
    coils_at_zero=True,
    coil_error="",
)
RESULT = RunResult(Path("runs/mine"), "the configured duration is over", False, "", ENDED)


def parsed(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    configure(parser)
    return parser.parse_args(["step_demo", *words])


def lines_of(text: str) -> dict[str, str]:
    return {name: rest.strip() for name, _, rest in (line.partition(":") for line in text.splitlines())}


def test_the_summary_states_time_mode_alarms_events_and_coils() -> None:
    lines = lines_of(summary_text(RESULT, 4.26))
    assert lines["flown"] == "120 s in 4.3 s, the configured duration is over"
    assert (lines["mode"], lines["alarms"]) == ("hold", "blind, holding")
    assert lines["noticed"] == "faults camera-lost (3), coil-broken (1); warnings cycle-slip (2)"
    assert lines["coils"] == "at zero; left out: x, z"
    assert lines["log"] == "runs/mine"
    assert lines["next"].endswith(" report runs/mine")
    assert "injected" not in lines


def test_the_summary_names_injected_faults_and_coils_that_are_not_at_zero() -> None:
    ending = replace(ENDED, alarms=(), coils_left_out=(), coils_at_zero=False, coil_error="no answer")
    lines = lines_of(summary_text(replace(RESULT, ending=ending, faults=("imu: silent @ 5", "b")), 1.0))
    assert lines["alarms"] == "none"
    assert lines["coils"] == "NOT confirmed at zero: no answer"
    assert lines["injected"] == "imu: silent @ 5; b"
    assert counts_text({}, "faults") == "no faults"


def test_the_json_facts_hold_the_ending() -> None:
    facts = summary_facts(replace(RESULT, log_error="disk full", interrupted=True), 4.26)
    assert (facts["mission_time_s"], facts["elapsed_s"], facts["packets"]) == (120.0, 4.26, 4800)
    assert (facts["mode"], facts["log_error"], facts["interrupted"]) == ("hold", "disk full", True)
    assert facts["noticed_faults"] == {"coil-broken": 1, "camera-lost": 3}
    assert (facts["coils_at_zero"], facts["coils_left_out"]) == (True, ("x", "z"))
    assert summary_facts(RESULT, 1.0)["log_error"] is None


def test_the_summary_states_late_emulated_devices() -> None:
    assert "devices:" not in summary_text(RESULT, 1.0)
    assert "devices:" not in summary_text(replace(RESULT, devices_late=(0, 0.012)), 1.0)
    late = replace(RESULT, devices_late=(7, 0.341))
    assert "emulated devices late by more than 25 ms 7 times, at most 0.34 s: " in summary_text(late, 1.0)
    assert summary_facts(late, 1.0)["devices_late"] == 7
    assert summary_facts(RESULT, 1.0)["devices_late"] is None


@pytest.mark.parametrize(
    ("change", "status", "complaint"),
    [
        ({}, 0, ""),
        ({"log_error": "disk full"}, 1, "disk full"),
        ({"restart": "memory-high"}, 1, "memory-high"),
    ],
)
def test_elapsed_time_is_that_of_the_flight_and_a_failure_is_status_1(
    change: dict[str, str],
    status: int,
    complaint: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    now = [100.0]
    requests: list[RunRequest] = []

    def fly(request: RunRequest, progress: object) -> RunResult:
        assert progress is not None
        requests.append(request)
        now[0] += 2.5
        return replace(RESULT, **change)  # type: ignore[arg-type]  # texts only

    monkeypatch.setattr(flight, "fly", fly)
    monkeypatch.setattr("flight.app.cli.run.time.perf_counter", lambda: now[0])
    options = parsed(
        "--json", "--seed", "7", "--duration", "3", "--out", "runs/mine", "--fault", "imu: silent"
    )
    assert options.command(options) == status
    printed = capsys.readouterr()
    assert json.loads(printed.out)["elapsed_s"] == 2.5
    assert printed.err == (f"knightcube: {complaint}\n" if complaint else "")
    (request,) = requests
    assert (request.seed, request.duration, request.out) == (7, 3.0, Path("runs/mine"))
    assert (request.faults, request.accepted, request.realtime) == (("imu: silent",), True, False)


def test_a_disk_error_before_the_flight_ends_a_service_with_status_1(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The service manager does not restart a service that ends with status 2."""

    def fail(path: object, *_: object, **__: object) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))

    words = ["run", str(tmp_path / "flight.yaml"), "--archive", str(tmp_path / "runs")]
    with monkeypatch.context() as patch:
        patch.setattr(flight, "fly", fail)
        assert main(words) == 1
        patch.setattr("flight.app.run.default_folder", fail)
        assert main([*words[:2], "--out", str(tmp_path)]) == 2, "a person reads the message"
        patch.setitem(sys.modules, "flight.app.flight", _Unread("flight.app.flight"))
        assert main(words) == 1


class _Unread(ModuleType):
    """A module whose file cannot be read."""

    def __getattr__(self, name: str) -> object:
        raise OSError(errno.EIO, os.strerror(errno.EIO), self.__name__)


def test_progress_states_time_attitude_currents_slips_and_events(monkeypatch: pytest.MonkeyPatch) -> None:
    now, stream = [0.0], io.StringIO()
    monkeypatch.setattr("flight.app.cli.run.time.perf_counter", lambda: now[0])
    show = progress_on(stream)
    now[0] = 10.0
    show(FlightProgress(12.0, 100.0, "q2 +0.1", (0.01, -0.02, 0.0), "holding", 3, 5))
    assert (
        stream.getvalue() == "    12/100 s  q2 +0.1  coils +10.0 -20.0 +0.0 mA  holding  slips 3  events 5\n"
    )


@pytest.mark.parametrize("text", ["-1", str(2**64), "1.5", "x"])
def test_a_seed_that_the_log_cannot_hold_is_refused(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match="whole number"):
        seed_number(text)


def test_the_smallest_and_the_largest_seed_are_accepted() -> None:
    assert (seed_number("0"), seed_number(str(2**64 - 1))) == (0, 2**64 - 1)


def test_numbers_of_a_json_result_are_rounded_to_15_digits() -> None:
    facts = {"time_s": 618 * 0.025, "rows": [{"x": 15.450000000000001}], "utc_ns": 1774008001000000000}
    assert to_json(facts) == '{"time_s": 15.45, "rows": [{"x": 15.45}], "utc_ns": 1774008001000000000}\n'
    # A Julian date keeps its fraction of a millisecond.
    assert to_json(2461119.50000123) == "2461119.50000123\n"
    assert to_json([math.nan, {"x": math.inf}]) == '[null, {"x": null}]\n'


def test_the_line_of_progress_names_the_function_that_numba_compiles(monkeypatch: pytest.MonkeyPatch) -> None:
    reports: list[Callable[[str], None]] = []
    monkeypatch.setattr("flight.app.cli.run.report_compilations", reports.append)
    times = iter([0.0, 5.0, 11.0])
    monkeypatch.setattr("flight.app.cli.run.time.perf_counter", lambda: next(times))
    stream = io.StringIO()
    progress_on(stream)
    for name in ("first", "second"):
        reports[0](name)
    assert stream.getvalue() == "compiling second for this machine, once\n"
    stream.close()
    monkeypatch.setattr("flight.app.cli.run.time.perf_counter", lambda: 30.0)
    reports[0]("third")
