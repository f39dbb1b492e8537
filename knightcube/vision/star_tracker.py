"""Star tracker as a single class that returns the attitude from an image, or the reason for a failure.

    solution = StarTracker(fov_deg=11.4).solve(image)

The class `StarTracker` combines the methods of `knightcube.vision.startracker` for point stars with the
methods for streaked stars, by the decision tree of `knightcube.vision.frame_job`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from knightcube.astro.arrays import (
    FloatArray,
    Image,
    IntArray,
    brief,
    check_type,
    checked_deviation,
    finite_array,
    real_number,
    unit_quaternion,
)
from knightcube.astro.earth.sun import J2000, earth_velocity, ephemeris_date
from knightcube.astro.quaternion import attitude_matrix, conjugate, multiply
from knightcube.errors import ArgumentError, InputError
from knightcube.vision.camera.lens import (
    CameraKnowledge,
    CameraModel,
    Pinhole,
    check_camera,
    check_knowledge,
)
from knightcube.vision.frame import Bins, check_detector, checked_exposure, grey_image
from knightcube.vision.frame_job import BIN_SIZES, binned_settings, found_in_image, in_whole_image
from knightcube.vision.lens_knowledge import LensKnowledge
from knightcube.vision.startracker.index import SkyIndex, load_once
from knightcube.vision.startracker.index.build import default_index
from knightcube.vision.startracker.sky_map import ASPECT, Pointing, SkyMap
from knightcube.vision.startracker.solve import (
    AttitudePrior,
    FrameSolution,
    RatePrior,
    SolveSettings,
    SolveStatus,
)
from knightcube.vision.startracker.survey import FrameKind
from knightcube.vision.streaks.streak_result import LikelihoodSettings, StreakStatus

UNKNOWN_FOV_DEG = 4.0, 60.0
"""Range of the field of view (deg) that is searched if the field of view is unknown."""
_LEAST_COARSE_PX = 330
"""Minimum side length (px) of a binned image of an uncalibrated camera."""
FOV_TOLERANCE = 0.05
"""Default uncertainty of a given field of view, as a fraction of the field of view."""
_LEAST_FOV_ERROR = 0.001
"""Minimum uncertainty of a field of view without a calibrated lens, as a fraction of the field of view."""


@dataclass(frozen=True, slots=True, eq=False)
class MatchedStars:
    """Catalogue stars that were identified in an image, in the order of their brightness in the image.

    Attributes:
        hip: Hipparcos numbers (m,) of the stars. For a group of stars that the image does not resolve, `hip`
            is the number of the brightest star.
        magnitude: Johnson V magnitudes (m,), combined for stars that the image does not resolve.
        directions: unit vectors (m, 3) to the stars, ICRS, at the epoch of the image.
        points: measured positions (m, 2) of the stars, x and y, px. The position of a streak is that at
            mid-exposure.
        residuals: measured minus predicted positions of the stars (m, 2), px.
    """

    hip: IntArray
    magnitude: FloatArray
    directions: FloatArray
    points: FloatArray
    residuals: FloatArray

    def __len__(self) -> int:
        return len(self.hip)

    def __repr__(self) -> str:
        """Return the number of stars and the names of the three brightest."""
        names = ", ".join(f"HIP {hip}" for hip in self.hip[:3])
        return f"<MatchedStars: {len(self)} stars{', brightest ' + names if names else ''}>"


@dataclass(frozen=True, slots=True, eq=False)
class StarSolution:
    """The attitude of a camera from one image of the sky, or the reason why the image was not solved.

    A solution is true (`if solution:`) if the image was solved. If the image was not solved, angles,
    quaternion and covariance are NaN, `stars` is empty, and `reason` states the cause.

    Attributes:
        status: outcome: "solved", "no-stars", "too-few-stars", "no-match" or "ambiguous".
        reason: one-sentence reason why the image was not solved. For a solved image, `reason` is empty.
        right_ascension: right ascension of the boresight, ICRS, from 0 to 2 pi, rad.
        declination: declination of the boresight, ICRS, rad.
        roll: position angle of the image's upward direction (-y), north through east, 0 to 2 pi, rad.
        quaternion: attitude (4,) at mid-exposure, scalar last. The quaternion rotates ICRS into camera axes:
            z along the boresight, x to the right along the pixel rows, y down. If `learn` is true, the
            boresight is the pixel of the optical axis of the given camera, so that all images have the same
            axes.
        covariance: covariance (3, 3) of the attitude error as a small rotation in camera axes, rad^2.
        stars: identified catalogue stars.
        field_of_view: angle between the outer edges of the first and last column, without distortion, rad.
            The field of view is fitted to the stars unless the camera is calibrated.
        field_of_view_sigma: standard deviation of the field of view, rad; 0 for a calibrated camera.
        log10_false_alarm: log10 of an upper limit of the probability that random points are solved.
        mirrored: whether the image is a mirror image of the sky. For a mirror image, the attitude refers to
            the image after left and right are swapped.
        rate: angular velocity (3,) of the camera relative to inertial space, in camera axes, rad/s. The rate
            is None unless the stars are streaks and the exposure was given.
        rate_covariance: covariance (3, 3) of `rate`, rad^2/s^2, or None.
        rate_sign_known: whether the sign of `rate` is known. For a global shutter, the sign is known only
            from a predicted rate.
        sky_map: conversion between pixels of the image and ICRS directions, or None if the image was not
            solved.
        frame: all results of the star tracker, including the points that are not catalogue stars. Attitude
            and rate of `frame` are in the axes of `frame.camera`, which is the estimated lens if `learn` is
            true.
        index: sky index (catalogue of guide stars) at the epoch of the image. The star indices in
            `frame.star` refer to `index`.
    """

    status: str
    reason: str
    right_ascension: float
    declination: float
    roll: float
    quaternion: FloatArray
    covariance: FloatArray
    stars: MatchedStars
    field_of_view: float
    field_of_view_sigma: float
    log10_false_alarm: float
    mirrored: bool
    rate: FloatArray | None
    rate_covariance: FloatArray | None
    rate_sign_known: bool
    sky_map: SkyMap | None
    frame: FrameSolution
    index: SkyIndex

    def __bool__(self) -> bool:
        """Return whether the image was solved."""
        return self.frame.fix is not None

    def __repr__(self) -> str:
        """Return one line of text: status, pointing, uncertainty and star count, or reason for failure."""
        if not self:
            return f"<StarSolution {self.status}: {self.reason}>"
        right_ascension, roll = round(self.right_ascension_deg, 4) % 360.0, round(self.roll_deg, 3) % 360.0
        across = 3_600.0 * math.degrees(math.sqrt(max(self.covariance[0, 0], self.covariance[1, 1])))
        return (
            f"<StarSolution {self.status}: right ascension {right_ascension:.4f}, declination "
            f"{self.declination_deg:.4f}, roll {roll:.3f} deg, 1 sigma {across:.2g} arcsec, "
            f"{len(self.stars)} stars{', mirrored' if self.mirrored else ''}>"
        )

    @property
    def right_ascension_deg(self) -> float:
        """The right ascension of the boresight, deg, 0 to 360."""
        return math.degrees(self.right_ascension)

    @property
    def declination_deg(self) -> float:
        """The declination of the boresight, deg."""
        return math.degrees(self.declination)

    @property
    def roll_deg(self) -> float:
        """The position angle of the image's upward direction, from north through east, deg, 0 to 360."""
        return math.degrees(self.roll)

    @property
    def field_of_view_deg(self) -> float:
        """The angle between the outer edges of the first and last column, deg."""
        return math.degrees(self.field_of_view)


class StarTracker:
    """Determines the attitude of a camera from single images of the sky, with or without a prior attitude.

    The star tracker identifies the stars against the Hipparcos catalogue to V 8.5 and fits the attitude to
    their positions in the image. Streaked stars also give the angular velocity. The sky index is built in a
    few seconds at the first use and stored in the user's cache folder.

    Args:
        fov_deg: field of view between the outer edges of the first and last column, from 1 to 120 deg. If
            `fov_deg` is None, fields from 4 to 60 deg are tried.
        fov_error_deg: largest error of `fov_deg`, or of the field of view of `camera`, deg. If
            `fov_error_deg` is None, the error is 5 % of `fov_deg`, or zero for a given `camera`. An error of
            `fov_deg` below 0.1 % is taken as 0.1 %, because the lens is not calibrated.
        camera: calibrated camera (`Pinhole` or `Lens` of `knightcube.vision.camera`) instead of `fov_deg`.
        settings: settings of detection, identification and attitude estimation, or None for the defaults.
        index: a sky index, the path of a sky index file, or None for the default index.
        learn: whether the lens parameters are estimated from the solved images, which must be taken by one
            camera. The attribute `lens` contains the estimated lens parameters. The accuracy of the given
            field of view or camera is `settings.lens`, by default the accuracy of an uncalibrated camera.

    Raises:
        InputError: if a field of view is out of range or given with a camera, or for an unreadable index.

    Source: the overall method follows Michalski, chapter 3; see `knightcube.vision.startracker`.
    """

    def __init__(
        self,
        fov_deg: float | None = None,
        fov_error_deg: float | None = None,
        *,
        camera: CameraModel | None = None,
        settings: SolveSettings | None = None,
        index: SkyIndex | Path | str | None = None,
        learn: bool = False,
    ) -> None:
        if fov_deg is not None and camera is not None:
            raise ArgumentError("fov_deg", "give a field of view or a camera, not both")
        if camera is not None:
            check_camera(camera)
        _check_field_of_view(fov_deg, fov_error_deg)
        if fov_error_deg is not None and fov_deg is None and camera is None:
            raise ArgumentError("fov_error_deg", f"{fov_error_deg!r}: give `fov_deg` or `camera` too")
        self._fov_deg, self._fov_error_deg, self._camera = fov_deg, fov_error_deg, camera
        self._settings = SolveSettings() if settings is None else settings
        check_type("settings", self._settings, SolveSettings)
        check_detector(self._settings.likelihood, LikelihoodSettings)
        if self._settings.lens is not None:
            check_knowledge("settings.lens", self._settings.lens)
        if not isinstance(learn, bool):
            raise ArgumentError("learn", f"{brief(learn)}: give True or False")
        self._learn = learn
        self.lens: LensKnowledge | None = None
        if not isinstance(index, SkyIndex | Path | str | None):
            raise ArgumentError("index", f"{brief(index)}: give a SkyIndex or the path of a sky index file")
        if index is None:
            self._index = default_index()
        else:
            self._index = index if isinstance(index, SkyIndex) else load_once(Path(index))

    def __repr__(self) -> str:
        """Return one line of text: field of view or camera, and whether the lens parameters are estimated."""
        fov = f"{self._fov_deg:g} deg" if self._fov_deg is not None else "unknown"
        lens = f"field of view {fov}" if self._camera is None else repr(self._camera)
        error = "" if self._fov_error_deg is None else f" +- {self._fov_error_deg:g} deg"
        return f"<StarTracker: {lens}{error}{', learns the lens' if self._learn else ''}>"

    def solve(
        self,
        image: Image,
        *,
        exposure: float | None = None,
        utc: datetime | None = None,
        attitude: ArrayLike | None = None,
        attitude_sigma: float = 1e-3,
        rate: ArrayLike | None = None,
        rate_sigma: float = 0.0,
    ) -> StarSolution:
        """Return the attitude at mid-exposure of an image, or the reason why it was not solved.

        Args:
            image: pixel values (rows, columns) of any integer or floating type, 16 x 16 pixels or larger.
                Larger values are brighter. The luminance of a colour image (rows, columns, 3) is used; the
                colours are red, green and blue, and a fourth channel of transparency is ignored.
            exposure: exposure time, s. The exposure time is needed only to determine the rate from streaks,
                or if a rate is predicted.
            utc: date of the image, from 1900 to 2099. A date without a time zone is UTC. The date is used for
                proper motion and for the aberration (at most 20.5") by the Earth's velocity. If `utc` is
                None, the epoch of the index is used, without aberration.
            attitude: predicted attitude (4,) from ICRS to camera axes. Stars are first searched near their
                predicted positions, which is faster than a search of the whole sky. If the search near the
                predicted positions does not succeed, the whole sky is searched.
            attitude_sigma: standard deviation of the predicted attitude about each axis, rad.
            rate: predicted angular velocity (3,), camera axes, rad/s, which determines the sign of a measured
                rate.
            rate_sigma: standard deviation of each component of the predicted rate, rad/s.

        Raises:
            ArgumentError: if the image has another shape, another size than the camera, fewer than 16 x 16
                pixels, masked or non-finite values, or if the value of another argument is not valid.
        """
        image = grey_image(image)
        seconds = 1.0 if exposure is None else checked_exposure(exposure)
        attitudes, rates = _priors(attitude, attitude_sigma, rate, rate_sigma)
        if rates is not None and exposure is None:
            raise ArgumentError("exposure", "None: a predicted rate needs the exposure time in seconds")
        camera, scale = self._camera_for(image.shape)
        if self.lens is not None:
            _check_size(image.shape, self.lens.configured, "the earlier images have")
        sky, settings = self._index, self._settings
        if utc is not None:
            if not isinstance(utc, datetime):
                raise ArgumentError("utc", f"{brief(utc)}: give a datetime, as datetime(2026, 7, 2, 12, 30)")
            date = ephemeris_date("utc", utc)
            sky = sky.at(2000.0 + (date - J2000) / 365.25)
            settings = replace(settings, velocity=earth_velocity(date))
        if self._learn and self.lens is None:
            self.lens = self._described(camera, scale)
        found = found_in_image(image, camera, scale, seconds, sky, settings, attitudes, rates, self.lens)
        self.lens, frame = found.lens, found.solution
        assert frame is not None  # the job contains the settings of the star tracker
        few = (frame.fix is None and not frame.torn) or frame.faint
        if few and exposure is None and self._camera is None and not self._learn:
            coarse = self._solved_coarser(image, sky, settings)
            if coarse is not None and (coarse.torn or len(coarse.matched) >= len(frame.matched)):
                frame = coarse
        if frame.status is SolveStatus.NO_MATCH and scale[0] < scale[1]:
            low, high = (math.degrees(field_of_view(camera.rescaled(1.0 / limit))) for limit in scale)
            searched = f"fields of view of {low:.3g} to {high:.3g} deg were searched"
            frame = replace(frame, reason=f"{frame.reason}; {searched}")
        solution = _solution(frame, sky, settings.velocity, exposure is not None)
        return solution if found.turn is None or not solution else _turned(solution, conjugate(found.turn))

    def _solved_coarser(self, image: Image, sky: SkyIndex, settings: SolveSettings) -> FrameSolution | None:
        """Return the solution of a large image after binning, or None if no binned image is solved or torn.

        The stars of large photographs are often several pixels wide. Compression or interpolation correlates
        the noise of neighbouring pixels, so that the computed uncertainties are too small.
        """
        for size in BIN_SIZES:
            bins = Bins.centred(image.shape, size)
            if bins is None or min(image.shape) < _LEAST_COARSE_PX * size:
                return None
            coarse = bins.sums(image)
            camera, scale = camera_of_field(self._fov_deg, self._fov_error_deg, coarse.shape)
            binned = binned_settings(settings, size)
            found = found_in_image(coarse, camera, scale, 1.0, sky, binned).solution
            if found is None or found.kind is not FrameKind.POINTS:
                continue
            if found.fix is not None or found.torn:
                return in_whole_image(found, bins, image.shape)
        return None

    def _described(self, camera: CameraModel, scale: tuple[float, float]) -> LensKnowledge:
        """Return the lens parameters and their uncertainties before the first image."""
        accuracy, shutter = self._settings.lens or CameraKnowledge(), self._settings.likelihood
        return LensKnowledge.of(
            camera,
            accuracy,
            scale_error=scale[1] - 1.0,
            line_time=shutter.line_time,
            psf_sigma=shutter.psf_sigma,
        )

    def _camera_for(self, shape: tuple[int, ...]) -> tuple[CameraModel, tuple[float, float]]:
        """Return the camera for an image of `shape`, and the limits of its scale (see `camera_of_field`)."""
        camera = self._camera
        if camera is None:
            return camera_of_field(self._fov_deg, self._fov_error_deg, shape)
        _check_size(shape, camera, "the camera has")
        if not self._fov_error_deg:
            return camera, (1.0, 1.0)
        middle, scale = camera_of_field(math.degrees(field_of_view(camera)), self._fov_error_deg, shape)
        ratio = camera.focal_length / middle.focal_length
        return camera, (scale[0] * ratio, scale[1] * ratio)


def _check_size(shape: tuple[int, ...], camera: CameraModel, owner: str) -> None:
    """Raise ArgumentError unless an image of `shape` has the size of `camera`.

    The text `owner` stands before the expected size in the message.
    """
    if shape != (camera.rows, camera.columns):
        raise ArgumentError(
            "image",
            f"{shape[1]} x {shape[0]} pixels, but {owner} {camera.columns} x {camera.rows}: give images of "
            "one camera, or make a StarTracker for the camera of these images",
        )


def field_of_view(camera: CameraModel) -> float:
    """Return the undistorted field of view (rad) between the outer edges of the first and last column."""
    return 2.0 * math.atan(0.5 * camera.columns / camera.focal_length)


def camera_of_field(
    fov_deg: float | None, error_deg: float | None, shape: tuple[int, ...]
) -> tuple[Pinhole, tuple[float, float]]:
    """Return a pinhole camera for a field of view, and the lowest and highest possible scale.

    The scale is the ratio of the true tangents of field angles to those of the returned camera. If the field
    of view `fov_deg`, deg across the columns, is None, the range `UNKNOWN_FOV_DEG` is used. If the largest
    error `error_deg`, deg, is None, 5 % of the field of view is used. An error below 0.1 % of the field of
    view is taken as 0.1 %. Raises InputError unless the field of view is 1 to 120 deg.
    """
    _check_field_of_view(fov_deg, error_deg)
    lowest, highest = UNKNOWN_FOV_DEG
    if fov_deg is not None:
        error = FOV_TOLERANCE * fov_deg if error_deg is None else max(error_deg, _LEAST_FOV_ERROR * fov_deg)
        lowest, highest = max(fov_deg - error, 0.5), min(fov_deg + error, 125.0)
    tangents = [math.tan(0.5 * math.radians(angle)) for angle in (lowest, highest)]
    middle = math.sqrt(tangents[0] * tangents[1])
    camera = Pinhole(shape[1], shape[0], 0.5 * shape[1] / middle)
    return camera, (tangents[0] / middle, tangents[1] / middle)


def _priors(
    attitude: ArrayLike | None, attitude_sigma: float, rate: ArrayLike | None, rate_sigma: float
) -> tuple[AttitudePrior | None, RatePrior | None]:
    """Return the predicted attitude and rate. Raises ArgumentError for a value that is not possible."""
    attitudes = rates = None
    attitude_sigma = checked_deviation("attitude_sigma", attitude_sigma, "rad")
    rate_sigma = checked_deviation("rate_sigma", rate_sigma, "rad/s")
    if attitude is not None:
        quaternion = unit_quaternion("attitude", attitude)
        # An uncertainty of half a turn or more leaves every attitude possible.
        attitudes = AttitudePrior(quaternion, attitude_sigma) if attitude_sigma < math.pi else None
    if rate is not None:
        rates = RatePrior(finite_array("rate", rate, (3,)), rate_sigma)
    return attitudes, rates


def _check_field_of_view(fov_deg: float | None, error_deg: float | None) -> None:
    """Raise InputError unless the field of view is 1 to 120 deg and its error is 0 or more, below 120 deg."""
    if fov_deg is not None and not 1.0 <= real_number(fov_deg) <= 120.0:
        raise InputError("field of view", f"{fov_deg!r}: give 1 to 120 degrees across the columns")
    if error_deg is not None and not 0.0 <= real_number(error_deg) < 120.0:
        raise InputError("error of the field of view", f"{error_deg!r}: give 0 or more degrees, below 120")


def _turned(solution: StarSolution, back: FloatArray) -> StarSolution:
    """Return a solution after rotation by `back` (4,) from the estimated lens's axes to the given camera's.

    The axes of the estimated lens change from image to image, whereas those of the given camera are fixed.
    """
    matrix, quaternion = attitude_matrix(back), multiply(back, solution.quaternion)
    pointing, rates = Pointing.of(quaternion), solution.rate_covariance
    return replace(
        solution,
        right_ascension=pointing.right_ascension,
        declination=pointing.declination,
        roll=pointing.roll,
        quaternion=quaternion if quaternion[3] >= 0.0 else -quaternion,
        covariance=matrix @ solution.covariance @ matrix.T,
        rate=None if solution.rate is None else matrix @ solution.rate,
        rate_covariance=None if rates is None else matrix @ rates @ matrix.T,
    )


def _solution(
    frame: FrameSolution, sky: SkyIndex, velocity: FloatArray | None, exposure_known: bool
) -> StarSolution:
    """Return the public solution (`StarSolution`) from the results of a frame."""
    fix, matched, motion = frame.fix, frame.matched, frame.motion
    pointing = Pointing(math.nan, math.nan, math.nan) if fix is None else Pointing.of(fix.quaternion)
    if fix is None:
        matched = matched[:0]
    # If pixels are not square, the focal length along y differs from the focal length along x.
    camera = frame.camera.rescaled(1.0 / (1.0 + float(frame.bend[ASPECT])))
    fov = math.nan if fix is None else field_of_view(camera)
    star = frame.star[matched]
    measured = motion if exposure_known else None
    return StarSolution(
        status=frame.status.value,
        reason=frame.reason,
        right_ascension=pointing.right_ascension,
        declination=pointing.declination,
        roll=pointing.roll,
        quaternion=np.full(4, np.nan) if fix is None else fix.quaternion,
        covariance=np.full((3, 3), np.nan) if fix is None else fix.covariance,
        stars=MatchedStars(
            sky.stars.hip[star].astype(np.int64),
            np.asarray(sky.stars.magnitude[star], dtype=np.float64),
            sky.stars.direction[star],
            frame.points[matched],
            frame.points[matched] - frame.expected[matched],
        ),
        field_of_view=fov,
        field_of_view_sigma=math.sin(fov) * frame.scale_sigma,
        log10_false_alarm=frame.log10_false_alarm,
        mirrored=frame.mirrored,
        rate=None if measured is None else measured.rate,
        rate_covariance=None if measured is None else measured.covariance,
        rate_sign_known=motion is not None and motion.status is StreakStatus.RATE,
        sky_map=frame.sky_map(velocity),
        frame=frame,
        index=sky,
    )
