"""Configurations of simulated flights with scheduled mode commands, and the modes that a run entered."""

from __future__ import annotations

from typing import Any

import numpy as np

from flight.link.events import Mode
from flight.link.telemetry.packets import to_text
from flight.schema import reader as configuration
from flight.schema.bodies import TestbedConfig
from flight.schema.sections import Commands, CommandStep
from ground.telemetry import Run
from knightcube.astro.arrays import FloatArray
from sim_hal.settings import Release, Simulation
from tests.support.flights import demo_config, demo_world

CYCLE = 0.025
BRIEF = {"arrived_for": 0.3, "boot_patience": 1.0, "hold_patience": 2.0, "blind_limit": 3.0}
"""Mode settings with short timeouts (s)."""


def commanded(
    duration: float, *steps: dict[str, Any], initial: str = "testbed-demo", **modes: Any
) -> TestbedConfig:
    """Return the demonstration without a camera, with scheduled commands and short timeouts."""
    config = demo_config(duration, camera=False)
    timeline = tuple(CommandStep(**step) for step in steps)
    section = configuration.replace(config.modes, initial=initial, **{**BRIEF, **modes})
    return configuration.replace(config, modes=section, commands=Commands(timeline=timeline))


def path_of_modes(run: Run) -> list[tuple[Mode, str]]:
    """Return the modes that a run entered, each with its trigger."""
    return [(Mode(int(row["mode"])), to_text(row["trigger"])) for row in run["mode"]]


def modes_of(run: Run) -> list[Mode]:
    """Return the modes that a run entered."""
    return [mode for mode, _ in path_of_modes(run)]


def entered(run: Run, mode: Mode, occurrence: int = -1) -> float:
    """Return the mission time (s) at which a run entered a mode, by default the time of the last entry."""
    return float(run["mode"]["time_ns"][run["mode"]["mode"] == mode][occurrence]) * 1e-9


def currents(run: Run, since: float, until: float) -> FloatArray:
    """Return the largest coil current |I| at each sample of the truth in an interval."""
    time: FloatArray = run["truth"]["time_ns"] * 1e-9
    largest: FloatArray = np.abs(run["truth"]["current"]).max(axis=1)
    return largest[(time >= since) & (time < until)]


def true_angle(run: Run) -> FloatArray:
    """Return the true angle theta (n,), rad."""
    return np.asarray(2.0 * np.arcsin(run["truth"]["quaternion"][:, 1]))


def released(q2: float, rate: float) -> Simulation:
    """Return the world of the demonstration with a body that is released at `q2` with `rate` (rad/s)."""
    return configuration.replace(demo_world(), release=Release(q2=q2, rate=rate))
