"""Configurations of boards for runs with emulated devices, and checks of the packets of such runs."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path

import numpy as np
import yaml

from flight.link.telemetry.packets import PacketArray
from ground.telemetry import Run, read_run
from knightcube.errors import UsageError
from sim_hal.serving.device_link import RemoteI2cBus
from tests.deploy.scripts import ROOT

WORLDS = {"board_testbed": "step_demo", "board_orbit": "orbit"}
"""Name of each board configuration, with the simulated world of its emulated devices."""


def board_text(name: str, folder: Path) -> str:
    """Return a board's configuration for devices in `folder`, with timeouts for a busy machine.

    The inhibit after separation lasts 0.5 s. The testbed rotates to a new angle every 10 s, so that its
    frames contain streaks.
    """
    text = (ROOT / "config" / f"{name}.yaml").read_text(encoding="utf-8")
    text = re.sub(r"/dev/knightcube-(camera|wide-\d)", rf"{folder}/knightcube-\1/camera", text)
    text = re.sub(r"/dev/knightcube-(imu|gps|i2c)", rf"{folder}/knightcube-\1", text)
    tree = yaml.safe_load(text)
    if folder != Path("/dev"):
        tree["commands"]["socket"] = f"{folder}/commands"
    tree["camera"] |= {"vision_slow_after": 10.0, "max_age": 60.0}
    tree["executive"] = {"planner_timeout": 60.0, "vision_timeout": 60.0}
    if "separation" in tree:
        tree["separation"] = {"inhibit": 0.5}
    if "steps" in tree:
        tree["steps"] = [{"at": 10.0 * k, "q2": 0.3 * (-1) ** k} for k in range(60)]
    return yaml.safe_dump(tree, sort_keys=False)


def newest(archive: Path) -> Run:
    """Return the packets of the newest run in an archive."""
    return read_run(max(path for path in archive.iterdir() if path.is_dir()))


def has_arrived(archive: Path, orbit: bool) -> bool:
    """Return whether the newest run of an archive has readings of every device (`everything_arrived`)."""
    with suppress(UsageError):  # the log is still empty
        return everything_arrived(newest(archive), orbit)
    return False


def everything_arrived(run: Run, orbit: bool) -> bool:
    """Return whether a run has readings of every device, a rate from streaks and an attitude from stars."""
    of_body = ("fix", "directions") if orbit else ("plan",)
    every = all(len(run[name]) for name in ("imu", "housekeeping", *of_body))
    return every and len(frames_with_rate(run)) > 0 and b"solved" in run["stars"]["status"]


def frames_with_rate(run: Run) -> PacketArray:
    """Return the packets of frames whose streaks gave a rate. The sign of a rate is not always known."""
    frames = run["streak"]
    found: PacketArray = frames[np.isfinite(frames["rate"]).all(axis=1)]
    return found


def coil_currents(bus: RemoteI2cBus) -> list[float]:
    """Return the currents (A) of the emulated coils.

    The query of the emulated devices is repeated if a busy machine responds late.
    """
    for _ in range(100):
        with suppress(TimeoutError):
            found: list[float] = bus.call("currents")
            return found
    raise TimeoutError("the emulated devices do not answer")
