"""Flights of a body that differs from its configuration, and the results of their coil monitor."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from flight.link import events
from flight.link.telemetry.packets import to_text
from flight.schema import reader as configuration
from flight.schema.bodies import OrbitConfig, as_orbit
from ground.telemetry import Run
from hal.interfaces.wires import SECOND_NS
from sim_hal.settings import CraftSection, FaultEntry, Simulation
from tests.support.flights import CONFIG


def configured(name: str) -> tuple[OrbitConfig, Simulation]:
    """Return a configuration of the folder `config`, and its simulated world."""
    path = CONFIG.parent / f"{name}.yaml"
    section = configuration.simulation_section(path.read_text(encoding="utf-8"), str(path), Simulation)
    assert section is not None
    return as_orbit(configuration.load(path)), section


def released(world: Simulation, seed: int, place_deg: float, speed: float) -> Simulation:
    """Return a world with another seed, position in the orbit and rate (rad/s) at the release.

    The GPS receiver has a fix after a second.
    """
    assert world.free_body is not None
    body = configuration.replace(
        world.free_body,
        orbit=configuration.replace(world.free_body.orbit, true_anomaly_deg=place_deg),
        release=configuration.replace(world.free_body.release, speed=speed),
    )
    receiver = configuration.replace(world.orbit_devices, gps_start=1.0)
    return configuration.replace(world, seed=seed, free_body=body, orbit_devices=receiver)


def without_cameras(config: OrbitConfig, duration: float) -> OrbitConfig:
    """Return a configuration without cameras, because a tumbling satellite does not use them."""
    return configuration.replace(config, duration=duration, camera=None, wide_cameras=())


def with_fault(world: Simulation, seed: int, fault: str = "", at: float = 0.0) -> Simulation:
    """Return a world with the given random seed, and optionally with a fault at `at` s."""
    entries = (FaultEntry(fault=fault, at=at),) if fault else ()
    return configuration.replace(world, seed=seed, faults=entries)


def with_other_body(
    world: Simulation, moments: Sequence[float], axes_deg: float, seed: int, fault: str = ""
) -> Simulation:
    """Return a world with given principal moments (3,), kg m^2, and axes of the body, and with a fault."""
    body = world.free_body
    assert body is not None
    craft = body.craft or CraftSection()
    assert isinstance(craft, CraftSection)
    x, y, z = moments
    body = configuration.replace(
        body,
        craft=configuration.replace(craft, inertia=(x, y, z)),
        disturbances=configuration.replace(body.disturbances, principal_turn_deg=axes_deg),
    )
    return configuration.replace(with_fault(world, seed, fault), free_body=body)


def coil_judgement(flown: Run, broken: str) -> dict[str, Any]:
    """Return the monitor's reports on each coil, and the time (s) of its report on the coil `broken`.

    `broken` is the axis of the broken coil, or empty. `flown_with` is the last factor that the flight applied
    to the dipole of the broken coil, or 1 without a correction.
    """
    isolated: dict[str, float] = {}
    named: dict[str, float] = {}
    corrected: dict[str, float] = {}
    factors: dict[str, float] = {}
    kinds = {
        events.COIL_BROKEN.name: isolated,
        events.COIL_SUSPECT.name: named,
        events.COIL_CORRECTED.name: corrected,
    }
    for event in flown["event"]:
        text = to_text(event["text"])
        found = kinds.get(to_text(event["name"]))
        if found is None or not text.startswith("coil "):
            continue
        found.setdefault(text[5], float(event["time_ns"]) / SECOND_NS)
        if found is corrected:
            factors[text[5]] = float(text.partition("used with ")[2].split()[0])
    return {
        "healthy_isolated": sorted(axis for axis in isolated if axis != broken),
        "healthy_suspected": sorted(axis for axis in named if axis != broken),
        "healthy_corrected": sorted(axis for axis in corrected if axis != broken),
        "isolated_s": isolated.get(broken),
        "corrected_s": corrected.get(broken),
        "flown_with": factors.get(broken, 1.0),
        "named_s": min((one[broken] for one in kinds.values() if broken in one), default=None),
        "speed_deg_s": math.degrees(float(np.linalg.norm(flown["attitude"]["rate"][-1]))),
    }
