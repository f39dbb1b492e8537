"""Tests of the guardian: the times at which it commands zero current, its writes, reports and memory."""

from __future__ import annotations

import errno
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.drivers.pca9685 import ALL_LED_OFF_H, FULL
from hal.guardian import FINAL_ZEROS, PATIENCE_NS, REPEAT_NS, SILENCE_NS, GuardianLine, Watch
from hal.interfaces.errors import NotResponding
from hal.interfaces.guardian import CoilReach, GuardianNews
from tests.hal.guardian.states import state, wait_until

ADDRESS = 0x41


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return tmp_path / "bytes"


@pytest.fixture
def guardian(log: Path) -> Iterator[GuardianLine]:
    line = GuardianLine(CoilReach("tests.hal.guardian.byte_log:open_bus", str(log), ((ADDRESS, 0xFD, 0x10),)))
    line.wait_ready(10.0)
    yield line
    line.close()


def zeros(log: Path) -> list[int]:
    """Return the monotonic times (ns) at which zero current was commanded."""
    lines = [line.split() for line in log.read_text(encoding="ascii").splitlines()]
    assert all(line[1:] == [str(ADDRESS), str(ALL_LED_OFF_H), str(FULL)] for line in lines)
    return [int(line[0]) for line in lines]


def beat_for(guardian: GuardianLine, seconds: float) -> int:
    """Send heartbeats at 40 Hz for a time, and return the time of the last heartbeat."""
    end_ns = time.monotonic_ns() + round(seconds * 1e9)
    while time.monotonic_ns() < end_ns:
        guardian.beat()
        last_ns = time.monotonic_ns()
        time.sleep(0.025)
    return last_ns


def news_until(guardian: GuardianLine, wanted: GuardianNews, patience: float = 10.0) -> list[GuardianNews]:
    """Return the reports up to and including the given report."""
    news: list[GuardianNews] = []
    deadline = time.monotonic() + patience
    while wanted not in news:
        assert time.monotonic() < deadline, f"no {wanted.name} in {news}"
        news += guardian.tend(time.monotonic_ns())
        time.sleep(0.01)
    return news


def test_the_guardian_acts_after_silence_and_not_while_heartbeats_arrive(
    guardian: GuardianLine, log: Path
) -> None:
    begun_ns = time.monotonic_ns()
    last_ns = beat_for(guardian, 0.6)
    assert not [at for at in zeros(log) if begun_ns + 50_000_000 < at <= last_ns]
    assert news_until(guardian, GuardianNews.ACTED).count(GuardianNews.ACTED) == 1
    wait_until(lambda: len([at for at in zeros(log) if at > last_ns]) >= 3)
    after = [(at - last_ns) * 1e-9 for at in zeros(log) if at > last_ns]
    assert 0.29 < after[0] < 0.5
    assert after[1] - after[0] > 0.09, "and again every 0.1 s"


def test_the_guardian_stops_its_writes_when_heartbeats_resume(guardian: GuardianLine, log: Path) -> None:
    beat_for(guardian, 0.05)
    news_until(guardian, GuardianNews.ACTED)
    begun_ns = time.monotonic_ns()
    last_ns = beat_for(guardian, 0.5)
    assert not [at for at in zeros(log) if begun_ns + 50_000_000 < at <= last_ns]


def test_an_orderly_end_zeroes_the_coils_again_and_leaves_no_process(
    guardian: GuardianLine, log: Path
) -> None:
    beat_for(guardian, 0.05)
    before = len(zeros(log))
    guardian.close()
    assert len(zeros(log)) == before + 1
    assert not Path(f"/proc/{guardian.process_id}").exists()


def test_signals_that_end_a_flight_do_not_end_its_guardian(guardian: GuardianLine, log: Path) -> None:
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        os.kill(guardian.process_id, number)
    beat_for(guardian, 0.1)
    assert guardian.tend(time.monotonic_ns()) == []
    assert os.getpgid(guardian.process_id) == guardian.process_id, "nor signals to the flight's group"


_FLIGHT = """
import sys, time
from hal.interfaces.guardian import CoilReach
from hal.guardian import GuardianLine
writes = ((int(sys.argv[2]), 0xFD, 0x10),)
line = GuardianLine(CoilReach("tests.hal.guardian.byte_log:open_bus", sys.argv[1], writes))
line.wait_ready(20.0)
print(line.process_id, flush=True)
time.sleep(60.0)
"""


def test_a_guardian_that_is_stopped_acts_all_the_same_when_its_flight_dies(log: Path) -> None:
    words = [sys.executable, "-c", _FLIGHT, str(log), str(ADDRESS)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True, start_new_session=True) as flight:
        assert flight.stdout is not None
        guardian = int(flight.stdout.readline())
        os.kill(guardian, signal.SIGSTOP)
        wait_until(lambda: state(guardian) == "T")
        killed_ns = time.monotonic_ns()
        flight.kill()
    wait_until(lambda: len([at for at in zeros(log) if at > killed_ns]) >= FINAL_ZEROS)
    wait_until(lambda: state(guardian) in {"", "Z"})


def test_a_killed_guardian_is_replaced_and_reported(guardian: GuardianLine) -> None:
    first = guardian.process_id
    os.kill(first, signal.SIGKILL)
    assert news_until(guardian, GuardianNews.READY) == [GuardianNews.LOST, GuardianNews.READY]
    assert guardian.process_id != first
    wait_until(lambda: not guardian.tend(0) and not Path(f"/proc/{first}").exists())


def test_a_guardian_that_cannot_be_replaced_now_is_replaced_later(
    guardian: GuardianLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If the process has no free file descriptor for a new guardian, a guardian is started later."""

    def no_line(*_: object) -> None:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    os.kill(guardian.process_id, signal.SIGKILL)
    with monkeypatch.context() as patch:
        patch.setattr(socket, "socketpair", no_line)
        assert news_until(guardian, GuardianNews.LOST) == [GuardianNews.LOST]
    assert news_until(guardian, GuardianNews.READY) == [GuardianNews.LOST, GuardianNews.READY]


def test_coils_that_answer_only_after_the_start_are_reported_as_zero(log: Path) -> None:
    broken = log.with_name("bytes.broken")
    broken.touch()
    line = GuardianLine(CoilReach("tests.hal.guardian.byte_log:open_bus", str(log), ((ADDRESS, 0xFD, 0x10),)))
    line.wait_ready(10.0, patient=True)
    broken.unlink()
    assert news_until(line, GuardianNews.READY) == [GuardianNews.READY]
    line.close()


def test_a_guardian_waits_for_a_silent_chip_though_its_message_about_the_chip_cannot_be_written(
    log: Path,
) -> None:
    broken = log.with_name("bytes.broken")
    broken.touch()
    usual, (reader, writer) = os.dup(2), os.pipe()
    os.close(reader)
    os.dup2(writer, 2)
    try:
        line = GuardianLine(CoilReach("tests.hal.guardian.byte_log:open_bus", str(log), ((65, 0xFD, 0x10),)))
    finally:
        os.dup2(usual, 2)
        os.close(usual)
        os.close(writer)
    line.wait_ready(10.0, patient=True)
    broken.unlink()
    assert news_until(line, GuardianNews.READY) == [GuardianNews.READY]
    line.close()


def test_a_guardian_that_hangs_is_replaced_and_reported(guardian: GuardianLine) -> None:
    first = guardian.process_id
    os.kill(first, signal.SIGSTOP)
    for _ in range(400):  # ten seconds of heartbeats, more than the pipe of the guardian can hold
        guardian.beat()
    news_until(guardian, GuardianNews.READY)
    assert guardian.process_id != first


def test_a_silent_chip_is_reported_once_and_tried_again(guardian: GuardianLine, log: Path) -> None:
    beat_for(guardian, 0.05)
    broken = Path(f"{log}.broken")
    broken.touch()
    assert news_until(guardian, GuardianNews.FAILED) == [GuardianNews.FAILED]
    begun_ns = time.monotonic_ns()
    broken.unlink()
    assert news_until(guardian, GuardianNews.ACTED) == [GuardianNews.ACTED]
    assert (zeros(log)[-1] - begun_ns) * 1e-9 < 0.5


def test_a_chip_that_is_silent_at_the_start_is_refused(log: Path) -> None:
    Path(f"{log}.broken").touch()
    line = GuardianLine(CoilReach("tests.hal.guardian.byte_log:open_bus", str(log), ((ADDRESS, 0xFD, 0x10),)))
    try:
        with pytest.raises(NotResponding, match="PWM chip"):
            line.wait_ready(0.5)
    finally:
        line.close()


def test_the_guardian_is_small_and_does_not_import_numpy(guardian: GuardianLine) -> None:
    process = Path(f"/proc/{guardian.process_id}")
    maps = (process / "maps").read_text(encoding="utf-8")
    assert "numpy" not in maps
    assert "msgspec" not in maps
    status = (process / "status").read_text(encoding="ascii")
    (resident,) = (int(line.split()[1]) for line in status.splitlines() if line.startswith("VmRSS"))
    assert resident < 32 * 1024, "kB"
    ticks = (process / "stat").read_text(encoding="ascii").rpartition(")")[2].split()[11:13]
    assert sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK") < 0.2, "s of CPU to start"


MS = 1_000_000


def test_before_the_first_heartbeat_zero_is_written_at_once_and_repeatedly() -> None:
    watch = Watch(0)
    assert watch.attempt(0)
    assert not watch.attempt(REPEAT_NS - 1)
    assert watch.attempt(REPEAT_NS)
    assert watch.outages == 0, "nothing has fallen silent yet"


@given(st.lists(st.integers(0, SILENCE_NS - 1), max_size=40))
def test_heartbeats_in_time_cause_no_action(gaps: list[int]) -> None:
    watch, now_ns = Watch(0), 0
    watch.beat(0)
    for gap in gaps:
        now_ns += gap
        assert not watch.attempt(now_ns)
        watch.beat(now_ns)


def test_silence_causes_an_action_after_its_time_and_is_counted_once() -> None:
    watch = Watch(0)
    watch.beat(0)
    assert watch.due_ns == SILENCE_NS
    assert [watch.attempt(at * MS) for at in (299, 300, 350, 400, 500)] == [False, True, False, True, True]
    assert watch.outages == 1


def test_a_heartbeat_after_silence_releases_at_once() -> None:
    watch = Watch(0)
    watch.beat(0)
    watch.attempt(SILENCE_NS)
    watch.beat(SILENCE_NS + 1)
    assert not watch.attempt(SILENCE_NS + REPEAT_NS)
    assert watch.attempt(2 * SILENCE_NS + 1)
    assert watch.outages == 2


def test_an_orphan_acts_at_once_and_ends_after_its_final_writes() -> None:
    watch, now_ns = Watch(0), 5 * MS
    watch.beat(0)
    watch.orphan(now_ns)
    for _ in range(FINAL_ZEROS):
        assert not watch.over(now_ns)
        assert watch.attempt(now_ns)
        watch.acknowledged()
        now_ns += REPEAT_NS
    assert watch.over(now_ns)


def test_an_orphan_without_a_response_gives_up_in_the_end() -> None:
    watch = Watch(0)
    watch.orphan(0)
    assert not watch.over(PATIENCE_NS)
    assert watch.over(PATIENCE_NS + 1)


def test_a_guardian_that_is_not_an_orphan_never_ends() -> None:
    watch = Watch(0)
    for _ in range(10):
        watch.acknowledged()
    assert not watch.over(10**15)
