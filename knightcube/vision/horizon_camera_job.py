"""From the frames of the wide cameras to Sun and nadir in body axes: the job of the worker `wide`.

The solar strings choose the camera to read first, and stand in where no camera has the Sun; nadir is fitted
to the limbs of all frames at once. Where no frame shows a limb, the light in all of them may still leave a
coarse nadir: the Earth fills one camera and the others are dark. The searches are imported where the work is
done, as the control process does not need them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.quaternion import attitude_matrix
from knightcube.vision.camera.lens import MountedCamera
from knightcube.vision.horizon.settings import HorizonKnowledge, LogarithmicResponse, SensedDirection
from knightcube.vision.solar_cells import SolarStringModel

SUNLIT_COUNTS = 30.0
"""Of a pixel that the sunlit Earth lights, beyond what its scattered light gives beside it."""
LIT_SIGMA = 0.3
"""rad: a rough attitude that is worse does not tell where the Sun is from the body."""
EARTHLIGHT_SIGMA = 0.1
"""rad: a rough attitude that is worse does not say which strings the Earth lights."""
JUDGING_SIGMA = 0.005
"""rad: an attitude that is worse does not say what a camera must see."""


@dataclass(frozen=True, slots=True, eq=False)
class HorizonCameraJob:
    """Frames of one instant, by their cameras' numbers, and what is known besides.

    Attributes:
        frames: (rows, columns) each.
        knowledge: with its directions and its attitude in body axes.
        strings: the solar strings and their currents (n,) A; None without a fresh reading.
        response: of the cameras to light; None: linear.
    """

    frames: Mapping[int, Image]
    cameras: tuple[MountedCamera, ...]
    knowledge: HorizonKnowledge
    strings: tuple[SolarStringModel, FloatArray] | None
    response: LogarithmicResponse | None = None


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredDirection:
    """A direction (3,) in body axes with its covariance (3, 3) rad^2, and the cameras that gave it.

    Without a camera it is the Sun of the strings, or a nadir by the light in all frames.
    """

    direction: FloatArray
    covariance: FloatArray
    cameras: tuple[int, ...]

    @property
    def sigma(self) -> float:
        """The root of the mean variance over the two axes, rad."""
        return float(np.sqrt(0.5 * np.trace(self.covariance)))


@dataclass(frozen=True, slots=True, eq=False)
class HorizonCameraResult:
    """Sun and nadir, None where there is none, and why.

    Attributes:
        false: why pictures are not of what their cameras must see, of those that a fine attitude denies; None
            where no attitude judged.
    """

    sun: MeasuredDirection | None
    nadir: MeasuredDirection | None
    sun_reason: str = ""
    nadir_reason: str = ""
    false: Mapping[int, str] | None = None


def run(job: HorizonCameraJob) -> HorizonCameraResult:
    """Return Sun and nadir; at the top level of a module for the worker process to import."""
    sun, sun_reason = _sun(job)
    knowledge = job.knowledge
    if sun is not None and knowledge.sun is not None:
        known = SensedDirection(sun.direction, knowledge.sun, sun.sigma)
        knowledge = replace(knowledge, sensed=(*knowledge.sensed, known))
    nadir, nadir_reason = _nadir(job, knowledge, sun)
    return HorizonCameraResult(sun, nadir, sun_reason, nadir_reason, _false(job))


def _sun(job: HorizonCameraJob) -> tuple[MeasuredDirection | None, str]:
    from knightcube.vision.solar_cells import CoarseSun, CoarseSunStatus, coarse_sun  # noqa: PLC0415
    from knightcube.vision.sun import (  # noqa: PLC0415 - see the top
        LINEAR,
        SunSettings,
        sun_of_cameras,
    )

    coarse = CoarseSun(CoarseSunStatus.UNCERTAIN, reason="the strings give no readings")
    if job.strings is not None:
        coarse = coarse_sun(job.strings[1], job.strings[0], _expected_nadir(job.knowledge))
    found = sun_of_cameras(job.frames, job.cameras, coarse, LINEAR if job.response is None else SunSettings())
    if found.direction is None or found.covariance is None:
        return None, found.reason
    cameras = () if found.camera is None else (found.camera,)
    return MeasuredDirection(found.direction, found.covariance, cameras), found.reason


def _expected_nadir(knowledge: HorizonKnowledge) -> FloatArray | None:
    """Return nadir (3,) in body axes by a rough attitude, from where the Earth shines on the strings."""
    rough, position = knowledge.attitude, knowledge.position
    if rough is None or rough.sigma > EARTHLIGHT_SIGMA or position is None:
        return None
    return np.asarray(attitude_matrix(rough.quaternion) @ (-position / np.linalg.norm(position)))


def _false(job: HorizonCameraJob) -> dict[int, str] | None:
    """Return why pictures are not of what a fine attitude puts before their cameras; None without one."""
    from knightcube.vision.horizon.illumination import image_brightness, why_false  # noqa: PLC0415
    from knightcube.vision.horizon.limb import MEAN_RADIUS  # noqa: PLC0415 - see the top

    rough, position = job.knowledge.attitude, job.knowledge.position
    nadir, sun = _expected_nadir(job.knowledge), _lit_from(job.knowledge, None)
    if rough is None or rough.sigma > JUDGING_SIGMA or position is None or nadir is None or sun is None:
        return None
    altitude = float(np.linalg.norm(position)) - MEAN_RADIUS
    looks = {n: image_brightness(frame, job.cameras[n], SUNLIT_COUNTS) for n, frame in job.frames.items()}
    reasons = {n: why_false(look, nadir, altitude, sun) for n, look in looks.items()}
    return {n: reason for n, reason in reasons.items() if reason}


def _nadir(
    job: HorizonCameraJob, knowledge: HorizonKnowledge, sun: MeasuredDirection | None
) -> tuple[MeasuredDirection | None, str]:
    from knightcube.vision.horizon.illumination import coarse_nadir, image_brightness  # noqa: PLC0415
    from knightcube.vision.horizon.limb import MEAN_RADIUS  # noqa: PLC0415 - see the top
    from knightcube.vision.horizon.nadir import HorizonStatus, nadir_of_cameras  # noqa: PLC0415
    from knightcube.vision.horizon.settings import EdgeSettings, HorizonSettings  # noqa: PLC0415

    settings = HorizonSettings(edges=EdgeSettings(response=job.response))
    found = nadir_of_cameras(job.frames, job.cameras, knowledge, settings)
    if found.nadir is not None:
        return MeasuredDirection(found.nadir.direction, found.nadir.covariance, found.cameras), ""
    if found.status is not HorizonStatus.NO_HORIZON or knowledge.position is None:
        return None, found.reason
    looks = [
        image_brightness(frame, job.cameras[number], SUNLIT_COUNTS) for number, frame in job.frames.items()
    ]
    altitude = float(np.linalg.norm(knowledge.position)) - MEAN_RADIUS
    coarse = coarse_nadir(looks, altitude, _lit_from(knowledge, sun))
    if coarse is None:
        return None, found.reason
    return MeasuredDirection(coarse.direction, coarse.covariance, ()), found.reason


def _lit_from(knowledge: HorizonKnowledge, sun: MeasuredDirection | None) -> FloatArray | None:
    """Return the Sun's direction (3,) in body axes, by sight or by a rough attitude; None where unknown."""
    if sun is not None:
        return sun.direction
    rough = knowledge.attitude
    if rough is None or rough.sigma > LIT_SIGMA or knowledge.sun is None:
        return None
    return np.asarray(attitude_matrix(rough.quaternion) @ (knowledge.sun / np.linalg.norm(knowledge.sun)))
