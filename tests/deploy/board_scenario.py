"""Flights of the boards' configurations in the container, started by systemd in the service's sandbox."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from sim_hal.serving.device_link import open_bus
from tests.deploy.board_flight import WORLDS, board_text, coil_currents, has_arrived
from tests.deploy.scenario import SERVICE, systemctl, wait
from tests.deploy.scripts import ROOT

PATIENCE_S = 150.0
"""Timeout (s) until every device has been read on a busy machine."""
_CONFIG, _RUNS = Path("/etc/knightcube/flight.yaml"), Path("/var/lib/knightcube/runs")
_FOLDER, _FACTS = Path("/run/knightcube-board"), Path("/run/knightcube-board.json")
_BOARD = "knightcube-board.service"
_DEVICES = f"""[Service]
Type=exec
User=knightcube
RuntimeDirectory={_FOLDER.name}
Environment=PYTHONPATH={ROOT} XDG_CACHE_HOME={_FOLDER} TMPDIR={_FOLDER} OPENBLAS_NUM_THREADS=1
WorkingDirectory={ROOT}
StandardOutput=truncate:{_FACTS}
ExecStart={sys.prefix}/bin/python -m tests.deploy.emulated_board {_CONFIG} {ROOT}/config/{{}}.yaml {_FOLDER}
"""
_FLIGHT = f"""[Service]
ReadWritePaths={_FOLDER}
Environment=PATH=/usr/bin KNIGHTCUBE_COMPILED=0 {{}}
ExecStart=
ExecStart={sys.prefix}/bin/python -m tests.deploy.emulated_video {_CONFIG} {{}} \
    run {_CONFIG} --archive {_RUNS}
"""


def fly_board(name: str) -> dict[str, Any]:
    """Run a board's configuration as the service, and return the observations."""
    _CONFIG.write_text(board_text(name, Path("/dev")), encoding="utf-8")
    for device in ("imu", "gps", "camera", "wide-1", "wide-2"):
        link = Path(f"/dev/knightcube-{device}")
        link.unlink(missing_ok=True)
        link.symlink_to(_FOLDER / device)
    accepted = subprocess.run(
        [str(ROOT / "deploy/install.sh"), "--accept"],
        capture_output=True,
        text=True,
        check=False,
    )
    if accepted.returncode != 0:
        return {"problem": accepted.stdout + accepted.stderr}
    Path("/run/systemd/system", _BOARD).write_text(_DEVICES.format(WORLDS[name]), encoding="utf-8")
    systemctl("daemon-reload")
    systemctl("start", _BOARD)
    wait(lambda: _FACTS.exists() and _FACTS.read_text(encoding="utf-8").endswith("\n"), 60.0)
    facts = json.loads(_FACTS.read_text(encoding="utf-8"))
    environment = " ".join(f"{variable}={value}" for variable, value in facts["environment"].items())
    own = Path("/etc/systemd/system", f"{SERVICE}.d/zz-board.conf")
    own.write_text(_FLIGHT.format(environment, facts["socket"]), encoding="utf-8")
    systemctl("daemon-reload")
    systemctl("reset-failed", SERVICE)
    bus, before = open_bus(facts["socket"]), set(_RUNS.iterdir())
    systemctl("start", "--no-block", SERVICE)
    driven = arrived = False
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline and not (driven and arrived):
        time.sleep(1.0)
        driven |= any(coil_currents(bus))
        if set(_RUNS.iterdir()) > before:
            arrived = has_arrived(_RUNS, name == "board_orbit")
    active = systemctl("show", "--value", "-p", "ActiveState", SERVICE).strip()
    systemctl("stop", SERVICE)
    currents = coil_currents(bus)
    result = systemctl("show", "--value", "-p", "Result", SERVICE).strip()
    bus.close()
    systemctl("stop", _BOARD)
    _FACTS.unlink()
    own.unlink()
    return {
        "active": active,
        "driven": driven,
        "arrived": arrived,
        "at_zero": not any(currents),
        "result": result,
    }
