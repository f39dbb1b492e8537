"""Campaign `object-passes`: passes of an object in rendered frames, with star tracker and tracking.

Craft and object orbit the Earth. The object moves at 0.05 to 0.6 deg/s at closest approach. For six frames
the camera holds its attitude, and the object leaves a streak. Then the camera rotates with the object, and
the stars leave streaks. A `short` pass has ten frames at 1 Hz; a `long` pass has a frame every 5 s for 3 to 6
min. Exposures are 0.2 s, with 512 x 512 px over 20 deg. Each case without an object has the same number of
frames and the same motion, so every track in it is false. The error of a sighting is compared with the
Cramer-Rao bound for the motion of the point in that frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ground.campaigns.runner import Case, Result, Summary, summary
from knightcube.astro.arrays import FloatArray, tangent_basis
from knightcube.astro.quaternion import attitude_matrix, from_matrix, from_rotation_vector, multiply
from knightcube.gnc.tracker import FrameSightings, LineOfSightState, ObjectTracker, TrackSettings
from knightcube.vision.camera.lens import EXACT, Pinhole
from knightcube.vision.frame_job import FrameJob, TrackerSettings
from knightcube.vision.frame_job import run as look
from knightcube.vision.objects.settings import MeasuredObjects, ObjectMeasurementSettings
from knightcube.vision.startracker.solve import AttitudePrior, RatePrior, SolveSettings
from knightcube.vision.startracker.survey import DetectionSettings
from knightcube.vision.streaks.camera_motion import CameraMotion
from knightcube.vision.streaks.streak_result import LikelihoodSettings
from sim_hal.star_camera import SourceTrack, StarCameraModel, render
from tests.studies.campaigns.statistics import grouped, mean, rms, squared_sigmas
from tests.support.object_passes import Pass, a_pass
from tests.support.scenes import catalogue
from tests.support.streak_bound import star_information

EXPOSURE, STILL, TURNING = 0.2, 6, 10
LONG, LONG_PERIOD = (180.0, 360.0), 5.0
"""Duration of a long pass (s, smallest and largest), and period of its frames (s)."""
MAGNITUDES = (2.0, 3.0, 4.0, 5.0, 6.0)
SLOWEST, FASTEST = 0.05, 0.6
"""Slowest and fastest rate (deg/s) of an object."""
JUDGED = 8
"""Number of frames between two evaluations of a track."""
OWN_TRACK = 0.01
"""Largest angle (rad) between the object and a track that counts as the object's."""
OWN_PX = 3.0
"""Largest distance (px) between the object and a sighting that counts as the object's."""
CAMERA = StarCameraModel(columns=512, rows=512)


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` passes of each duration at each magnitude, and as many without an object."""
    return [
        Case(
            f"{length}/{run}/{magnitude}",
            (seed, run, number),
            {"length": length, "magnitude": magnitude, "still": STILL, "turning": TURNING},
        )
        for length in ("short", "long")
        for run in range(runs)
        for number, magnitude in enumerate((*MAGNITUDES, None))
    ]


def run(case: Case) -> Result:
    """Fly one pass."""
    rng = np.random.default_rng(case.seed)
    magnitude: float | None = case.parameters["magnitude"]
    rate = math.radians(float(np.exp(rng.uniform(math.log(SLOWEST), math.log(FASTEST)))))
    times = _times(case, rng)
    flown = a_pass(rng, rate, times, rng.uniform(0.0, times[-1]))
    tracker = ObjectTracker(TrackSettings())
    frames, nees = [], []
    for number, frame in enumerate(_frames(flown, case.parameters["still"], rng)):
        sighted = frame.sighted(magnitude, rng)
        frames.append(frame.judged(sighted, magnitude))
        if sighted is not None:
            seen = sighted.directions, sighted.covariance, sighted.magnitudes, sighted.attitude
            tracker.ingest(FrameSightings(round(frame.time * 1e9), *seen, observer=frame.observer))
            if number % JUDGED == JUDGED - 1:
                nees += [_nees(track.line, frame) for track in tracker.objects if _is_own(track.line, frame)]
    # A frame without an attitude does not change the tracks.
    lines = [tracker.predicted(track.number, round(times[-1] * 1e9)) for track in tracker.objects]
    own = [n for n, line in enumerate(lines) if line and _is_own(line, frame)]
    result = {**case.parameters, "rate_deg": math.degrees(rate), "frames": frames}
    result["false_tracks"] = len(lines) - (len(own[:1]) if magnitude is not None else 0)
    if magnitude is None or not own:
        return result | {"nees": None}
    return result | {"nees": nees, "brightness": tracker.objects[own[0]].magnitude}


def _times(case: Case, rng: np.random.Generator) -> FloatArray:
    """Return the times of the frames (n,), s."""
    still, turning, period = case.parameters["still"], case.parameters["turning"], 1.0
    if case.parameters["length"] == "long":
        turning, period = int(rng.uniform(*LONG) / LONG_PERIOD), LONG_PERIOD
    return np.concatenate([np.arange(still) * 1.0, still - 1.0 + period * np.arange(1, turning + 1)])


def _frames(flown: Pass, still: int, rng: np.random.Generator) -> list[_Frame]:
    """Return the frames of a pass: the camera is fixed for `still` frames, and then follows the object."""
    # Direction in camera axes in which the object crosses the boresight. The camera follows the object by a
    # rotation about `axis`.
    towards = rng.uniform(0.0, 2.0 * np.pi)
    axis = np.array([np.cos(towards), np.sin(towards), 0.0])
    first = attitude_matrix(from_rotation_vector(axis * math.radians(2.0)))[2]
    places, motions, frames = flown.directions, flown.rates, []
    about = np.cross(places[0], motions[0]) / np.linalg.norm(motions[0])
    in_sky = np.array([places[0], about, np.cross(places[0], about)])
    held = from_matrix(np.array([first, axis, np.cross(first, axis)]).T @ in_sky)
    for number, time in enumerate(flown.times):
        turn = np.zeros(3)
        if number >= still:
            turned = np.cross(places[number - 1], places[number])
            angle = math.asin(float(np.linalg.norm(turned)))
            held = multiply(
                from_rotation_vector(attitude_matrix(held) @ turned * angle / math.sin(angle)), held
            )
            turn = attitude_matrix(held) @ np.cross(places[number], motions[number])
        frames.append(_Frame(time, held, turn, places[number], motions[number], flown.observer[number]))
    return frames


@dataclass(frozen=True, slots=True, eq=False)
class _Frame:
    """One frame of a camera with the attitude `quaternion` and the rate `turn` (3,), rad/s.

    At mid-exposure the object is in the direction `place` (3,), ICRS, and moves by `motion` (3,), rad/s.
    `observer` is (3,), m.
    """

    time: float
    quaternion: FloatArray
    turn: FloatArray
    place: FloatArray
    motion: FloatArray
    observer: FloatArray

    def sighted(self, magnitude: float | None, rng: np.random.Generator) -> MeasuredObjects | None:
        """Return the sightings and the attitude that the flight's own image processing finds in the frame."""
        times = np.linspace(-0.5 * EXPOSURE, 0.5 * EXPOSURE, 9)
        attitudes = np.array([multiply(from_rotation_vector(self.turn * t), self.quaternion) for t in times])
        places = self.place + times[:, None] * self.motion
        places /= np.linalg.norm(places, axis=1, keepdims=True)
        extra = [] if magnitude is None else [SourceTrack(times, places, magnitude)]
        stars, directions = catalogue(8.5)
        pixels = render(CAMERA, directions, stars.magnitude, times, attitudes, rng, extra)
        saturation = float(CAMERA.highest_count)
        detection = DetectionSettings(psf_sigma=CAMERA.psf_sigma, gain=CAMERA.gain, saturation=saturation)
        likelihood = LikelihoodSettings(
            gain=CAMERA.gain, saturation=saturation, psf_sigma=CAMERA.psf_sigma, line_time=0.0
        )
        tracker = TrackerSettings(SolveSettings(detection=detection, lens=EXACT), (1.0, 1.0))
        off = from_rotation_vector(rng.normal(scale=1e-4, size=3))
        priors = RatePrior(self.turn, 1e-4), AttitudePrior(multiply(off, self.quaternion), 1e-4)
        job = FrameJob(
            pixels,
            CAMERA.pinhole,
            EXPOSURE,
            likelihood,
            tracker,
            *priors,
            objects=ObjectMeasurementSettings(),
        )
        return look(job).objects

    def judged(self, sighted: MeasuredObjects | None, magnitude: float | None) -> Result:
        """Return error, claim and bound of the sighting (px per axis), and the number of false sightings."""
        if sighted is None:
            return {"solved": False, "others": 0}
        if magnitude is None:
            return {"solved": True, "others": len(sighted.points)}
        place = CAMERA.pinhole.project((attitude_matrix(self.quaternion) @ self.place)[None])[0]
        away = np.linalg.norm(sighted.points - place, axis=1)
        own = int(np.argmin(away)) if len(away) else -1
        result = {"solved": True, "others": len(away), "bound": self._bound(place, magnitude)}
        if own < 0 or away[own] > OWN_PX:
            return result
        basis = tangent_basis(sighted.directions[own])
        error = basis @ self.place * CAMERA.pinhole.focal_length
        spread = basis @ sighted.covariance[own] @ basis.T * CAMERA.pinhole.focal_length**2
        return result | {
            "others": len(away) - 1,
            "error": float(away[own]) / math.sqrt(2.0),
            "sky_error": float(np.linalg.norm(error)) / math.sqrt(2.0),
            "claim": math.sqrt(0.5 * float(np.trace(spread))),
        }

    def _bound(self, place: FloatArray, magnitude: float) -> float:
        """Return the Cramer-Rao bound of the object's position (px per axis) at mid-exposure."""
        own = attitude_matrix(self.quaternion) @ np.cross(self.place, self.motion)
        light = float(CAMERA.electrons([magnitude], EXPOSURE)[0])
        floor = CAMERA.read_noise**2 + CAMERA.dark_current * EXPOSURE + CAMERA.gain**2 / 12.0
        pinhole: Pinhole = CAMERA.pinhole
        relative = CameraMotion.steady((self.turn - own) * EXPOSURE)
        known = star_information(pinhole, relative, place, light, CAMERA.psf_sigma, floor)
        return math.sqrt(0.5 * float(np.trace(np.linalg.inv(known[4:, 4:])[:2, :2])))


def _is_own(line: LineOfSightState, frame: _Frame) -> bool:
    """Return whether a track belongs to the object."""
    return bool(np.linalg.norm(line.direction - frame.place) < OWN_TRACK)


def _nees(line: LineOfSightState, frame: _Frame) -> list[float]:
    """Return the NEES of a track's direction and of its rate, each with two degrees of freedom."""
    basis = tangent_basis(line.direction)
    found = []
    for error, part in ((frame.place - line.direction, slice(0, 3)), (frame.motion - line.rate, slice(3, 6))):
        across = basis @ error
        found.append(squared_sigmas(across, basis @ line.covariance[part, part] @ basis.T))
    return found


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return a row for each duration and magnitude."""
    shown = [result for result in results if result["magnitude"] is not None]
    rows = {name: _row(own) for name, own in grouped(shown, "length", "magnitude").items()}
    empty = [result for result in results if result["magnitude"] is None]
    frames = sum(frame["solved"] for result in empty for frame in result["frames"])
    false = sum(result["false_tracks"] for result in results)
    every = sum(frame["solved"] for result in results for frame in result["frames"])
    taken = sum(len(result["frames"]) for result in results)
    facts = {"rows": rows, "false_tracks": false, "empty_frames": frames, "solved": every, "taken": taken}
    return summary(facts)


def _row(own: Sequence[Result]) -> Result:
    """Return the results of the passes of one duration and magnitude."""
    seen = [frame for result in own for frame in result["frames"] if "error" in frame]
    found = [result["nees"] for result in own if result["nees"] is not None]
    made = [nees for track in found for nees in track]
    row: Result = {"passes": len(own), "found": len(found), "judged": len(made)}
    row |= {"frames": sum(len(result["frames"]) for result in own), "seen": len(seen)}
    for name in ("error", "claim", "bound"):
        row[name] = rms([frame[name] for frame in seen])
    row["nees"] = np.mean(made, axis=0).tolist() if made else None
    off = [2.0 * (frame["error"] / frame["claim"]) ** 2 for frame in seen]
    return row | {"sighting_nees": mean(off)}
