"""Monte Carlo campaigns: `python -m tests.studies.campaigns NAME --runs N --seed S --out DIR`.

A campaign is a module with three functions. `cases` returns the cases for a number of runs and a seed, `run`
runs a case, and `summarise` returns the results of all cases as a table. The tests run a few cases of each
campaign with fixed seeds; the command runs a whole campaign.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass

from ground.campaigns.runner import Campaign


@dataclass(frozen=True, slots=True)
class Listed:
    """A campaign that is not imported yet: its default number of runs, its purpose, and its functions.

    An empty `module` stands for the module with the campaign's own name. The names of the functions of a
    module's second campaign begin with `prefix`; a function without the prefix serves both campaigns.
    """

    runs: int
    purpose: str
    module: str = ""
    prefix: str = ""


CAMPAIGNS = {
    "coil-faults": Listed(20, "the estimate while a coil does not carry its command"),
    "controllers": Listed(3, "the step demonstration under each controller, with the optimum as lower bound"),
    "detumble": Listed(100, "a free satellite from 10 to 0.5 deg/s by coils, with several sets of sensors"),
    "eclipse": Listed(20, "the attitude through an eclipse without stars, by gyro and magnetometer"),
    "failures": Listed(1000, "random frames: right, refused, wrong; NEES and time of the estimator"),
    "false-horizons": Listed(50, "horizons found in pictures without a limb"),
    "faults": Listed(1000, "every fault of the catalogue in every mode at random times"),
    "faults-kill": Listed(1000, "kill -9 of the flight process, in real time (use --workers 1)"),
    "first-orbits": Listed(100, "first orbits of objects from one pass: NEES, and arcs that are too short"),
    "gyro-dead": Listed(20, "testbed and satellite without a gyro: steps reached, lost flights, errors"),
    "lost-in-space": Listed(100, "identification by every method against noise, false and missing stars"),
    "mismatch": Listed(20, "cameras unlike the model: availability and consistency of the rate"),
    "nadir": Listed(1000, "nadir from frames of the Earth's limb, sunlit and with the terminator"),
    "object-flights": Listed(10, "objects found and kept in the field by coils, as far as is possible"),
    "object-passes": Listed(10, "passes of objects in rendered frames: sightings, tracks, false tracks"),
    "orbit-faults": Listed(500, "every fault of an orbit's devices in every mode of the satellite"),
    "orbit-pointing": Listed(20, "rotations to nadir, Sun and inertial attitudes, and holds, by coils alone"),
    "orbit-slews": Listed(40, "slews by coils alone of a described and of an unknown body"),
    "process-kill": Listed(500, "kill -9 and SIGSTOP of all processes, in real time (use --workers 1)"),
    "renewal-trials": Listed(200, "renewals over the link with flaws and kills: versions that fly"),
    "resting": Listed(10, "attitudes of frames with slow star motion, of cameras unlike the model"),
    "robust-controllers": Listed(
        20, "the tuned controllers in worlds unlike the model", "controllers", "robust_"
    ),
    "rso-orbits": Listed(1, "Table 4.4: ten orbits, each indicator and the default detector"),
    "safe-sun": Listed(20, "Sun pointing in SAFE by solar cells, gyro and magnetometer alone"),
    "self-calibration": Listed(10, "a lens learned from its own frames: claims and NEES of rates and lens"),
    "soak": Listed(24, "hours of flight with faults: memory, files, currents, pointing (--hours)"),
    "start": Listed(400, "every system call of a board's start fails once: the flight starts"),
    "streaked": Listed(
        10, "attitudes of frames of streaks, of cameras unlike the model", "resting", "streaked_"
    ),
    "streaks": Listed(10, "Table 3.1: rate and attitude of five estimators over theta and rotation"),
    "streaks-thesis": Listed(10, "Table 3.1 with the thesis's own camera", "streaks", "thesis_"),
    "unknown-body": Listed(20, "attitude from tumble to pointing of satellites unlike their description"),
    "unlike-inertia": Listed(10, "healthy, reversed and open coils of a satellite unlike its configuration"),
    "vibration": Listed(200, "bodies that vibrate: availability of the rate", "mismatch", "vibration_"),
    "worlds": Listed(10, "detumbling and nadir in our own world and in Basilisk, flight by flight"),
}
"""All campaigns by name."""


def campaign(name: str) -> Campaign:
    """Import and return a campaign."""
    listed = CAMPAIGNS[name]
    module = importlib.import_module(f"{__name__}.{listed.module or name.replace('-', '_')}")
    cases, run, summarise = (
        getattr(module, listed.prefix + function, None) or getattr(module, function)
        for function in ("cases", "run", "summarise")
    )
    return Campaign(name, listed.purpose, cases, run, summarise, listed.runs)
