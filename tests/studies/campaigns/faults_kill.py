"""Campaign `faults-kill`: kill -9 of the flight process at random times of a real-time run.

A case is a board whose emulated devices run in a separate process all the time, and whose stored state
persists. Its flights are killed one after the other, a quarter of them before they are ready. After each kill
the campaign samples the coil currents every few milliseconds, and reads the log and the stored state. Then
the next flight must start. The last flight is stopped by SIGTERM. It must have a record of all kills, and
must be in safe mode if the number of kills reaches the crash limit of its configuration.
"""

from __future__ import annotations

import json
import signal
import socket
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from flight.link.events import Mode
from flight.link.telemetry.packets import LONGEST_PACKET
from flight.loop.state import StateStore, StoredState
from ground.campaigns.runner import Case, Result, Summary, summary
from ground.telemetry import Run, read_run
from knightcube.errors import UsageError
from sim_hal.serving.device_link import RemoteI2cBus
from tests.hal.guardian.campaign import lives
from tests.hal.guardian.live_flight import LiveFlight, devices_running, write_config

START_S = 1.5
"""Time (s) from the start of the process to READY; it is assumed until the first start is measured."""

AT_MOST_S = 60.0


@dataclass
class Board:
    """Devices, stored state and counts of a board; they outlive its flight processes.

    Attributes:
        boots: number of flights that have recorded their own start.
        start_s: time (s) from the last start to READY.
        left: processes that were children of a flight when it was killed.
    """

    place: Path
    devices: Path
    bus: RemoteI2cBus
    boots: int = 0
    start_s: float = START_S
    left: list[int] = field(default_factory=list)

    @property
    def state(self) -> Path:
        """Folder of the flight's stored state."""
        return self.place / "state"

    @contextmanager
    def flight(self, number: int, target: float, crash_limit: int) -> Iterator[LiveFlight]:
        """Start a flight to `target` in a folder of its own, and end it at the end of the `with` block."""
        folder = self.place / f"flight-{number}"
        folder.mkdir()
        config = write_config(folder)
        tree = yaml.safe_load(config.read_text(encoding="utf-8"))
        tree["steps"] = [{"at": 0.0, "q2": target}]
        tree["state"] = {"folder": str(self.state)}
        tree["modes"] = {"crash_limit": crash_limit}
        config.write_text(yaml.safe_dump(tree), encoding="utf-8")
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notifications:
            notifications.bind(str(folder / "notify"))
            flight = LiveFlight(folder, config, notifications, AT_MOST_S, "--devices", str(self.devices))
            try:
                yield flight
            finally:
                flight.process.kill()
                flight.process.wait()
                if flight.process.stderr is not None:
                    flight.process.stderr.close()

    def current(self) -> float:
        """Return the largest of the true currents (A) that the coils carry at present."""
        return float(np.abs(self.bus.call("currents")).max())

    def kept(self) -> tuple[StoredState, list[str]]:
        """Return the stored state, and a list of faults in its files."""
        problems: list[str] = []
        state = StateStore(self.state, lambda _, text: problems.append(text)).load()
        return state, problems


LIMIT_S = 0.5
KILLS = 16
"""Number of kills of a board: the highest `crash_limit` that a configuration may have."""

EARLY = 0.25
"""Fraction of the kills that happen before the flight is ready."""

LONGEST_FLOWN_S = 1.5
_BEFORE_S = 0.1
_CALM_S = 0.15
_GIVE_UP_S = 2.0
_POLL_S = 0.004
_LOGGED_S = 1.0  # longest time (s) after READY without packets on disk
_GONE_S = 3.0
_TARGET = 0.3


def cases(runs: int, seed: int) -> list[Case]:
    """Return boards with `runs` kills in total."""
    sizes = [min(KILLS, runs - done) for done in range(0, runs, KILLS)]
    return [Case(str(number), (seed, number), {"kills": size}) for number, size in enumerate(sizes)]


def run(case: Case) -> Result:
    """Kill the flights of one board one after the other, and stop the last one by SIGTERM."""
    rng = np.random.default_rng(case.seed)
    begun = time.monotonic()
    kills: list[Result] = []
    end: Result | None = None
    problem = ""
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        (place / "devices").mkdir()
        with devices_running(place / "devices") as facts:
            bus = RemoteI2cBus(json.loads(facts.read_text(encoding="utf-8"))["socket"])
            board = Board(place, facts, bus)
            try:
                for number in range(case.parameters["kills"]):
                    kills.append(_kill(board, number, rng))
                end = _end(board, len(kills), rng)
            except AssertionError as error:  # a flight did not start
                problem = str(error)
            bus.close()
    return {"kills": kills, "end": end, "problem": problem, "took_s": time.monotonic() - begun}


def _kill(board: Board, number: int, rng: np.random.Generator) -> Result:
    """Start a flight, kill it, and check coil currents, log and stored state."""
    early = bool(rng.random() < EARLY)
    share, target = float(rng.random()), float(rng.uniform(-_TARGET, _TARGET))
    with board.flight(number, target, KILLS) as flight:
        if early:
            ready_ns, kill_ns = None, flight.begun_ns + round(share * board.start_s * 1e9)
        else:
            ready_ns = flight.wait_for("READY=1")
            board.start_s = (ready_ns - flight.begun_ns) * 1e-9
            kill_ns = ready_ns + round(share * LONGEST_FLOWN_S * 1e9)
        before = _current_until(board, kill_ns)
        board.left += flight.children()
        killed_ns = flight.do(signal.SIGKILL)
        zero_after, current_after = watch_coils(board, killed_ns, before)
    ready_for = None if ready_ns is None else (killed_ns - ready_ns) * 1e-9
    return {
        "early": early,
        "lived_s": (killed_ns - flight.begun_ns) * 1e-9,
        "ready_for_s": ready_for,
        "current_before_a": before,
        "zero_after_s": zero_after,
        "current_after_a": current_after,
        "log": _log_of(flight.folder, ready_for),
        "state": _state_of(board, counted=not early),
    }


def _current_until(board: Board, kill_ns: int) -> float:
    """Wait until `kill_ns`; return the largest current (A) of the last 0.1 s, from at least one sample.

    One sample is not enough, because a flight switches its coils off at times to read the magnetometer.
    """
    time.sleep(max(0.0, (kill_ns - time.monotonic_ns()) * 1e-9 - _BEFORE_S))
    current = board.current()
    while time.monotonic_ns() < kill_ns:
        time.sleep(_POLL_S)
        current = max(current, board.current())
    return current


def watch_coils(board: Board, killed_ns: int, before: float) -> tuple[float, float]:
    """Return the time (s) from the kill to lasting zero current, and the largest current after the limit.

    The time ends at the first sample of zero current, so it can be up to one sample interval too long, but
    not too short. Coils that carried current are observed beyond the time limit; all other coils are observed
    long enough to show that they stay at zero.
    """
    zero_after = beyond = 0.0
    driven = before > 0.0
    while True:
        current = board.current()
        now = (time.monotonic_ns() - killed_ns) * 1e-9
        if current > 0.0:
            driven = True
            zero_after = _GIVE_UP_S
            beyond = max(beyond, current if now > LIMIT_S else 0.0)
        elif driven:
            driven = False
            zero_after = now
        calm = now - zero_after
        if now > _GIVE_UP_S or (not driven and calm > _CALM_S and (before == 0.0 or now > LIMIT_S)):
            return zero_after, beyond
        time.sleep(_POLL_S)


def _log_of(folder: Path, ready_for: float | None) -> Result:
    """Return whether the log is readable to its last complete packet, and its number of packets."""
    try:
        flown = read_run(folder)
    except UsageError as error:
        # A log without a packet on disk is correct only in the first second of a flight.
        return {"readable": ready_for is None or ready_for < _LOGGED_S, "packets": 0, "problem": str(error)}
    packets = sum(sum(log.counts.values()) for log in flown.logs.values())
    return {"readable": _whole(flown), "packets": packets, "problem": ""}


def _whole(flown: Run) -> bool:
    """Return whether the logs of a run are complete; each may end with one truncated packet."""
    return all(
        log.skipped_bytes + log.other_versions + sum(log.missing.values()) == 0
        and log.truncated_bytes < LONGEST_PACKET
        for log in flown.logs.values()
    )


def _state_of(board: Board, counted: bool) -> Result:
    """Return whether the stored state is intact and lists all kills; an early kill may be missing.

    The state must list every boot so far as unclean: the last boot by `running`, the others by name. A flight
    that was ready must have recorded its own start.
    """
    state, problems = board.kept()
    new = state.boot_count - board.boots
    board.boots = state.boot_count
    known = [shutdown.boot for shutdown in state.unclean]
    right = known == list(range(1, state.boot_count)) and state.running == (state.boot_count > 0)
    return {"whole": not problems, "counted": right and (new == 1 if counted else new in {0, 1})}


def _end(board: Board, number: int, rng: np.random.Generator) -> Result:
    """Stop a flight by SIGTERM; return whether its end and its mode are correct.

    The number of kills either equals the crash limit, which leads to safe mode, or is one smaller.
    """
    crash_limit = int(np.clip(board.boots + rng.integers(2), 1, KILLS))
    with board.flight(number, 0.1, crash_limit) as flight:
        flight.wait_for("READY=1")
        time.sleep(_CALM_S)
        complaint = flight.end()
    state, problems = board.kept()
    modes = read_run(flight.folder)["mode"]["mode"]
    safe_wanted = len(state.unclean) >= crash_limit
    deadline = time.monotonic() + _GONE_S
    while any(map(lives, board.left)) and time.monotonic() < deadline:
        time.sleep(0.05)
    return {
        "status": flight.process.returncode,
        "complaint": complaint,
        "clean": not state.running and not problems,
        "safe_wanted": safe_wanted,
        "mode_right": (int(modes[-1]) == Mode.SAFE if len(modes) else False) == safe_wanted,
        "remembered": len(state.unclean) == state.boot_count - 1 == board.boots,
        "current_a": board.current(),
        "left_behind": sum(map(lives, board.left)),
    }


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return how long the coils carried current after kills, and the other results."""
    kills = [kill for result in results for kill in result["kills"]]
    ends = [result["end"] for result in results if result["end"] is not None]
    driven = [kill for kill in kills if kill["current_before_a"] > 0.0]
    after = np.array([kill["zero_after_s"] for kill in driven] or [0.0])
    facts: dict[str, Any] = {
        "kills": len(kills),
        "boards": len(results),
        "starts_failed": sum(bool(result["problem"]) for result in results),
        "early": sum(kill["early"] for kill in kills),
        "driven": len(driven),
        "zero_after_s": {
            "median": float(np.median(after)),
            "p99": float(np.quantile(after, 0.99)),
            "worst": float(max(kill["zero_after_s"] for kill in kills)),
        },
        "beyond_limit": sum(kill["zero_after_s"] > LIMIT_S for kill in kills),
        "current_after_a": max(kill["current_after_a"] for kill in kills),
        "logs_readable": sum(kill["log"]["readable"] for kill in kills),
        "states_whole": sum(kill["state"]["whole"] for kill in kills),
        "kills_counted": sum(kill["state"]["counted"] for kill in kills),
        "clean_ends": sum(end["status"] == 0 and end["clean"] and end["remembered"] for end in ends),
        "modes_right": sum(end["mode_right"] for end in ends),
        "safe_wanted": sum(end["safe_wanted"] for end in ends),
        "left_behind": sum(end["left_behind"] for end in ends),
        "wall_s_per_kill": sum(result["took_s"] for result in results) / len(kills),
    }
    return summary(facts)
