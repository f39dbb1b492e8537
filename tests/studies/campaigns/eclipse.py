"""Campaign `eclipse`: accuracy of the filter's attitude during an eclipse without stars.

The cells `filter` run the filter of the loop (`FreeFilter`, with the sensor noise of the configurations) on a
craft that points to nadir. The bias of the simulated gyro walks as the filter assumes. Star fixes every 10 s
calibrate the bias for at least LEARNED s before the shadow. From the start of a shadow, the filter has only
gyro and magnetometer. Orbits without a shadow of at least SHORTEST s are replaced by new draws. The cells
`storm`, half as many as `filter`, add a field error of STORM. The cells `loop`, a tenth as many as `filter`,
run the whole loop (`fly_loop`) with a constant bias of the emulated gyro.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from flight.bodies.orbit.body import filter_settings
from flight.schema import reader as configuration
from flight.schema.orbit import OrbitConfig, TargetStep, as_orbit
from ground.campaigns.runner import Campaign, Case, Result, Summary, summary
from ground.report.orbit import camera_errors, dipole_errors
from ground.report.signals import seconds
from ground.telemetry import Run
from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.ephemeris import predict
from knightcube.astro.earth.figure import GRAVITATIONAL_PARAMETER, SEMI_MAJOR_AXIS
from knightcube.astro.earth.orbit_knowledge import OrbitState
from knightcube.astro.quaternion import conjugate, multiply, to_rotation_vector
from knightcube.gnc.estimation.free_filter import ATTITUDE, FreeFilter
from sim_hal.settings import FaultEntry, FreeBodySection, Simulation, TipOff
from sim_hal.worlds.free_body import FreeBody
from tests.studies.campaigns.orbit_pointing_flight import CYCLE, PAUSE, STAR_SIGMA, PointingFlight
from tests.support.flights import CONFIG, fly

CRAFT = {"knightcube": "orbit.yaml", "cubesat_3u": "orbit_3u.yaml"}
LIT, BLIND = 900.0, 300.0
"""Times (s) from the release, and from the last star fix, to the shadow."""
SETTLED, LAST = 300.0, 120.0
"""Time (s) after the release from which errors with star fixes are evaluated, and length (s) of the
evaluated intervals at the end of sunlight and of shadow.
"""
NODES = (9.5, 14.5)
"""Range (h) from which the mean local time of the ascending node of each run is drawn."""


def fly_loop(given: dict[str, Any], seed: tuple[int, ...]) -> Result:
    """Run the loop; the keys `lit`, `blind`, `settled`, `last` and `seconds` of `given` shorten the run."""
    lit, blind = given.get("lit", LIT), given.get("blind", BLIND)
    spans = given.get("settled", SETTLED), lit - blind, lit, given.get("last", LAST)
    path = CONFIG.parent / CRAFT[given["craft"]]
    world, shadow = _world(path, seed, lit, lit - blind)
    with TemporaryDirectory(prefix="eclipse-") as folder:
        flown = fly(_config(path, given.get("seconds", shadow)), Path(folder), section=world)
    return _facts(flown, *spans)


def _config(path: Path, duration: float) -> OrbitConfig:
    """Return the configuration of a nadir-pointing satellite, without elements and without detumbling."""
    config = as_orbit(configuration.load(path))
    rest = configuration.replace(config.detumble, low_rate=config.modes.tumble_rate, low_for=0.1)
    target = TargetStep(at=0.0, point="nadir", roll_deg=0.0)
    return configuration.replace(config, detumble=rest, elements=None, duration=duration, targets=(target,))


def _world(path: Path, seed: tuple[int, ...], lit: float, silent: float) -> tuple[Simulation, float]:
    """Return the world whose shadow begins after `lit` s, and the time (s) at which the shadow ends."""
    section = configuration.simulation_section(path.read_text(encoding="utf-8"), str(path), Simulation)
    assert section is not None
    assert section.free_body is not None
    node = float(np.random.default_rng(seed).uniform(*NODES))
    first = configuration.replace(section.free_body.orbit, local_time=node, true_anomaly_deg=0.0)
    body = configuration.replace(section.free_body, orbit=first)
    start = _state(body, section.utc)
    revolution = 2.0 * math.pi * math.sqrt((SEMI_MAJOR_AXIS + first.altitude) ** 3 / GRAVITATIONAL_PARAMETER)
    ahead = predict(start, lit + 1.5 * revolution)
    times = np.arange(lit, lit + 1.5 * revolution)
    dark = ahead.sunlit_at(times) < 0.5
    begin = int(np.flatnonzero(dark[1:] & ~dark[:-1])[0]) + 1
    end = begin + int(np.argmin(dark[begin:]))  # index in the array of times, which begins at `lit`
    orbit = configuration.replace(first, true_anomaly_deg=360.0 * begin / revolution)
    body = configuration.replace(body, orbit=orbit)
    body = configuration.replace(body, release=_at_nadir(_state(body, section.utc)))
    world = configuration.replace(
        section,
        seed=seed[0] * 100_003 + seed[1],
        free_body=body,
        orbit_devices=configuration.replace(section.orbit_devices, gps_start=1.0),
        faults=(FaultEntry(fault="camera: off", at=silent),),
    )
    return world, lit + float(end - begin)


def _state(body: FreeBodySection, utc: str) -> OrbitState:
    def no_currents() -> FloatArray:
        return np.zeros(3)

    truth = FreeBody(body, no_currents, utc=utc).orbit_truth()
    return OrbitState(truth.utc, truth.position, truth.velocity, 0.0)


def _at_nadir(state: OrbitState) -> TipOff:
    """Return the initial state with body +z to nadir, +x in the direction of flight, and the orbital rate."""
    down, normal = -state.position, np.cross(state.position, state.velocity)
    z, y = down / np.linalg.norm(down), -normal / np.linalg.norm(normal)
    a, b, c, d = quaternion.from_matrix(np.stack([np.cross(y, z), y, z])).tolist()
    speed = float(np.linalg.norm(normal) / (down @ down))
    return TipOff(rate=(0.0, -speed, 0.0), attitude=(a, b, c, d))


def _facts(flown: Run, settled: float, silent: float, lit: float, last: float) -> Result:
    """Return rms errors (deg), NEES per axis and largest errors (sigmas) by phase of the flight.

    The evaluated attitude is that of the star camera. The body's attitude also has the error of the mounting.
    """
    errors, packets, truth = camera_errors(flown), flown["navigation"], flown["orbit_truth"]
    end = float(seconds(truth)[-1])
    parts = {"stars": (settled, silent), "sunlit": (lit - last, lit), "eclipse": (end - last, end)}
    dark = truth["sunlit"][seconds(truth) > lit] < 0.5
    found: Result = {
        "shadow_s": end - lit,
        "dark_share": float(np.mean(dark)),
        "restarts": int(packets["restarts"][-1]),
        "dipole": dipole_errors(flown),
    }
    for name, (begin, until) in parts.items():
        inside = (errors.times > begin) & (errors.times <= until)
        found[name] = judged(errors.error[inside], errors.sigma[inside])
    return found


def judged(error: FloatArray, sigma: FloatArray) -> Result | None:
    """Return statistics of errors (n, 3), rad, with standard deviations (n, 3); None if there are none."""
    if not len(error):
        return None
    return {
        "rms_deg": float(np.degrees(np.sqrt(np.mean(np.sum(error**2, axis=1))))),
        "claim_deg": float(np.degrees(np.sqrt(np.mean(np.sum(sigma**2, axis=1))))),
        "nees": float(np.mean((error / sigma) ** 2)),
        "sigmas": float((np.abs(error) / sigma).max()),
    }


LEARNED, SHORTEST, LONGEST = 3_800.0, 1_900.0, 12_000.0
"""Shortest time (s) with star fixes, so that a revolution has passed when the shadow ends.

Shortest duration (s) of the shadow; longest flight (s).
"""
NOTED = 14.0
"""Interval (s) between recorded errors, chosen so that all ages of the last star fix (every 10 s) occur."""
STORM, STORM_TIME = 5e-8, 300.0
"""Standard deviation per axis (T) and time constant (s) of the Gauss-Markov field error, as configured."""
SHARE = 0.3
"""Disturbance torques as a fraction of the worst case, as in the configurations."""
WANTED = {"stars": 0.01, "sunlit": 0.05, "eclipse": 0.3}
"""Required attitude error (deg rms, three axes; issue 19)."""


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` flights of each craft, half as many in a storm, and a tenth as many in the loop."""
    return [
        Case(f"{kind}/{craft}/{run}", (seed, run), {"kind": kind, "craft": craft})
        for kind, flown in (("filter", runs), ("storm", runs // 2), ("loop", math.ceil(0.1 * runs)))
        for craft in CRAFT
        for run in range(flown)
    ]


def run(case: Case) -> Result:
    """Run the case; its parameters may shorten the run."""
    given = case.parameters
    facts = fly_loop(given, case.seed) if given["kind"] == "loop" else _fly_filter(given, case.seed)
    return {"kind": given["kind"], "craft": given["craft"], **facts}


class DarkFlight(PointingFlight):
    """A flight at nadir whose star camera is silent from `dark` s on; `end` (s) is the end of the shadow."""

    dark, end = math.inf, 0.0

    def __init__(self, craft: str, seed: int, storm: float = 0.0) -> None:
        """Create the flight; `storm` (T per axis) is the standard deviation of the added field error."""
        self._storm, self._weather = storm, np.random.default_rng([seed, 0x570])
        super().__init__({"craft": craft, "share": SHARE, "target": "nadir"}, seed)
        config = as_orbit(configuration.load(CONFIG.parent / CRAFT[craft]))
        noise = filter_settings(config).coil_noise / math.sqrt(CYCLE - PAUSE)
        self.flight.coil_noise = noise
        first, self._filter = self._filter, FreeFilter(self.flight.inertia, filter_settings(config))
        gyro = self._gyro(self.flight.motion.rate, 1.0)
        self._filter.start(first.quaternion, STAR_SIGMA**2 * np.eye(3), gyro)
        self.flight.field_error = storm * self._weather.standard_normal(3)

    def cycle(self, time: float) -> None:
        """Simulate one cycle in a changing field."""
        kept = math.exp(-CYCLE / STORM_TIME)
        kick = self._storm * math.sqrt(1.0 - kept**2) * self._weather.standard_normal(3)
        self.flight.field_error = kept * self.flight.field_error + kick
        super().cycle(time)

    def find_shadow(self, learned: float, shortest: float) -> bool:
        """Set the begin and end of the first shadow after `learned` s; return whether it is long enough."""
        times = np.arange(0.0, LONGEST)
        dark = self.flight.ephemeris(LONGEST + 1.0).sunlit_at(times) < 0.5
        begins = np.flatnonzero(dark[1:] & ~dark[:-1] & (times[1:] > learned)) + 1
        ends = np.flatnonzero(~dark[1:] & dark[:-1]) + 1
        if not len(begins) or not len(later := ends[ends > begins[0]]):
            return False
        self.dark, self.end = float(times[begins[0]]), float(times[later[0]])
        return self.end - self.dark >= shortest

    def error(self) -> tuple[FloatArray, FloatArray, float]:
        """Return attitude error and sigma (3,), rad, and the relative error of the residual dipole."""
        found, truth = self._filter, self.flight.body.orbit_truth()
        off = to_rotation_vector(multiply(self.flight.motion.quaternion, conjugate(found.quaternion)))
        missing = truth.residual_dipole - found.residual_dipole(truth.sunlit)
        share = float(np.linalg.norm(missing) / np.linalg.norm(truth.residual_dipole))
        return off, np.sqrt(np.diag(found.covariance[ATTITUDE, ATTITUDE])), share

    def _see_stars(self, time: float) -> None:
        if time < self.dark:
            super()._see_stars(time)


def _fly_filter(given: dict[str, Any], seed: tuple[int, ...]) -> Result:
    """Run the filter alone; `learned`, `shortest`, `settled`, `last` and `seconds` shorten the run."""
    number, storm = seed[0] * 100_003 + seed[1], STORM * (given["kind"] == "storm")
    flight = DarkFlight(given["craft"], number, storm)
    while not flight.find_shadow(given.get("learned", LEARNED), given.get("shortest", SHORTEST)):
        number += 1_000_003
        flight = DarkFlight(given["craft"], number, storm)
    end = min(flight.end, flight.dark + given.get("seconds", math.inf))
    settled, last = given.get("settled", SETTLED), given.get("last", LAST)
    times, errors, sigmas, shares = [], [], [], []
    for cycle in range(round(end / CYCLE)):
        flight.cycle(cycle * CYCLE)
        if cycle * CYCLE % NOTED == 0.0:
            off, claim, missing = flight.error()
            times.append(cycle * CYCLE)
            errors.append(off)
            sigmas.append(claim)
            shares.append(missing)
    at, error, sigma, share = np.array(times), np.array(errors), np.array(sigmas), np.array(shares)
    stars, late = (at > settled) & (at < flight.dark), at > end - last
    lit = (at > flight.dark - 5.0 * last) & (at < flight.dark)
    return {
        "shadow_s": end - flight.dark,
        "learned_s": flight.dark,
        "stars": judged(error[stars], sigma[stars]),
        "sunlit": None,
        "eclipse": judged(error[late], sigma[late]),
        "dipole": {"sunlight": _rms(share[lit]), "shadow": _rms(share[at > end - 5.0 * last])},
    }


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else math.nan


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return errors and claimed uncertainties by kind, craft and phase of the flight."""
    facts: dict[str, Any] = {}
    cells = list(dict.fromkeys((r["kind"], r["craft"]) for r in results))
    for kind, craft in cells:
        mine = [r for r in results if (r["kind"], r["craft"]) == (kind, craft)]
        for part in WANTED:
            if not (parts := [r[part] for r in mine if r[part] is not None]):
                continue
            facts[f"{kind}/{craft}/{part}"] = _row(parts)
        facts[f"{kind}/{craft}/dipole"] = _dipole(mine)
    return summary(facts)


def _dipole(results: Sequence[Result]) -> dict[str, tuple[float, float]]:
    """Return median and largest unknown fraction of the residual dipole, in sunlight and in shadow."""
    found = {}
    for light in ("sunlight", "shadow"):
        shares = [r["dipole"][light] for r in results if math.isfinite(r["dipole"][light])]
        if shares:
            found[light] = float(np.median(shares)), max(shares)
    return found


def _row(parts: Sequence[Result]) -> dict[str, float]:
    rms = np.array([r["rms_deg"] for r in parts])
    return {
        "flights": float(len(parts)),
        "rms": _rms(rms),
        "median": float(np.median(rms)),
        "worst": float(rms.max()),
        "claim": _rms(np.array([r["claim_deg"] for r in parts])),
        "sigmas": max(r["sigmas"] for r in parts),
        "nees": float(np.mean([r["nees"] for r in parts])),
    }


ECLIPSE = Campaign(
    "eclipse",
    "the attitude through an eclipse without stars, by gyro and magnetometer",
    cases,
    run,
    summarise,
    20,
)
