"""Rates from streaks during a slew: `python -m tests.studies.bench slew_frames [--as-they-come]`.

The 3U of `config/orbit_3u.yaml` is released near rest, holds its attitude and slews by 100 deg in 300 s or
more. The whole loop runs, with a frame every 5 s. Exposures avoid the coils' steps; with `--as-they-come`,
they begin at the camera's scheduled times. Each rate is compared with the mean true rate over the exposure.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from flight.bodies.orbit.body import ORBIT, SatelliteControl, SatelliteEstimation
from flight.loop.body import BodyKind, FlightBody
from flight.loop.facts import Services
from flight.loop.state import Learned
from flight.schema.orbit import as_orbit
from flight.schema.sections import Config
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the results; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.bench slew_frames", description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--as-they-come", action="store_true", help="exposures may meet the coils' steps")
    options = parser.parse_args(arguments)
    body = f"{__name__}:AS_THEY_COME" if options.as_they_come else "orbit"
    with tempfile.TemporaryDirectory() as folder:
        config, world = flight(body, options.seed)
        count, rated, used, nees = compared(fly(config, Path(folder), section=world))
    sys.stdout.write(
        f"{count} frames, {rated} with a rate, {used} used; NEES of an axis: "
        f"mean {np.mean(nees):.2f}, median {np.median(nees):.2f}, largest {np.max(nees):.1f}\n"
    )
    return 0
