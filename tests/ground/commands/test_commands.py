"""Tests of the command line: the examples work, each error is one line, and Ctrl-C loses no data."""

from __future__ import annotations

import fcntl
import io
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from flight.app.cli import main
from flight.app.cli.run import progress_on
from flight.app.run import default_folder
from flight.loop.flight_loop import FlightProgress
from ground.telemetry import read_run
from tests.ground.report.synthetic import Recipe, make_run
from tests.support.places import DEMO, ROOT


def command(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run `knightcube` in a separate process in the repository."""
    words = [sys.executable, "-m", "flight", *map(str, arguments)]
    return subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False, timeout=100)


def obeyed(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> tuple[int, str, str]:
    """Return exit status, output and error output of a command, run in the test process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        try:
            status: Any = main([str(argument) for argument in arguments])
        except SystemExit as ended:
            status = ended.code
    return status, *capsys.readouterr()


def test_the_program_shows_its_help() -> None:
    done = command("--help")
    assert done.returncode == 0
    assert "usage: knightcube" in done.stdout


@pytest.mark.parametrize("words", [["run"], ["report"], ["export"], ["plan"]])
def test_every_command_has_a_help(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    status, output, _ = obeyed(capsys, *words, "--help")
    assert status == 0
    assert "usage: knightcube" in output


def test_a_short_flight_prints_its_results_and_the_next_command(tmp_path: Path) -> None:
    done = command("run", DEMO, "--duration", "3", "--out", tmp_path / "run", "--seed", "4")
    assert done.returncode == 0
    assert "knightcube report" in done.stdout
    assert "\r" not in done.stderr, "a progress bar is redrawn although the output is not a terminal"
    assert (tmp_path / "run" / "config.yaml").read_text() == DEMO.read_text()


def test_json_is_one_object_and_nothing_else(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, output, _ = obeyed(capsys, "run", DEMO, "--duration", "2", "--out", tmp_path / "run", "--json")
    facts = json.loads(output)
    assert facts["mission_time_s"] == pytest.approx(2.0)
    assert facts["interrupted"] is False


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["run", "nothing.yaml"], "nothing.yaml: cannot be read"),
        (["run", "."], ".: cannot be read"),
        (["run", DEMO, "--duration", "-1", "--out", "/tmp/never"], "--duration -1.0: must be a positive"),
        (["run", DEMO, "--duration", "nan", "--out", "/tmp/never"], "--duration nan: must be a positive"),
        (
            ["run", "config/testbed.yaml", "--seed", "3", "--out", "{tmp}"],
            "--seed: this configuration has real",
        ),
        (["report", "/nowhere"], "/nowhere: no such folder"),
        (["export", "/nowhere"], "/nowhere: no such folder"),
    ],
)
def test_a_mistake_is_one_line_and_exit_status_2(
    words: list[str], complaint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status, output, error = obeyed(capsys, *[str(word).format(tmp=tmp_path) for word in words])
    assert status == 2
    assert complaint in error
    assert error.count("\n") == 1
    assert output == ""


def test_a_folder_of_a_starting_flight_keeps_its_configuration(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The flight that is about to start has not yet opened its log."""
    with (tmp_path / "config.yaml").open("w") as file:
        file.write("name: mine\n")
        file.flush()
        fcntl.flock(file, fcntl.LOCK_EX)
        status, _, error = obeyed(capsys, "run", DEMO, "--duration", "1", "--out", tmp_path)
    assert status == 2
    assert "another flight uses this folder: give another folder" in error
    assert (tmp_path / "config.yaml").read_text() == "name: mine\n"


def test_flights_of_one_second_have_folders_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("flight.app.run.utc_ns", lambda: 1_700_000_000 * 10**9)
    names = []
    for _ in range(3):
        folder = default_folder(Path("config/orbit.yaml"))
        folder.mkdir(parents=True)
        names.append(folder.name)
    assert names == [f"orbit-20231114-221320{end}" for end in ("", "-2", "-3")]


def test_a_run_is_not_written_over(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert obeyed(capsys, "run", DEMO, "--duration", "1", "--out", tmp_path)[0] == 0
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    again = command("run", DEMO, "--duration", "1", "--out", tmp_path)
    assert again.returncode == 2
    assert "already contains a run" in again.stderr
    assert again.stderr.count("\n") == 1
    assert "Traceback" not in again.stderr
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_device_that_is_not_there_is_one_line_and_exit_status_1(tmp_path: Path) -> None:
    done = command("run", "config/testbed.yaml", "--out", tmp_path)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert "/dev/i2c" in done.stderr


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_a_flight_with_its_log_whole(tmp_path: Path, number: signal.Signals) -> None:
    words = [sys.executable, "-m", "flight", "run", str(DEMO), "--out", str(tmp_path / "run")]
    # If SIGHUP is ignored, as under nohup, it must stay ignored. The tests themselves may run under nohup.
    heed = f"signal.signal({int(number)}, signal.SIG_DFL)"
    begin = f"import os, signal; {heed}; os.execv({words[0]!r}, {words!r})"
    flight = subprocess.Popen(
        [sys.executable, "-c", begin], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    log = tmp_path / "run" / "flight-0001.ccsds"
    deadline = time.monotonic() + 60.0
    try:
        while time.monotonic() < deadline and not (log.exists() and log.stat().st_size > 30_000):
            time.sleep(0.05)
        os.kill(flight.pid, number)
        out, err = flight.communicate(timeout=60)
    finally:
        flight.kill()
        flight.communicate()
    assert flight.returncode == 0, err
    assert f"stopped by {number.name}" in out
    run = read_run(tmp_path / "run")
    assert run["event"]["name"][-1] == b"stopped"
    assert all(part.intact for part in run.logs.values())


def test_plan_shows_a_stretched_horizon_and_draws_it(tmp_path: Path) -> None:
    picture = tmp_path / "path.png"
    words: list[str | Path] = [
        "plan",
        "--from",
        "0.4",
        "--from-rate",
        "0.015",
        "--to",
        "-0.3",
        "--picture",
        picture,
        "--json",
    ]
    done = command(*words)
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert facts["status"] == "stretched"
    assert facts["horizon_asked_s"] == 10.0
    assert 13.6 < facts["horizon_s"] < 14.1, "bang-bang needs about 13.7 s (errata to chapter 5)"
    assert max(map(abs, facts["current_A"])) <= 1.001 * facts["current_limit_A"]
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_plan_refuses_what_no_coil_can_reach(capsys: pytest.CaptureFixture[str]) -> None:
    status, _, error = obeyed(capsys, "plan", "--from", "0.9", "--to", "0.0")
    assert status == 2
    assert error == "knightcube: --from 0.9: must be -0.68 to 0.68\n"
    status, _, error = obeyed(capsys, "plan", "--from", "0.4", "--to", "-0.4", "--horizon", "0.1")
    assert status == 1, "valid arguments without a path are a failure and not a usage error"
    assert "every path of these durations needs at least about 65.9 A" in error


def test_export_writes_a_table_for_each_kind_of_packet(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    obeyed(capsys, "run", DEMO, "--duration", "1", "--out", tmp_path)
    _, output, _ = obeyed(capsys, "export", tmp_path, "--json")
    files = [Path(name).name for name in json.loads(output)["files"]]
    assert {"control.csv", "imu.csv", "truth.csv", "event.csv"} <= set(files)


def test_a_file_whose_name_is_not_valid_text_is_named_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    raw = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(raw, encoding="utf-8", write_through=True))
    out = tmp_path / os.fsdecode(b"csv-\xff")
    assert main(["export", str(make_run(tmp_path / "run", Recipe(duration=1.0))), "--out", str(out)]) == 0
    assert b"csv-\\udcff/control.csv\n" in raw.getvalue()


def test_on_board_nothing_is_imported_that_a_board_does_not_need() -> None:
    """The flight application imports no plotting library, no simulator and no general optimiser."""
    script = (
        "import sys, flight.app.flight, flight.app.cli; "
        "away = ('matplotlib', 'PIL', 'ground', 'sim_hal', 'pytest', 'hypothesis'); "
        "print([n for n in sys.modules if n.split('.')[0] in away or n.startswith('scipy.optimize')])"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


def test_a_flight_ends_with_a_summary_of_the_loop_itself(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["run", str(DEMO), "--duration", "5", "--archive", str(tmp_path), "--fault", "imu: silent @ 2"]
    assert main(words) == 0
    lines = dict(line.split(":", 1) for line in capsys.readouterr().out.splitlines())
    assert lines["flown"].startswith("    5 s in ")
    assert lines["mode"].strip() == "testbed-demo"
    assert "imu-silent" in lines["alarms"]
    assert "control-lost" in lines["alarms"]
    assert "imu-silent (1)" in lines["noticed"]
    assert lines["coils"].strip() == "at zero"
    assert lines["injected"].strip() == "imu: silent @ 2"
    assert "run-" in lines["log"]


def test_the_mission_time_is_that_of_the_loop_although_the_log_ends_earlier(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["run", str(DEMO), "--duration", "6", "--out", str(tmp_path / "a"), "--json"]
    assert main([*words, "--fault", "disk: full @ 2"]) == 1
    facts = json.loads(capsys.readouterr().out)
    assert facts["mission_time_s"] == 6.0
    assert "log-fault" in facts["noticed_faults"]
    assert facts["coils_at_zero"] is True


def test_progress_without_a_terminal_is_a_line_every_ten_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr("flight.app.cli.run.time.perf_counter", lambda: now[0])
    stream = io.StringIO()
    show = progress_on(stream)
    for second in range(1, 31):
        now[0] = float(second)
        show(FlightProgress(float(second), 100.0, "q2", (0.0, 0.0, 0.0), "holding", 0, 1))
    assert [int(line.split("/")[0]) for line in stream.getvalue().splitlines()] == [10, 20, 30]
