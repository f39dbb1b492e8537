"""Coarse attitude from solar cells and magnetic field, and from the horizon cameras.

The measured directions start the attitude filter without a star fix, and update it until star fixes make the
estimate accurate.

The covariance of an attitude from magnetic field and solar cells (`FieldAndStrings`) includes every rotation
that is possible if any one cell has failed. Errors of solar cells, lenses and the assumed height of the limb
may last for minutes. A measurement is therefore used only if it is more accurate than the estimate, so that
repeated measurements do not make the filter overconfident. If several consecutive measurements contradict an
estimate that no star fix has made accurate, the filter is restarted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from flight.bodies.orbit.environment import EstimatedEnvironment
from flight.bodies.orbit.filter import OrbitFilter
from flight.schema.devices import WideCamera, camera_model, structure_mask
from hal.interfaces.devices import Frame, StringReading
from hal.interfaces.wires import SECOND_NS
from knightcube.astro import chi_square
from knightcube.astro.arrays import FloatArray, tangent_basis
from knightcube.astro.attitude.solvers import VectorObservation, field_observation, weighted_fit
from knightcube.astro.attitude.wahba import AttitudeError
from knightcube.astro.quaternion import attitude_matrix, conjugate, multiply, to_rotation_vector
from knightcube.errors import UsageError
from knightcube.gnc.estimation.estimate import ATTITUDE, AttitudeMeasurement, DirectionMeasurement, Knowledge
from knightcube.gnc.estimation.free_filter import FilterEnvironment
from knightcube.vision.camera.lens import MountedCamera
from knightcube.vision.horizon.settings import (
    HorizonKnowledge,
    LogarithmicResponse,
    RoughAttitude,
    SensedDirection,
)
from knightcube.vision.horizon_camera_job import HorizonCameraJob, HorizonCameraResult, StructureMap
from knightcube.vision.solar_cells import FieldAndStrings, KnownDirections, SolarStringModel, StringFix

PERIOD_NS = 5 * SECOND_NS
"""Shortest interval (ns) between the solar cell readings that are checked. Readings at shorter intervals have
correlated errors."""
OVERHEAD_ALBEDO = 0.2
"""Irradiance of a cell by the fully lit Earth at an albedo of 0.3, as a fraction of sunlight."""
CLOUDS = 0.5
"""Relative variation of the Earth's irradiance due to clouds."""
LEAST_ALBEDO = 0.02
STUCK = 3
"""Number of consecutive identical solar cell readings that indicate a fault. Readings of working cells differ
by noise."""
SUNLIT = 0.99
"""Visible fraction of the solar disc above which the solar cells are expected to measure the Sun."""
CONTRADICTED = 3
"""Number of consecutive contradicting measurements after which a coarse estimate is discarded."""
GATE = 30.7
"""Chi-square threshold (3 degrees of freedom, false alarm probability 1e-6) above which a measured attitude
contradicts the estimate."""
START_SIGMA = np.radians(5.0)
"""Largest standard deviation (rad) of the rotation about the field direction at which the filter starts."""
STRENGTH_SIGMA = 5.0
"""Largest accepted deviation of the measured field strength from the model, in standard deviations."""


class CoarseSunFeed:
    """Determines the attitude from the magnetic field and the solar cells, and passes it to the filter."""

    def __init__(
        self,
        strings: SolarStringModel,
        period_ns: int,
        filter_: OrbitFilter,
        environment: EstimatedEnvironment,
    ) -> None:
        """All cells are read one after another within `period_ns` ns."""
        self.strings = strings
        self.newest: StringReading | None = None
        self._turns = FieldAndStrings(strings)
        self._period_ns, self._filter, self._environment = period_ns, filter_, environment
        self._judged_ns = -PERIOD_NS
        self._against = 0
        self._last: list[float] = []
        self._same = 0

    def accept(self, reading: StringReading) -> str | None:
        """Accept a reading, and return its fault: "" for a valid reading, None for an unchecked reading."""
        self.newest = reading
        time_ns = reading.time_ns - self._period_ns // 2
        around, sun = self._environment.at(time_ns), self._environment.sun(time_ns)
        if around is None or sun is None or around.sunlit < SUNLIT:
            return None
        currents = reading.currents.tolist()
        self._same, self._last = (self._same + 1 if currents == self._last else 0), currents
        if self._same >= STUCK:
            return "the strings give the same currents in every reading"
        if time_ns - self._judged_ns < PERIOD_NS:
            return None
        measured_field = self._filter.newest_field()
        turned = None if measured_field is None else self._filter.turned(measured_field[0].time_ns, time_ns)
        if measured_field is None or turned is None:
            return None
        since_ns, self._judged_ns = self._judged_ns, time_ns
        rotation = self._filter.turned(since_ns, time_ns)
        if rotation is None:
            self._turns.forget()
        else:
            self._turns.turn(rotation, (time_ns - since_ns) / SECOND_NS)
        (field, gyro), sky = measured_field, _sky(around, sun)
        seen = attitude_matrix(turned) @ field.field
        sigma = float(np.sqrt(field.covariance[0, 0]))
        excess = float(np.linalg.norm(seen) - np.linalg.norm(sky.field))
        if abs(excess) > STRENGTH_SIGMA * sigma:
            self._turns.forget()
            return f"the measured field differs from its model by {excess * 1e6:+.1f} uT: no attitude"
        # The body rotates while the cells are read one after another.
        blur = float(np.linalg.norm(gyro)) * self._period_ns / SECOND_NS / np.sqrt(12.0)
        fix = self._turns.accept(reading.currents, seen, sigma, sky, blur)
        if fix is not None and self._filter.knowledge is not Knowledge.FINE:
            self._use(time_ns, fix, sun)
        return self._turns.wrong

    def _use(self, time_ns: int, fix: StringFix, sun: FloatArray) -> None:
        """Start the filter from an attitude fix, or update it with the Sun direction of the fix."""
        if not self._filter.runs or self._against >= CONTRADICTED:
            doubted, self._against = self._against >= CONTRADICTED, 0
            if fix.about <= START_SIGMA:
                attitude = AttitudeMeasurement(time_ns, fix.quaternion, fix.covariance)
                self._filter.begin(attitude, doubted=doubted)
            return
        then = self._filter.past(time_ns)
        if then is None:  # the filter started after the reading was taken
            return
        claim = then.covariance[ATTITUDE, ATTITUDE]
        off = to_rotation_vector(multiply(fix.quaternion, conjugate(then.quaternion)))
        contradicts = float(off @ np.linalg.solve(claim + fix.covariance, off)) > GATE
        self._against = self._against + 1 if contradicts else 0
        if not contradicts and float(fix.axis @ claim @ fix.axis) > fix.about**2:
            seen = attitude_matrix(fix.quaternion) @ sun
            covariance = fix.about**2 * np.eye(3)
            self._filter.measure_late([DirectionMeasurement(time_ns, seen, sun, covariance)], lambda _: None)


def _sky(around: FilterEnvironment, sun: FloatArray) -> KnownDirections:
    """Return the directions of field, Sun and nadir, and the Earth's irradiance with its uncertainty."""
    up = around.position / np.linalg.norm(around.position)
    light = OVERHEAD_ALBEDO * max(float(sun @ up), 0.0) + LEAST_ALBEDO
    return KnownDirections(around.field, sun, -up, light, CLOUDS * light)


DIRECTIONS_START_SIGMA = math.radians(15.0)
"""Largest standard deviation (rad), about the worst axis, of an attitude that may start the filter."""
NEEDED_SIGMA = math.radians(0.05)
"""Attitude standard deviation (rad), about the worst axis, above which the horizon cameras are used."""
ROUGH_SIGMA = 0.3
"""Largest standard deviation (rad) of an attitude that is used as a prior in the search for the horizon."""
IMPROBABLE = 1e-6
"""Probability that the gate rejects directions that are consistent with one attitude."""
STRINGS_AGE_NS = 2 * SECOND_NS
FIELD_SIGMA = 0.03
"""Lower bound (rad) of the standard deviation of the field direction in the search for the horizon."""


Sight = VectorObservation | None
Compare = Callable[[int, Sight, Sight, Sight], None]
"""Callback that runs the compared methods; its arguments are a time (ns) and the Sun, nadir and field
directions."""


class HorizonCameraFeed:
    """Updates the filter from the horizon cameras; implements `flight.loop.body.HorizonCameraUse`."""

    def __init__(
        self,
        cameras: Sequence[MountedCamera],
        lens_error: float,
        filter_: OrbitFilter,
        environment: EstimatedEnvironment,
        sun: CoarseSunFeed | None,
        response: LogarithmicResponse | None,
        structure: Mapping[int, StructureMap],
    ) -> None:
        """Update `filter_` from frames of the given cameras.

        The residual lens error after calibration is `lens_error` (rad per axis). The object `sun` holds the
        newest reading of the solar cells. The intensity response of all cameras is `response`, or linear if
        None is given. For each camera index, `structure` contains a map of the part of the image that the
        spacecraft covers.
        """
        self._cameras = tuple(cameras)
        self._lens = lens_error**2 * np.eye(3)
        self._filter, self._environment, self._sun = filter_, environment, sun
        self._response = response
        self._structure = dict(structure)
        self._against = 0
        self.compare: Compare | None = None
        self.earth_only: frozenset[int] = frozenset()

    @property
    def needed(self) -> bool:
        """Whether horizon frames are needed; in eclipse, they are used only while the attitude is lost."""
        if self._filter.worst_sigma <= NEEDED_SIGMA:
            return False
        around = self._environment.at(self._filter.measured_ns)
        dark = around is not None and around.sunlit <= 0.0
        return not dark or self._filter.knowledge is Knowledge.LOST

    def job(self, frames: Mapping[int, Frame]) -> HorizonCameraJob:
        """Return the worker's job for simultaneous frames, with the prior knowledge at the exposures."""
        times = [frame.exposure_start_ns + frame.exposure_ns // 2 for frame in frames.values()]
        time_ns = sum(times) // len(times)
        pixels = {number: frame.pixels for number, frame in frames.items()}
        return HorizonCameraJob(
            pixels,
            self._cameras,
            self._known(time_ns),
            self._strings(time_ns),
            self._response,
            self._structure,
            self.earth_only,
        )

    def accept(self, time_ns: int, found: HorizonCameraResult) -> tuple[bool, bool]:
        """Start or update the filter with the directions; return whether Sun and nadir were used."""
        self._structure |= found.structure
        around, sun = self._environment.at(time_ns), self._environment.sun(time_ns)
        if around is None or sun is None:
            return False, False
        down = -around.position / np.linalg.norm(around.position)
        seen = [
            None if one is None else VectorObservation(one.direction, reference, one.covariance + self._lens)
            for one, reference in ((found.sun, sun), (found.nadir, down))
        ]
        if self.compare is not None:
            self.compare(time_ns, seen[0], seen[1], self._field_sight(time_ns))
        of_cells = found.sun is not None and not found.sun.cameras
        if not self._filter.runs or self._against >= CONTRADICTED:
            first, nadir = seen
            if first is not None and not of_cells:
                # To the error of its first attitude, the filter itself adds only the misalignment of the
                # cameras that measure nadir.
                first = replace(first, covariance=first.covariance + self._filter.sun_misalignment)
            began = self._begin(time_ns, [one for one in (first, nadir) if one is not None])
            return began and first is not None, began and nadir is not None
        then = self._filter.past(time_ns)
        if then is None:
            return False, False
        # A Sun direction that comes from the solar cells alone is used by `CoarseSunFeed` instead.
        mine = [None if of_cells else seen[0], seen[1]]
        claim, turn = then.covariance[ATTITUDE, ATTITUDE], attitude_matrix(then.quaternion)
        refused = [one is not None and _contradicts(one, turn, claim) for one in mine]
        # Count consecutive measurements that contradict a coarse estimate.
        if self._filter.knowledge is Knowledge.FINE:
            self._against = 0
        elif any(one is not None for one in mine):
            self._against = self._against + 1 if any(refused) else 0
        sun_used, nadir_used = (
            one is not None and not against and _says_more(one, claim) and self._use(time_ns, one, cameras)
            for one, against, cameras in zip(
                mine, refused, (0 if found.sun is None else found.sun.mask, 0), strict=True
            )
        )
        return sun_used, nadir_used

    def _begin(self, time_ns: int, seen: list[VectorObservation]) -> bool:
        """Start the filter if the directions agree and determine an attitude; return whether it started."""
        field = self._field_sight(time_ns)
        sights = seen if field is None else [*seen, field]
        if not seen or len(sights) < 2:
            return False
        try:
            fix = weighted_fit(sights)
        except (AttitudeError, np.linalg.LinAlgError):
            return False
        if 2.0 * fix.loss > chi_square.bound(IMPROBABLE, 2 * len(sights) - 3):
            return False
        if math.sqrt(float(np.linalg.eigvalsh(fix.covariance)[-1])) > DIRECTIONS_START_SIGMA:
            return False
        doubted, self._against = self._against >= CONTRADICTED, 0
        attitude = AttitudeMeasurement(time_ns, fix.quaternion, fix.covariance)
        return self._filter.begin(attitude, doubted=doubted)

    def _use(self, time_ns: int, sight: VectorObservation, sun_cameras: int) -> bool:
        seen = sight.observed, sight.reference, sight.covariance
        measured = DirectionMeasurement(time_ns, *seen, sun_cameras)
        taken: list[bool] = []
        self._filter.measure_late([measured], taken.extend)
        return any(taken)

    def _field_sight(self, time_ns: int) -> VectorObservation | None:
        """Return the magnetic field direction at a time, or None if it was not measured recently."""
        measured_field = self._filter.newest_field()
        turned = None if measured_field is None else self._filter.turned(measured_field[0].time_ns, time_ns)
        around = self._environment.at(time_ns)
        if measured_field is None or turned is None or around is None:
            return None
        try:
            return field_observation(
                attitude_matrix(turned) @ measured_field[0].field, around.field, measured_field[0].covariance
            )
        except AttitudeError:
            return None

    def _known(self, time_ns: int) -> HorizonKnowledge:
        """Return the prior knowledge of position, Sun, field and attitude at a time."""
        around, sun = self._environment.at(time_ns), self._environment.sun(time_ns)
        if around is None or sun is None:
            return HorizonKnowledge()
        field = self._field_sight(time_ns)
        sensed: tuple[SensedDirection, ...] = ()
        if field is not None:
            sensed = (SensedDirection(field.observed, field.reference, math.hypot(field.sigma, FIELD_SIGMA)),)
        then, rough = self._filter.past(time_ns) if self._filter.runs else None, None
        if then is not None:
            sigma = math.sqrt(max(float(np.linalg.eigvalsh(then.covariance[ATTITUDE, ATTITUDE])[-1]), 0.0))
            rough = RoughAttitude(then.quaternion, sigma) if sigma < ROUGH_SIGMA else None
        return HorizonKnowledge(position=around.position, sun=sun, attitude=rough, sensed=sensed)

    def _strings(self, time_ns: int) -> tuple[SolarStringModel, FloatArray] | None:
        newest = None if self._sun is None else self._sun.newest
        if self._sun is None or newest is None or abs(newest.time_ns - time_ns) > STRINGS_AGE_NS:
            return None
        return self._sun.strings, newest.currents


def horizon_camera_feed(
    sections: Sequence[WideCamera],
    filter_: OrbitFilter,
    environment: EstimatedEnvironment,
    sun: CoarseSunFeed | None,
) -> HorizonCameraFeed:
    """Return the horizon camera feed of a configuration.

    An unusable structure file, which `knightcube check` reports, does not prevent the flight.
    """
    cameras = [MountedCamera(camera_model(one), np.array(one.mounting)) for one in sections]
    error = math.radians(max(one.lens_error_deg for one in sections))
    first, response = sections[0], None
    if first.response == "logarithmic":
        response = LogarithmicResponse(first.pedestal, first.counts_per_decade())
    structure = {}
    for number, one in enumerate(sections):
        try:
            mask = structure_mask(one)
        except UsageError:
            mask = structure_mask(one, of_file=False)
        structure[number] = StructureMap.of(mask)
    feed = HorizonCameraFeed(cameras, error, filter_, environment, sun, response, structure)
    feed.earth_only = frozenset(number for number, one in enumerate(sections) if not one.sun)
    return feed


def _spread(
    sight: VectorObservation, turn: FloatArray, claim: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the deviation (2,) of a direction from its prediction, and the two covariances (2, 2)."""
    expected = turn @ sight.reference
    across = tangent_basis(expected)
    # A small rotation e changes a direction d by the cross product d x e.
    rows = across @ np.cross(expected, np.eye(3)).T
    return across @ sight.observed, across @ sight.covariance @ across.T, rows @ claim @ rows.T


def _contradicts(sight: VectorObservation, turn: FloatArray, claim: FloatArray) -> bool:
    """Return whether a direction contradicts an attitude matrix (3, 3) with covariance `claim` (3, 3)."""
    off, own, known = _spread(sight, turn, claim)
    behind = float(sight.observed @ turn @ sight.reference) < 0.0
    return behind or float(off @ np.linalg.solve(own + known, off)) > chi_square.bound(IMPROBABLE, 2)


def _says_more(sight: VectorObservation, claim: FloatArray) -> bool:
    """Return whether a direction improves an attitude with the covariance `claim` (3, 3) about some axis."""
    across = tangent_basis(sight.observed)
    rows = across @ np.cross(sight.observed, np.eye(3)).T
    known, own = rows @ claim @ rows.T, across @ sight.covariance @ across.T
    return float(np.linalg.eigvals(np.linalg.solve(own, known)).real.max()) > 1.0
