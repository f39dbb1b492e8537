"""Tests of `knightcube mission-control` without Java, with test doubles of Yamcs and of the flight."""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Callable
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

from flight.link.telemetry.definitions import HEALTH, RUN
from flight.link.telemetry.packets import Packer
from ground import yamcs
from ground.commands import mission_control
from ground.commands.mission_control import Replay, configure
from knightcube.errors import KnightCubeError, UsageError
from tests.flight.link.telemetry.samples import plain_contents, timing_packets

DEMO = Path(__file__).parents[3] / "config" / "step_demo.yaml"
ZERO = datetime(2026, 3, 20, 12, 0, 1, 500_000, tzinfo=UTC)


def run_packet(utc: datetime | None) -> bytes:
    """Return the packet with the UTC of mission time zero, plus 999 us."""
    utc_ns = 0 if utc is None else round(utc.timestamp() * 1e3) * 10**6 + 999_000
    return Packer().pack(RUN, 0, {**plain_contents(RUN), "utc_ns": utc_ns})


def recorded(folder: Path, *segments: list[bytes]) -> Path:
    """Write a run with these segments of the flight log."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, packets in enumerate(segments, 1):
        (folder / f"flight-{number:04d}.ccsds").write_bytes(b"".join(packets))
    return folder


def options(*words: str, config: Path = DEMO) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    configure(parser)
    return parser.parse_args([str(config), *words])


def test_the_default_port_keys_and_folder_are_those_of_the_help() -> None:
    given = options()
    assert (given.port, given.keys, given.out) == (yamcs.HTTP_PORT, yamcs.KEYS, Path("mission-control"))
    assert (given.link, given.recorded, given.fly, given.speed, given.epoch) == (
        None,
        None,
        False,
        None,
        None,
    )
    assert options("--speed", "2.5").speed == 2.5


# Recorded packets.


def test_the_packets_of_a_run_are_those_of_its_segments_in_order(tmp_path: Path) -> None:
    packets = timing_packets(5)
    assert mission_control._packets(recorded(tmp_path, packets[:2], packets[2:])) == packets
    with pytest.raises(UsageError, match=r"no flight log \(flight-0001\.ccsds\) in this folder"):
        mission_control._packets(tmp_path / "none")


def test_mission_time_zero_is_that_of_the_last_run_packet_in_milliseconds() -> None:
    earlier, later = run_packet(datetime(2026, 1, 1, tzinfo=UTC)), run_packet(ZERO)
    assert mission_control._mission_zero([earlier, *timing_packets(2), later]) == ZERO
    assert mission_control._mission_zero(timing_packets(2)) is None
    assert mission_control._mission_zero([]) is None
    assert mission_control._mission_zero([earlier, run_packet(None)]) is None


def test_a_packet_with_an_earlier_time_is_replayed_with_its_predecessor(tmp_path: Path) -> None:
    times = (5, 8, 6, 9)
    packets = [Packer().pack(HEALTH, second * 10**9, plain_contents(HEALTH)) for second in times]
    (tmp_path / yamcs.RECORDED).mkdir()
    replay = Replay(packets, tmp_path, 1.0, begun=50.0)
    replay.turn(52.9)
    (first,) = (tmp_path / yamcs.RECORDED).iterdir()
    assert (first.name, first.read_bytes()) == ("run-000001.ccsds", packets[0])
    first.unlink()
    replay.turn(53.0)
    (second,) = (tmp_path / yamcs.RECORDED).iterdir()
    assert (second.name, second.read_bytes()) == ("run-000002.ccsds", packets[1] + packets[2])
    replay.turn(54.0)
    assert [path.name for path in (tmp_path / yamcs.RECORDED).iterdir()] == ["run-000002.ccsds"]
    Replay([], tmp_path, 1.0, begun=0.0).turn(1e9)


# Addresses, processes and the flight.


def test_the_address_is_that_of_the_configuration() -> None:
    udp = SimpleNamespace(udp="127.0.0.1:5", tcp="127.0.0.1:6")
    tcp = SimpleNamespace(udp=None, tcp="127.0.0.1:6")
    neither = SimpleNamespace(udp=None, tcp=None)
    address: Callable[[Path, Any], str] = mission_control._address
    assert address(DEMO, udp) == "127.0.0.1:5"
    assert address(DEMO, tcp) == "tcp:127.0.0.1:6"
    with pytest.raises(UsageError, match=r"has neither `link\.udp` nor `link\.tcp`: give --link ADDRESS"):
        address(DEMO, neither)
    with pytest.raises(UsageError, match="has no section `link`"):
        address(DEMO, None)


class Process:
    """Test double of a process, whose method `poll` returns one of the given answers after another."""

    def __init__(self, *answers: int | None, stubborn: bool = False) -> None:
        self.answers, self.stubborn = list(answers), stubborn
        self.calls: list[str] = []

    def poll(self) -> int | None:
        return self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]

    def terminate(self) -> None:
        self.calls.append("terminate")

    def kill(self) -> None:
        self.calls.append("kill")

    def wait(self, timeout: float | None = None) -> int | None:
        self.calls.append(f"wait {timeout}")
        if timeout is not None and self.stubborn:
            raise subprocess.TimeoutExpired("yamcs", timeout)
        return self.answers[-1]


def test_only_a_status_other_than_zero_is_a_failure() -> None:
    failed: Callable[[Any], bool] = mission_control._failed
    assert [failed(Process(status)) for status in (None, 0, 1, -9)] == [False, False, True, True]


def test_a_process_that_does_not_end_is_killed() -> None:
    end: Callable[[Any], None] = mission_control._end
    willing, stubborn = Process(0), Process(0, stubborn=True)
    end(willing)
    end(stubborn)
    assert willing.calls == ["terminate", "wait 30.0"]
    assert stubborn.calls == ["terminate", "wait 30.0", "kill", "wait None"]


def test_a_process_writes_both_outputs_to_a_new_log_and_ends_with_the_stack(tmp_path: Path) -> None:
    log = tmp_path / "log"
    log.write_text("old")
    code = "import sys; print('out'); print('err', file=sys.stderr); sys.stdout.close(); sys.stdin.read()"
    with ExitStack() as stack:
        one = mission_control._process([sys.executable, "-c", code], log, stack)
        one.wait(20.0)
        assert sorted(log.read_text().split()) == ["err", "out"]
    assert one.poll() is not None


class Clock:
    """Monotonic clock that only sleep advances."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 100.0
        monkeypatch.setattr("ground.commands.mission_control.time.monotonic", lambda: self.now)
        monkeypatch.setattr("ground.commands.mission_control.time.sleep", self.sleep)

    def sleep(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    return Clock(monkeypatch)


Started = list[tuple[list[str], Path]]


def processes(monkeypatch: pytest.MonkeyPatch, say: str, *answers: int | None) -> Started:
    """Replace processes by test doubles whose logs contain `say`; return the list of started processes."""
    started: Started = []

    def start(command: list[str], log: Path, stack: ExitStack) -> Process:
        log.write_text(say)
        started.append((command, log))
        return Process(*answers)

    monkeypatch.setattr(mission_control, "_process", start)
    return started


def test_the_flight_starts_when_the_link_is_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, clock: Clock
) -> None:
    started = processes(monkeypatch, "link open\n", None)
    running = mission_control._flown(DEMO, tmp_path, ExitStack())
    assert list(running) == ["the link", "the flight"]
    runs = str(tmp_path / "runs")
    flight = [sys.executable, "-m", "flight"]
    assert started == [
        ([*flight, "link", str(DEMO), "--log", runs], tmp_path / "link.log"),
        ([*flight, "run", str(DEMO), "--realtime", "--archive", runs], tmp_path / "flight.log"),
    ]
    assert clock.now == 100.0


def test_a_link_that_does_not_open_is_reported_after_a_minute(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, clock: Clock
) -> None:
    started = processes(monkeypatch, "starting\n", None)
    with pytest.raises(KnightCubeError, match=r"the link could not be opened: see .*link\.log"):
        mission_control._flown(DEMO, tmp_path, ExitStack())
    assert len(started) == 1
    assert 160.0 < clock.now < 160.5
    # If the link has ended, the flight is started nevertheless, and `run` reports the link's status.
    ended = processes(monkeypatch, "starting\n", 1)
    mission_control._flown(DEMO, tmp_path, ExitStack())
    assert len(ended) == 2


def test_the_first_packets_are_those_of_the_new_run(tmp_path: Path, clock: Clock) -> None:
    old = recorded(tmp_path / "runs" / "run-000001", timing_packets(1))
    new = tmp_path / "runs" / "run-000002"
    packets = [run_packet(ZERO), *timing_packets(1)]

    class Flight(Process):
        def poll(self) -> int | None:
            if clock.now > 103.0:
                recorded(new, packets)
            elif clock.now > 102.0:
                recorded(new, [])
            elif clock.now > 101.0:
                new.mkdir(exist_ok=True)
            return None

    running: Any = {"the flight": Flight(None)}
    assert mission_control._first_packets(tmp_path, [old], running) == packets
    assert 103.0 < clock.now < 103.5


@pytest.mark.parametrize(("status", "waits"), [(None, 60.0), (1, 0.0)])
def test_a_flight_without_packets_is_reported(
    status: int | None, waits: float, tmp_path: Path, clock: Clock
) -> None:
    running: Any = {"the flight": Process(status)}
    with pytest.raises(KnightCubeError, match=r"the flight did not begin: see .*flight\.log"):
        mission_control._first_packets(tmp_path, [], running)
    assert clock.now - 100.0 == pytest.approx(waits, abs=0.21)


# Yamcs.


class Answers:
    """HTTP interface of Yamcs that gives one answer after another; the last is repeated."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *answers: Any) -> None:
        self.answers = list(answers)
        self.asked: list[tuple[str, str, str, str]] = []
        self.passes: list[tuple[Any, ...]] = []
        self.refusal: OSError | None = None

        def session(url: str, user: str, password: str) -> Any:
            def ask(path: str) -> Any:
                self.asked.append((url, user, password, path))
                answer = self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]
                if isinstance(answer, Exception):
                    raise answer
                return {"state": answer}

            return SimpleNamespace(ask=ask)

        def add_passes(session: Any, *words: Any) -> None:
            self.passes.append(words)
            if self.refusal is not None:
                raise self.refusal

        monkeypatch.setattr(yamcs, "Session", session)
        monkeypatch.setattr(yamcs, "add_passes", add_passes)


def configured(folder: Path) -> Path:
    (folder / "etc").mkdir()
    (folder / yamcs.USERS).write_text('admin: {password: "1a2b", superuser: true}\n')
    return folder


def test_yamcs_is_asked_until_it_runs_and_then_shows_the_passes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, clock: Clock
) -> None:
    http = Answers(monkeypatch, OSError("refused"), ValueError("no JSON"), "INITIALIZING", "RUNNING")
    forecast: Any = ("prediction", ("station",))
    assert mission_control._started(8090, configured(tmp_path), forecast, lambda: False)
    assert http.asked == [("http://127.0.0.1:8090/api", "admin", "1a2b", "/instances/knightcube")] * 4
    assert http.passes == [("knightcube", "prediction", ("station",))]
    assert clock.now == pytest.approx(100.6)
    assert mission_control._started(8090, tmp_path, None, lambda: False)
    assert len(http.passes) == 1
    http.refusal = OSError("HTTP 403")
    with pytest.raises(KnightCubeError, match=r"Yamcs refuses the passes: HTTP 403: see .*log"):
        mission_control._started(8090, tmp_path, forecast, lambda: False)


def test_the_start_of_yamcs_can_be_interrupted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, clock: Clock
) -> None:
    http = Answers(monkeypatch, "INITIALIZING")
    assert not mission_control._started(1, configured(tmp_path), ("p", ()), lambda: clock.now > 101.0)  # type: ignore[arg-type]
    assert http.passes == []


def test_the_passes_are_predicted_from_elements_or_configuration(monkeypatch: pytest.MonkeyPatch) -> None:
    sources: list[Path] = []

    def predicted(given: argparse.Namespace) -> tuple[str, str, str]:
        sources.append(given.config)
        return "prediction", "stations", "config"

    monkeypatch.setattr(mission_control, "predicted", predicted)
    assert mission_control._forecast(options()) is None
    found: Any = mission_control._forecast(options("--station", "Berlin,52,13"))
    assert found == ("prediction", "stations")
    assert mission_control._forecast(options("--stations", "x", "--elements", "y.tle")) is not None
    assert sources == [DEMO, Path("y.tle")]


# The whole command.

SLEEP = "import time; time.sleep(60)"
"""Program that runs until it is ended."""


class Stage:
    """Mission control whose Yamcs is the program `code`, and which gets a signal after some turns."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, code: str, *, turns: int = 10**9) -> None:
        self.turns, self.compiled = turns, list[Path]()
        self.http = Answers(monkeypatch, "RUNNING")
        self.signals = SimpleNamespace(received=False)
        self.gateway = self.Gateway(self)
        monkeypatch.setattr(yamcs, "missing", lambda: "")
        monkeypatch.setattr(yamcs, "compile_link", self.compiled.append)
        monkeypatch.setattr(yamcs, "command_line", lambda folder: [sys.executable, "-c", code])
        monkeypatch.setattr(mission_control, "EndingSignals", lambda: self)
        monkeypatch.setattr(mission_control, "_ASK_S", 0.01)

    def __enter__(self) -> Any:
        return self.signals

    def __exit__(self, *error: object) -> None: ...

    def count(self) -> None:
        """Count a turn of the main loop; the signal arrives in the last turn."""
        self.turns -= 1
        self.signals.received = self.turns <= 0

    class Gateway:
        """Gateway that counts how often mission control calls it."""

        port = 4321

        def __init__(self, stage: Stage) -> None:
            self.stage, self.waits, self.closed = stage, list[float](), False

        def turn(self, seconds: float) -> None:
            self.waits.append(seconds)
            self.stage.count()

        def close(self) -> None:
            self.closed = True


def settings(folder: Path) -> dict[str, Any]:
    """Return the data links of Yamcs's configuration by their names."""
    read = yaml.safe_load((folder / "etc" / "yamcs.knightcube.yaml").read_text())
    return {one["name"]: one for one in read["dataLinks"]}


def epoch_of(folder: Path) -> str:
    return str(settings(folder)["gateway"]["packetPreprocessorArgs"]["timeEncoding"]["epochUTC"])


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return recorded(tmp_path / "run", [run_packet(ZERO), *timing_packets(2)])


def test_a_recorded_run_is_replayed_until_yamcs_ends(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    code = (
        "import pathlib, sys, time\n"
        f"place, until = pathlib.Path({str(out / 'recorded')!r}), time.monotonic() + 20.0\n"
        "while not list(place.glob('run-*')) and time.monotonic() < until: time.sleep(0.01)\n"
        "print('read'); sys.exit(3)"
    )
    stage = Stage(monkeypatch, code)
    with pytest.raises(KnightCubeError, match=f"Yamcs has ended with status 3: see the logs in {out}"):
        mission_control.run(options("--recorded", str(run), "--out", str(out), "--port", "8123"))
    assert (out / "recorded" / "run-000001.ccsds").read_bytes() == (run / "flight-0001.ccsds").read_bytes()
    assert (out / "log").read_text() == "read\n"
    assert stage.compiled == [out]
    assert epoch_of(out) == "2026-03-20T12:00:01.500000Z"
    assert settings(out)["gateway"]["enabledAtStartup"] is False
    assert "port: 8123" in (out / "etc" / "yamcs.yaml").read_text()
    shown = capsys.readouterr().out
    assert shown == (
        f"Yamcs on http://127.0.0.1:8123/, user admin, password in {out / yamcs.USERS}, "
        f"log in {out / 'log'} (Ctrl-C ends)\n"
    )


def test_the_gateway_runs_until_the_signal_and_has_its_token_in_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage, keys, tokens = Stage(monkeypatch, SLEEP, turns=3), tmp_path / "keys", list[str]()
    links: list[str] = []
    keys.mkdir()
    terminal = SimpleNamespace(close=lambda: links.append("closed"))

    def terminal_of(given: argparse.Namespace) -> Any:
        links.append(given.link)
        return terminal

    def gateway(of: Any, address: str, token: str, warn: Callable[[str], None]) -> Any:
        assert (of, address) == (terminal, "127.0.0.1:0")
        tokens.append(token)
        return stage.gateway

    monkeypatch.setattr(mission_control, "terminal_of", terminal_of)
    monkeypatch.setattr(mission_control, "Gateway", gateway)
    written: list[str] = []
    turn = stage.gateway.turn

    def look(seconds: float) -> None:
        written.append((keys / "gateway-4321.token").read_text())
        turn(seconds)

    stage.gateway.turn = look  # type: ignore[method-assign]
    words = ("--link", "127.0.0.1:9", "--keys", str(keys), "--out", str(tmp_path / "out"))
    assert mission_control.run(options(*words, "--epoch", "2027-01-02T03:04:05")) == 0
    assert stage.gateway.waits == [0.01] * 3
    assert set(written) == {f"{tokens[0]}\n"}
    assert stage.gateway.closed
    assert links == ["127.0.0.1:9", "closed"]
    assert not (keys / "gateway-4321.token").exists()
    assert epoch_of(tmp_path / "out") == "2027-01-02T03:04:05Z"
    link = settings(tmp_path / "out")["gateway"]
    assert link["enabledAtStartup"] is True
    assert (link["host"], link["port"]) == ("127.0.0.1", 4321)
    assert link["tokenFile"] == str(keys / "gateway-4321.token")


def test_a_flown_satellite_gives_the_epoch_and_its_failure_ends_mission_control(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage = Stage(monkeypatch, SLEEP)
    flight = Process(None, None, None, 5)
    running: Any = {"the link": Process(None), "the flight": flight}
    monkeypatch.setattr(mission_control, "_flown", lambda config, folder, stack: running)
    monkeypatch.setattr(mission_control, "_first_packets", lambda *words: [run_packet(ZERO)])
    monkeypatch.setattr(mission_control, "_gateway", lambda options, stack: stage.gateway)
    begins: list[Any] = []
    monkeypatch.setattr(mission_control, "_forecast", lambda given: begins.append(given.begin))
    given = options("--fly", "--out", str(tmp_path / "out"))
    given.link = "127.0.0.1:9"
    with pytest.raises(KnightCubeError, match="the flight has ended with status 5: see the logs in"):
        mission_control.run(given)
    assert begins == [ZERO]
    assert epoch_of(tmp_path / "out") == "2026-03-20T12:00:01.500000Z"


def test_wrong_use_is_refused_before_anything_starts(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stage = Stage(monkeypatch, SLEEP)
    with pytest.raises(UsageError, match="--speed: replays a recorded run: give --recorded RUN"):
        mission_control.run(options("--speed", "2"))
    with pytest.raises(UsageError, match="--port 99999: must be 1 to 65535"):
        mission_control.run(options("--port", "99999"))
    with pytest.raises(UsageError, match="--epoch yesterday: give a UTC such as"):
        mission_control.run(options("--epoch", "yesterday"))
    with pytest.raises(UsageError, match="no flight log"):
        mission_control.run(options("--recorded", str(run.parent / "none")))
    with pytest.raises(UsageError, match="has no section `link`"):
        mission_control.run(options())
    monkeypatch.setattr(yamcs, "missing", lambda: "Java is missing")
    with pytest.raises(KnightCubeError, match="Java is missing"):
        mission_control.run(options("--recorded", str(run)))
    assert stage.compiled == []
