"""Steps and observations of the service's test in the container; run by `tests.deploy.container`."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sim_hal.faults.host import corrupted
from sim_hal.serving.device_link import RemoteI2cBus, open_bus
from tests.deploy.container import COMMANDS

SERVICE = "knightcube.service"
_PROBE = """[Service]
Type=oneshot
DevicePolicy={}
ExecStart=/bin/sh -c ": </dev/net/tun"
"""


class Service:
    """State of the service as systemctl reports it, and currents of the emulated coils."""

    def __init__(self, bus: RemoteI2cBus) -> None:
        self._bus = bus

    def show(self, name: str, unit: str = SERVICE) -> str:
        return systemctl("show", "--value", "-p", name, unit).strip()

    def pid(self) -> int:
        return int(self.show("MainPID"))

    def driven(self) -> bool:
        """Return whether a coil carries current. The query is repeated if a busy machine responds late."""
        for _ in range(50):
            with contextlib.suppress(TimeoutError):
                return any(self._bus.call("currents"))
        raise TimeoutError("the emulated devices do not answer")

    def disturb(self, act: Callable[[int], None]) -> dict[str, Any]:
        """Disturb the running service; return the times until zero coil current and until the next start."""
        wait(self.driven, 20.0)
        old = self.pid()
        begun = time.monotonic()
        act(old)
        zero = again = None
        while (since := time.monotonic() - begun) < 30.0 and again is None:
            if self.driven():
                # The restarted flight process may drive the coils from its first cycle on.
                if self.pid() in (old, 0):
                    zero = None
                elif self.show("ActiveState") == "active":
                    again = since
            elif zero is None:
                zero = since
            time.sleep(0.004)
        return {"zero_after": zero, "flies_again": again, "result": _last_words()}


def systemctl(*words: str) -> str:
    done = subprocess.run(["systemctl", *words], capture_output=True, text=True, check=False)
    return done.stdout


def wait(condition: Callable[[], bool], patience: float) -> float:
    """Wait until a condition is true, and return the duration (s). Raises TimeoutError."""
    begun = time.monotonic()
    while not condition():
        if time.monotonic() - begun > patience:
            raise TimeoutError(f"not within {patience:g} s")
        time.sleep(0.01)
    return time.monotonic() - begun


def _last_words() -> str:
    """Return the reason of the most recent ExecStopPost, as the replacement of i2cset recorded it."""
    results = [
        word for word in Path("/share/result.txt").read_text(encoding="ascii").split() if word != "before"
    ]
    return results[-1] if results else ""


def play(facts: Path) -> dict[str, Any]:
    """Run the whole scenario, and return the observations."""
    systemctl("start", "knightcube-devices.service")
    wait(facts.exists, 20.0)
    service = Service(open_bus(json.loads(facts.read_text(encoding="utf-8"))["socket"]))
    seen: dict[str, Any] = {}
    begun = time.monotonic()
    systemctl("start", SERVICE)
    seen["ready_s"] = time.monotonic() - begun
    seen["active"] = service.show("ActiveState")
    seen["status"] = service.show("StatusText")
    seen["commanded"] = _flight("command", "--to", COMMANDS, "--timeout", "10", "ping")
    seen["devices_closed"] = _devices_closed()
    seen["killed with its guardian"] = service.disturb(
        lambda _: void(systemctl("kill", "--kill-whom=all", "--signal=KILL", SERVICE))
    )
    seen["killed"] = service.disturb(lambda pid: os.kill(pid, signal.SIGKILL))
    seen["stopped"] = service.disturb(lambda pid: os.kill(pid, signal.SIGSTOP))
    seen["restarts"] = int(service.show("NRestarts"))
    seen["renewal"] = _renewal(service)
    wait(service.driven, 20.0)
    systemctl("stop", SERVICE)
    seen["end"] = {"driven": service.driven(), "result": service.show("Result"), "reported": _last_words()}
    seen["damaged"] = _damaged(service)
    seen["broken"] = _broken(service)
    return seen


def _flight(*words: str) -> str:
    """Return the output of a command of the flight software."""
    done = subprocess.run(
        [sys.executable, "-m", "flight", *words], capture_output=True, text=True, check=False
    )
    return done.stdout + done.stderr


def _renewal(service: Service) -> dict[str, Any]:
    """Return whether the privileged update program runs in its sandbox and restarts the flight."""
    own, unit, old = Path("/var/lib/knightcube-renewal"), "knightcube-renewal.service", service.pid()
    systemctl("start", unit)
    before = service.pid() == old
    (own / "restart").write_text("flight", encoding="ascii")
    systemctl("start", unit)
    wait(lambda: service.pid() not in (0, old) and service.show("ActiveState") == "active", 30.0)
    return {
        "result": service.show("Result", unit),
        "left_alone": before,
        "restarted": service.pid() != old,
        "status": (own / "status").exists(),
        "ground": (own / "kept/ground/flight.yaml").exists(),
        "flag": (own / "restart").exists(),
    }


def _damaged(service: Service) -> dict[str, Any]:
    """Flip one bit of the configuration while the board has no accepted copy of it.

    The service must wait until the file is restored.
    """
    systemctl("reset-failed", SERVICE)
    shutil.rmtree("/var/lib/knightcube/flown", ignore_errors=True)
    config = Path("/etc/knightcube/flight.yaml")
    whole = config.read_text(encoding="utf-8")
    config.write_text(corrupted(whole, 1, 1), encoding="utf-8")
    restarts = service.show("NRestarts")
    systemctl("start", "--no-block", SERVICE)
    wait(lambda: service.show("StatusText").startswith("waiting to start, 4 attempts"), 30.0)
    seen = {"driven": service.driven(), "state": service.show("ActiveState")}
    config.write_text(whole, encoding="utf-8")
    wait(service.driven, 30.0)
    seen["restarted"] = service.show("NRestarts") != restarts
    systemctl("stop", SERVICE)
    return seen


def _devices_closed() -> bool:
    """Return whether the device policy of the service refuses a device that other processes may open."""

    def opens(policy: str) -> bool:
        Path("/run/systemd/system/probe.service").write_text(_PROBE.format(policy), encoding="ascii")
        systemctl("daemon-reload")
        return subprocess.run(["systemctl", "start", "probe.service"], check=False).returncode == 0

    ours = systemctl("show", "--value", "-p", "DevicePolicy", SERVICE).strip()
    return opens("auto") and not opens(ours)


def _broken(service: Service) -> dict[str, Any]:
    """Remove the releases so that the safe-state unit starts, and restore them so that it starts the flight.

    The coils must carry no current while the releases are missing.
    """
    systemctl("reset-failed", SERVICE)
    systemctl("start", SERVICE)
    wait(service.driven, 20.0)
    releases = Path("/opt/knightcube/releases")
    away = releases.rename(releases.with_name("away"))
    systemctl("kill", "--kill-whom=all", "--signal=KILL", SERVICE)
    wait(lambda: service.show("ActiveState") == "failed", 20.0)
    safe = "knightcube-safe.service"
    wait(lambda: service.show("ActiveState", safe) == "activating", 10.0)
    wait(lambda: not service.driven(), 10.0)
    away.rename(releases)
    wait(service.driven, 90.0)
    ended = service.show("ActiveState", safe) != "activating"
    systemctl("stop", SERVICE)
    return {"tried_again": True, "safe_state_ended": ended}


def void(_: object) -> None:
    """Do nothing."""


if __name__ == "__main__":
    place = Path(sys.argv[1])
    facts_seen = play(Path(sys.argv[2]))
    systemctl("stop", "knightcube-devices.service")
    from tests.deploy.board_flight import WORLDS
    from tests.deploy.board_scenario import fly_board

    facts_seen["boards"] = {}
    for name in WORLDS:
        try:
            facts_seen["boards"][name] = fly_board(name)
        except (OSError, ValueError) as error:  # observations made before the error are stored too
            facts_seen["boards"][name] = {"problem": repr(error)}
    (place / "seen.json").write_text(json.dumps(facts_seen, indent=1), encoding="utf-8")
