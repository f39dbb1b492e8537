"""Rates from streaks during a slew.

The 3U of `config/orbit_3u.yaml` is released near rest, holds its attitude and slews by 100 deg in 300 s or
more. The whole loop runs, with a frame every 5 s. Exposures avoid the coils' steps; with `--as-they-come`,
they begin at the camera's scheduled times. Each rate is compared with the mean true rate over the exposure.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated

import numpy as np

from flight.bodies.orbit.body import ORBIT, SatelliteControl, SatelliteEstimation
from flight.loop.body import BodyKind, FlightBody
from flight.loop.facts import Services
from flight.loop.state import Learned
from flight.schema.orbit import as_orbit
from flight.schema.sections import Config
from tests.studies.command import Seed, command, scratch
from tests.support.flights import fly
from tests.support.slew_frames import compared, flight


class _Unscheduled(SatelliteControl):
    """Control of the satellite whose exposures are not scheduled by the coils' pauses."""

    def exposure_start(self, from_ns: int, exposure_ns: int) -> int:
        """Return the requested time."""
        return from_ns


def _as_they_come(config: Config, services: Services, learned: Mapping[str, Learned]) -> FlightBody:
    """Return the satellite with exposures at the scheduled times of the camera."""
    body = ORBIT.make(config, services, learned)
    estimation = body.estimation
    assert isinstance(estimation, SatelliteEstimation)
    return replace(body, control=_Unscheduled(as_orbit(config), estimation, services))


AS_THEY_COME = BodyKind(ORBIT.plan, _as_they_come)


@command
def main(
    *, seed: Seed = 1, as_they_come: Annotated[bool, "exposures may meet the coils' steps"] = False
) -> int:
    """Print the results; return the exit status."""
    with scratch() as folder:
        config, world = flight(f"{__name__}:AS_THEY_COME" if as_they_come else "orbit", seed)
        count, rated, used, nees = compared(fly(config, folder, section=world))
    sys.stdout.write(
        f"{count} frames, {rated} with a rate, {used} used; NEES of an axis: "
        f"mean {np.mean(nees):.2f}, median {np.median(nees):.2f}, largest {np.max(nees):.1f}\n"
    )
    return 0
