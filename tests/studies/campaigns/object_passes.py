"""Campaign `object-passes`: passes of an object in rendered frames, through star tracker, sighting and track.

The camera stands still for six frames, in which the object leaves a streak, and then turns with it for ten,
in which the stars do. A frame of 0.2 s each second, 512 x 512 px over 20 deg. Each case without an object has
as many frames of the same motion: what is tracked there is false. A sighting's error is beside the Cramer-Rao
bound of a point under that motion in that frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from flight.gnc.camera.knowledge import EXACT
from flight.gnc.camera.pinhole import Pinhole
from flight.gnc.math.arrays import FloatArray
from flight.gnc.math.directions import tangent_basis
from flight.gnc.math.quaternion import attitude_matrix, from_rotation_vector, multiply, normalise
from flight.gnc.tracking.line_of_sight import LineOfSight
from flight.gnc.tracking.sightings import Sightings
from flight.gnc.tracking.tracker import Tracker, TrackSettings
from flight.gnc.vision.frame_job import FrameJob, TrackerSettings
from flight.gnc.vision.frame_job import run as look
from flight.gnc.vision.objects.sighted import Sighted, SightSettings
from flight.gnc.vision.startracker.detection import DetectionSettings
from flight.gnc.vision.startracker.solve import AttitudePrior, RatePrior, SolveSettings
from flight.gnc.vision.streaks.maximum_likelihood.motion import Motion
from flight.gnc.vision.streaks.maximum_likelihood.settings import LikelihoodSettings
from sim_hal.star_camera import SourceTrack, StarCameraModel, render
from tests.studies.campaigns.campaign import Campaign, Case, Result, Summary
from tests.studies.campaigns.scenes import catalogue
from tests.studies.streak_bound import star_information

EXPOSURE, STILL, TURNING = 0.2, 6, 10
MAGNITUDES = (2.0, 3.0, 4.0, 5.0, 6.0)
SLOWEST, FASTEST = 0.05, 0.6
"""deg/s."""
OWN_PX = 3.0
"""A sighting nearer to the object than this is its."""
CAMERA = StarCameraModel(columns=512, rows=512)


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` passes at each magnitude, and as many without an object."""
    return [
        Case(
            f"{run}/{magnitude}",
            (seed, run, number),
            {"magnitude": magnitude, "still": STILL, "turning": TURNING},
        )
        for run in range(runs)
        for number, magnitude in enumerate((*MAGNITUDES, None))
    ]


def run(case: Case) -> Result:
    """Fly one pass."""
    rng = np.random.default_rng(case.seed)
    magnitude: float | None = case.parameters["magnitude"]
    rate = math.radians(float(np.exp(rng.uniform(math.log(SLOWEST), math.log(FASTEST)))))
    start = normalise(rng.normal(size=4))
    # Towards the boresight and past it, in camera axes; the turn that follows it is about `axis`.
    towards = rng.uniform(0.0, 2.0 * np.pi)
    axis = np.array([np.cos(towards), np.sin(towards), 0.0])
    begin = from_rotation_vector(axis * math.radians(2.0))
    first = attitude_matrix(begin)[2]
    tracker = Tracker(TrackSettings())
    frames = []
    still, turning = case.parameters["still"], case.parameters["turning"]
    for second in range(still + turning):
        turn = axis * rate if second >= still else np.zeros(3)
        quaternion = multiply(from_rotation_vector(turn * (second - still)), start)
        sky = _Frame(quaternion, turn, first, axis * rate, second, start)
        sighted = sky.sighted(magnitude, rng)
        frames.append(sky.judged(sighted, magnitude))
        if sighted is not None:
            seen = sighted.directions, sighted.covariance, sighted.magnitudes, sighted.attitude
            tracker.ingest(Sightings(second * 1_000_000_000, *seen))
    true = sky.direction(0.0)
    # A frame without an attitude leaves the tracks where they were before it.
    lines = [tracker.predicted(track.number, second * 1_000_000_000) for track in tracker.objects]
    own = [n for n, line in enumerate(lines) if line and np.linalg.norm(line.direction - true) < 0.01]
    result = {**case.parameters, "rate_deg": math.degrees(rate), "frames": frames}
    result["false_tracks"] = len(lines) - (len(own[:1]) if magnitude is not None else 0)
    line = lines[own[0]] if own else None
    if magnitude is None or line is None:
        return result | {"nees": None}
    brightness = tracker.objects[own[0]].magnitude
    return result | {"nees": _nees(line, true, sky.velocity()), "brightness": brightness}


class _Frame:
    """One frame: the camera at `quaternion` turns by `turn` rad/s; the object is where its motion has it."""

    def __init__(
        self,
        quaternion: FloatArray,
        turn: FloatArray,
        first: FloatArray,
        motion: FloatArray,
        second: int,
        start: FloatArray,
    ) -> None:
        self._quaternion, self._turn, self._first, self._motion = quaternion, turn, first, motion
        self._second, self._start = second, start

    def direction(self, since: float) -> FloatArray:
        """Return where the object is, ICRS, so long after the middle."""
        angle = self._motion * (self._second + since)
        seen = attitude_matrix(from_rotation_vector(-angle)) @ self._first
        return np.asarray(attitude_matrix(self._start).T @ seen)

    def velocity(self) -> FloatArray:
        """Return how the direction changes, rad/s."""
        return np.asarray((self.direction(0.5) - self.direction(-0.5)) / 1.0)

    def sighted(self, magnitude: float | None, rng: np.random.Generator) -> Sighted | None:
        """Return what the frame shows, by the flight's own vision."""
        times = np.linspace(-0.5 * EXPOSURE, 0.5 * EXPOSURE, 9)
        attitudes = np.array(
            [multiply(from_rotation_vector(self._turn * t), self._quaternion) for t in times]
        )
        places = np.array([self.direction(t) for t in times])
        extra = [] if magnitude is None else [SourceTrack(times, places, magnitude)]
        stars, directions = catalogue(8.5)
        pixels = render(CAMERA, directions, stars.magnitude, times, attitudes, rng, extra)
        saturation = float(CAMERA.highest_count)
        detection = DetectionSettings(psf_sigma=CAMERA.psf_sigma, gain=CAMERA.gain, saturation=saturation)
        likelihood = LikelihoodSettings(gain=CAMERA.gain, saturation=saturation, psf_sigma=CAMERA.psf_sigma)
        tracker = TrackerSettings(SolveSettings(detection=detection, lens=EXACT), (1.0, 1.0))
        off = from_rotation_vector(rng.normal(scale=1e-4, size=3))
        priors = RatePrior(self._turn, 1e-4), AttitudePrior(multiply(off, self._quaternion), 1e-4)
        job = FrameJob(
            pixels, CAMERA.pinhole, EXPOSURE, likelihood, tracker, *priors, objects=SightSettings()
        )
        return look(job).objects

    def judged(self, sighted: Sighted | None, magnitude: float | None) -> Result:
        """Return the sighting's error and claim, px of an axis, the bound, and how many others there are."""
        if sighted is None:
            return {"solved": False, "others": 0}
        if magnitude is None:
            return {"solved": True, "others": len(sighted.points)}
        place = CAMERA.pinhole.project((attitude_matrix(self._quaternion) @ self.direction(0.0))[None])[0]
        away = np.linalg.norm(sighted.points - place, axis=1)
        own = int(np.argmin(away)) if len(away) else -1
        result = {"solved": True, "others": len(away), "bound": self._bound(place, magnitude)}
        if own < 0 or away[own] > OWN_PX:
            return result
        basis = tangent_basis(sighted.directions[own])
        error = basis @ self.direction(0.0) * CAMERA.pinhole.focal_length
        spread = basis @ sighted.covariance[own] @ basis.T * CAMERA.pinhole.focal_length**2
        return result | {
            "others": len(away) - 1,
            "error": float(away[own]) / math.sqrt(2.0),
            "sky_error": float(np.linalg.norm(error)) / math.sqrt(2.0),
            "claim": math.sqrt(0.5 * float(np.trace(spread))),
        }

    def _bound(self, place: FloatArray, magnitude: float) -> float:
        """Return the bound on the object's place, px of an axis, in the middle of the exposure."""
        relative = (self._turn - self._motion) * EXPOSURE
        light = float(CAMERA.electrons([magnitude], EXPOSURE)[0])
        floor = CAMERA.read_noise**2 + CAMERA.dark_current * EXPOSURE + CAMERA.gain**2 / 12.0
        pinhole: Pinhole = CAMERA.pinhole
        known = star_information(pinhole, Motion.steady(relative), place, light, CAMERA.psf_sigma, floor)
        return math.sqrt(0.5 * float(np.trace(np.linalg.inv(known[4:, 4:])[:2, :2])))


def _nees(line: LineOfSight, true: FloatArray, velocity: FloatArray) -> list[float]:
    """Return the squared errors of direction and rate over their covariance, two degrees of freedom each."""
    basis = tangent_basis(line.direction)
    found = []
    for error, part in ((true - line.direction, slice(0, 3)), (velocity - line.rate, slice(3, 6))):
        across = basis @ error
        found.append(float(across @ np.linalg.solve(basis @ line.covariance[part, part] @ basis.T, across)))
    return found


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return a row for each magnitude."""
    lines = [
        "V      found/passes  frames seen   error, claim, bound px (rms)   NEES of 2: place, direction, rate"
    ]
    rows = []
    for magnitude in MAGNITUDES:
        own = [result for result in results if result["magnitude"] == magnitude]
        seen = [frame for result in own for frame in result["frames"] if "error" in frame]
        made = [result["nees"] for result in own if result["nees"] is not None]
        row: Result = {"magnitude": magnitude, "passes": len(own), "found": len(made)}
        row |= {"frames": sum(len(result["frames"]) for result in own), "seen": len(seen)}
        for name in ("error", "claim", "bound"):
            row[name] = math.sqrt(float(np.mean([frame[name] ** 2 for frame in seen]))) if seen else None
        row["nees"] = np.mean(made, axis=0).tolist() if made else None
        off = [2.0 * (frame["error"] / frame["claim"]) ** 2 for frame in seen]
        row["sighting_nees"] = float(np.mean(off)) if off else None
        rows.append(row)
        if seen and made:
            figures = ", ".join(f"{row[name]:.3f}" for name in ("error", "claim", "bound"))
            nees = ", ".join(f"{value:.2f}" for value in (row["sighting_nees"], *row["nees"]))
            share = f"{row['seen']}/{row['frames']}"
            lines.append(f"{magnitude:3.1f}    {len(made)}/{len(own)}    {share:>10}    {figures}    {nees}")
    empty = [result for result in results if result["magnitude"] is None]
    frames = sum(frame["solved"] for result in empty for frame in result["frames"])
    false = sum(result["false_tracks"] for result in results)
    every = sum(frame["solved"] for result in results for frame in result["frames"])
    taken = sum(len(result["frames"]) for result in results)
    lines.append(f"false tracks: {false} in all passes; frames without an object searched: {frames}")
    lines.append(f"frames with an attitude: {every} of {taken}")
    facts = {"rows": rows, "false_tracks": false, "empty_frames": frames, "solved": every, "taken": taken}
    return Summary("\n".join(lines) + "\n", facts)


OBJECT_PASSES = Campaign(
    "object-passes",
    "passes of objects in rendered frames: errors of sightings and tracks, and false tracks",
    cases,
    run,
    summarise,
    10,
)
