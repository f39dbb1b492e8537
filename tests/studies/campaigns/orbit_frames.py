"""Campaign `orbit-frames`: rendered frames, edges, Sun, nadir and attitude filter over one orbit.

Satellite and sensors are those of the campaign `orbit-attitude` (`orbit_world`: one revolution that ends with
an eclipse). Sun and nadir are measured in frames of all cameras of the suite, which `sim_hal.earth_camera`
renders with the Fuga 15d and an unknown atmosphere. At each instant the solar cells of six faces give a
coarse Sun direction. The coarse direction selects the cameras that are read for the Sun, and replaces their
result if no camera shows the Sun. Nadir follows from one fit to the frames of all cameras
(`nadir_of_cameras`), which are read in the order of their expected amount of limb. If no limb is in view, the
brightness of all cameras gives a coarse nadir, and with the Sun a coarse attitude; both are reported
separately. The filter always receives the gyros at 2 Hz and the field at 1 Hz. Frames are taken once a
minute, because rendering takes most of a run.

The variants are `level` (UW, swaying about the local vertical), `any` (UW, in a random constant attitude
relative to it), `vt` (three cameras, in the same attitudes) and `2 Hz` (UW, level, frames at 2 Hz for a
minute, 20 min before sunset). Time is the processor time of one core for all that a flight computes at an
instant; the budget at 2 Hz is 500 ms. The NEES is that of attitude and gyro bias divided by six; 1 is
expected.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ground.campaigns.runner import Campaign, Case, Result, Summary, summary
from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.attitude.solvers import VectorObservation
from knightcube.astro.earth.geomagnetism import field as believed_field
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT
from knightcube.astro.quaternion import attitude_matrix, conjugate, multiply, normalise, to_rotation_vector
from knightcube.vision.camera.lens import MountedCamera
from knightcube.vision.horizon.illumination import coarse_nadir, image_brightness
from knightcube.vision.horizon.limb import MEAN_RADIUS
from knightcube.vision.horizon.nadir import nadir_of_cameras
from knightcube.vision.horizon.settings import HorizonKnowledge, RoughAttitude, SensedDirection
from knightcube.vision.solar_cells import CoarseSun, SolarStringModel, coarse_sun
from knightcube.vision.sun import SunOfCameras, SunSettings, sun_of_cameras
from sim_hal.earth_camera import EarthScene, render
from sim_hal.emulators.power import SolarCellsModel
from tests.studies.campaigns.direction_filter import AttitudeDetermination, Report, begin
from tests.studies.campaigns.orbit_attitude import SECOND, errors_of, settings_of
from tests.support import orbit_world
from tests.support.consistency_worlds import band
from tests.support.limb_frames import camera_model, finder_settings, random_air
from tests.support.orbit_geometry import suite as suite_of
from tests.support.orbit_world import STEP, World

VARIANTS: dict[str, dict[str, Any]] = {
    "level": {"suite": "uw", "turned": False, "period": 60.0},
    "any": {"suite": "uw", "turned": True, "period": 60.0},
    "vt": {"suite": "vt", "turned": True, "period": 60.0},
    "2 Hz": {"suite": "uw", "turned": False, "period": 0.5, "seconds": 2000.0, "until": 60.0},
}
EARTHLIGHT = 30.0
"""Counts of the Fuga 15d at an intensity of 0.025, that of a dark sea under a low Sun."""
FINE = np.radians(2.0)
"""Largest sigma (rad) of the worst axis of an attitude that is fine.

A fine attitude selects the cameras that can see the limb, and replaces the solar cells.
"""
LEAST_ROUGH = np.radians(0.2)
"""Smallest sigma (rad) of the filter's attitude that is given to the horizon search as prior."""
ALIKE = 30.0
"""Correlation time (s) of nadir errors, which come from ground and clouds behind the limb: measurements
within it count as one.
"""
SETTLED = 300.0
_EARTH_TURN = 7.292e-5


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` orbits of each variant."""
    return [
        Case(f"{name}/{run}", (seed, number, run), {"variant": name, **parameters})
        for number, (name, parameters) in enumerate(VARIANTS.items())
        for run in range(runs)
    ]


def run(case: Case) -> Result:
    """Fly one orbit."""
    flight = _Flight(case)
    steps = len(flight.truth.attitudes)
    until = case.parameters.get("until")
    for step in range(1, steps if until is None else min(steps, round(until / STEP) + 1)):
        flight.step(step)
    return flight.result()


@dataclass(slots=True)
class _Notes:
    """Record of each instant with frames, and of each coarse nadir and attitude."""

    instants: list[tuple[float, ...]]
    coarse: list[tuple[float, ...]]


class _Flight:
    """One orbit: the true states, the measurements, and the filter."""

    def __init__(self, case: Case) -> None:
        self.case = case
        parameters, self._rng = case.parameters, np.random.default_rng(case.seed)
        suite = suite_of(parameters["suite"])
        # All suites have the gyros and the magnetometer of the UW satellite in this campaign.
        sensors = suite_of("uw")
        truth = orbit_world.world(sensors, self._rng, parameters.get("seconds"))
        self.truth = _turned(truth, self._rng) if parameters["turned"] else truth
        self._said = orbit_world.readings(sensors, self.truth, self._rng)
        self._dates = orbit_world.dates(self.truth.pass_)
        self._model = camera_model()
        self._cameras = [MountedCamera(self._model.lens, np.array(one.mounting)) for one in suite.cameras]
        self._air, self._rotation = random_air(self._rng), self._rng.uniform(0.0, 2.0 * np.pi)
        self._strings = SolarStringModel()
        count = len(self._strings.peaks)
        self._currents = SolarCellsModel(
            self._strings.normals, self._strings.peaks, 0.02 * self._rng.standard_normal(count)
        )
        self._filter = AttitudeDetermination(settings_of(sensors))
        self._every = round(parameters["period"] / STEP)
        self._notes = _Notes([], [])

    def step(self, k: int) -> None:
        """Give the filter the measurements of instant k."""
        seconds = float(self.truth.pass_.times[k] - self.truth.pass_.times[0])
        now_ns = round(seconds * SECOND)
        begun = time.process_time()
        self._filter.rate(now_ns - round(0.5 * STEP * SECOND), self._said.gyro[k])
        if k % round(1.0 / STEP) == 0:
            field = believed_field(float(self._dates[k]), self.truth.pass_.positions[k])
            self._filter.field(now_ns, self._said.magnetometer[k], field)
        spent = time.process_time() - begun
        if k % self._every == 0:
            self._look(k, seconds, now_ns, spent)

    def _look(self, k: int, seconds: float, now_ns: int, spent: float) -> None:
        """Process the frames of instant k, and record the results."""
        truth = self.truth
        frames, currents = self._frames(k), self._read_strings(k)
        begun = time.process_time()
        position = truth.pass_.positions[k]
        report = self._filter.report(now_ns)
        fine = report.estimate is not None and float(report.sigma.max()) < FINE
        believed = None if report.estimate is None else attitude_matrix(report.estimate.quaternion)
        down = -position / np.linalg.norm(position)
        coarse = coarse_sun(currents, self._strings, None if believed is None else believed @ down)
        sun = sun_of_cameras(frames, self._cameras, coarse, SunSettings())
        self._give_sun(now_ns, sun, truth.sun[k], fine)
        knowledge = self._knowledge(k, report, coarse)
        nadir = nadir_of_cameras(frames, self._cameras, knowledge, finder_settings(self._model))
        if nadir.nadir is not None:
            covariance = nadir.nadir.covariance * max(1.0, ALIKE / self.case.parameters["period"])
            self._filter.direction("nadir", now_ns, nadir.nadir.direction, down, covariance)
        else:
            self._give_coarse(k, frames, sun)
        report = self._filter.report(now_ns)
        spent += time.process_time() - begun
        turn, nees = np.full(3, np.nan), np.nan
        if report.estimate is not None:
            turn, nees = errors_of(report.estimate, truth.attitudes[k], self._said.gyro_bias[k])
        off = np.nan
        if nadir.nadir is not None:
            off = float(
                np.linalg.norm(np.cross(nadir.nadir.direction, attitude_matrix(truth.attitudes[k]) @ down))
            )
        self._notes.instants.append(
            (
                seconds,
                float(truth.sunlit[k]),
                *np.degrees(turn),
                *np.degrees(report.sigma if report.estimate is not None else np.full(3, np.nan)),
                nees,
                float(sun.camera is not None) if sun.direction is not None else -1.0,
                float(len(nadir.cameras)),
                np.degrees(off),
                1e3 * spent,
            )
        )

    def _give_sun(self, now_ns: int, sun: SunOfCameras, reference: FloatArray, fine: bool) -> None:
        """Give the filter the Sun direction of a camera.

        If no camera shows the Sun and the attitude is coarse, the filter gets the direction from the solar
        cells.
        """
        if sun.direction is None or sun.covariance is None:
            return
        if sun.camera is not None:
            self._filter.direction("sun", now_ns, sun.direction, reference, sun.covariance)
        elif not fine:
            self._filter.direction("strings", now_ns, sun.direction, reference, sun.covariance)

    def _give_coarse(self, k: int, frames: dict[int, Image], sun: SunOfCameras) -> None:
        """Record the coarse nadir from the brightness of all frames, and with the Sun the coarse attitude."""
        if sun.direction is None or sun.covariance is None:
            return
        looks = [
            image_brightness(frame, self._cameras[number], EARTHLIGHT) for number, frame in frames.items()
        ]
        found = coarse_nadir(looks, self._altitude(k), sun.direction)
        if found is None:
            return
        position, body = self.truth.pass_.positions[k], attitude_matrix(self.truth.attitudes[k])
        down = -position / np.linalg.norm(position)
        fix = begin(
            [
                VectorObservation(sun.direction, self.truth.sun[k], sun.covariance),
                VectorObservation(found.direction, down, found.covariance),
            ]
        )
        off = float(np.arccos(np.clip(found.direction @ (body @ down), -1.0, 1.0)))
        turn, nees = np.full(3, np.nan), np.nan
        if fix is not None:
            turn = to_rotation_vector(multiply(self.truth.attitudes[k], conjugate(fix.quaternion)))
            nees = float(turn @ np.linalg.solve(fix.covariance, turn)) / 3.0
        shares = [look.share for look in looks]
        filled = max(shares) > 0.95 and sorted(shares)[-2] < 0.05
        self._notes.coarse.append(
            (
                float(filled),
                np.degrees(off),
                np.degrees(found.sigma),
                float(np.degrees(np.linalg.norm(turn))),
                nees,
            )
        )

    def _knowledge(self, k: int, report: Report, coarse: CoarseSun) -> HorizonKnowledge:
        """Return GPS and ephemerides, and the filter's attitude or the directions of the coarse sensors."""
        truth = self.truth
        known = HorizonKnowledge(position=truth.pass_.positions[k], sun=truth.sun[k])
        if report.estimate is not None:
            sigma = max(float(report.sigma.max()), float(LEAST_ROUGH))
            return replace(known, attitude=RoughAttitude(report.estimate.quaternion, sigma))
        field = believed_field(float(self._dates[k]), truth.pass_.positions[k])
        sensed = [SensedDirection(self._said.magnetometer[k], field, float(np.radians(2.0)))]
        if coarse.direction is not None:
            sensed.append(SensedDirection(coarse.direction, truth.sun[k], max(coarse.sigma, 0.02)))
        return replace(known, sensed=tuple(sensed))

    def _altitude(self, k: int) -> float:
        return float(np.linalg.norm(self.truth.pass_.positions[k])) - MEAN_RADIUS

    def _frames(self, k: int) -> dict[int, Image]:
        truth, position = self.truth, self.truth.pass_.positions[k]
        # The Sun is at its apparent position, because the renderer has no aberration.
        sun = position + ASTRONOMICAL_UNIT * truth.sun[k]
        rotation = self._rotation + _EARTH_TURN * float(truth.pass_.times[k])
        return {
            number: render(
                self._model,
                EarthScene(
                    position,
                    multiply(camera.mounting, truth.attitudes[k]),
                    sun,
                    rotation=rotation,
                    atmosphere=self._air,
                ),
                self._rng,
            )
            for number, camera in enumerate(self._cameras)
        }

    def _read_strings(self, k: int) -> FloatArray:
        truth = self.truth
        sun = ASTRONOMICAL_UNIT * truth.sun[k]
        body = attitude_matrix(truth.attitudes[k])
        return self._currents.currents(truth.pass_.positions[k], sun, body, self._rng)

    def result(self) -> Result:
        """Return the record."""
        return {
            "variant": self.case.parameters["variant"],
            "instants": np.round(np.array(self._notes.instants), 6).tolist(),
            "coarse": np.round(np.array(self._notes.coarse), 6).tolist(),
            "refused": self._filter.refused,
            "starts": self._filter.starts,
        }


def _turned(truth: World, rng: np.random.Generator) -> World:
    """Return the world with its body rotated by a random constant rotation."""
    turn = normalise(rng.standard_normal(4))
    return replace(
        truth, attitudes=multiply(turn, truth.attitudes), rates=truth.rates @ attitude_matrix(turn).T
    )


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return accuracy, NEES, availability and time of each variant."""
    facts: dict[str, Any] = {}
    for variant in VARIANTS:
        mine = [result for result in results if result["variant"] == variant]
        if not mine:
            continue
        facts[variant] = _row(mine)
    return summary(facts)


def _row(results: Sequence[Result]) -> dict[str, Any]:
    notes = np.concatenate([np.array(result["instants"]) for result in results])
    coarse = [np.array(result["coarse"]) for result in results if result["coarse"]]
    lit, known = notes[:, 1] > 0.5, np.isfinite(notes[:, 8])
    late = known & (notes[:, 0] > min(SETTLED, 0.5 * float(notes[:, 0].max())))
    answered = lit & (notes[:, 10] > 0.0)
    return {
        "runs": len(results),
        "sunlit": _accuracy(notes[late & lit]),
        "eclipse": _accuracy(notes[late & ~lit]),
        "nees": float(np.mean(notes[late, 8]) / 6.0),
        "nees_band": band(len(results) * 6),
        "nadir_share": float(np.mean(notes[lit, 10] > 0.0)),
        "nadir_deg": float(np.sqrt(0.5 * np.mean(notes[answered, 11] ** 2))) if answered.any() else np.nan,
        "sun_camera": float(np.mean(notes[lit, 9] > 0.5)),
        "sun_strings": float(np.mean(notes[lit, 9] == 0.0)),
        "attitude_share": float(np.mean(known)),
        "ms": [float(np.percentile(notes[:, 12], part)) for part in (50.0, 95.0, 100.0)],
        "refused": sum(sum(result["refused"].values()) for result in results),
        "coarse": _coarse(np.concatenate(coarse)) if coarse else {},
    }


def _accuracy(notes: FloatArray) -> tuple[float, float] | None:
    if not len(notes):
        return None
    return (
        float(np.sqrt(np.mean(notes[:, 2:5] ** 2))),
        float(np.sqrt(np.mean(notes[:, 5:8] ** 2))),
    )


def _coarse(notes: FloatArray) -> dict[str, Any]:
    found = {}
    for kind, chosen in (("one filled, others dark", notes[:, 0] > 0.5), ("others", notes[:, 0] <= 0.5)):
        part = notes[chosen]
        fixed = np.isfinite(part[:, 4])
        if fixed.any():
            found[kind] = {
                "count": len(part),
                "nadir_deg": float(np.sqrt(0.5 * np.mean(part[:, 1] ** 2))),
                "sigma_deg": float(np.sqrt(np.mean(part[:, 2] ** 2))),
                "attitude_deg": float(np.sqrt(np.mean(part[fixed, 3] ** 2))),
                "nees": float(np.mean(part[fixed, 4])),
            }
    return found


ORBIT_FRAMES = Campaign(
    "orbit-frames",
    "rendered frames to Sun and nadir to the attitude filter over one orbit, and the time of each instant",
    cases,
    run,
    summarise,
    4,
)
