"""The planner's job of a satellite: from an orbit, an attitude and a target to a table of the pointing law.

The field and the torques are predicted along the orbit for a revolution and a quarter, which the last gains
that are kept need as preview; a third of a revolution is kept. An object that passes is gone within minutes:
its tables are short and fine, and made again with each sighting.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.disturbance import box_areas, pressures
from knightcube.astro.earth.ephemeris import Ephemeris, predict
from knightcube.astro.earth.orbit_knowledge import OrbitState
from knightcube.astro.quaternion import angle_between, attitude_matrix, from_rotation_vector, multiply
from knightcube.gnc.control.three_axes.pointing_table import (
    Ahead,
    PointingTable,
    PointingWeights,
    pointing_table,
)
from knightcube.gnc.control.three_axes.slew_table import SlewBegin, SlewWish, slew, slew_table
from knightcube.gnc.guidance.three_axes.attitude_law import (
    Attitudes,
    approach,
    following,
    references,
)
from knightcube.gnc.guidance.three_axes.pointing_target import PointingTarget
from knightcube.gnc.guidance.three_axes.target_law import BodyAxes, law_of


@dataclass(frozen=True, slots=True)
class Span:
    """How far is predicted, how much of the table is kept, and its step, s."""

    preview: float
    kept: float
    step: float


STEADY, PASSING = Span(7_200.0, 1_800.0, 10.0), Span(120.0, 60.0, 2.0)
"""Spans of the goals that go on, and of an object that passes."""
LEAD = 2.0
"""s from the state to the begin of the table."""
FAR = math.radians(15.0)
"""rad off the law: from farther the way into it is a slew of least heat, where one is wished."""
WAY = 4.0
"""Time scales of the law that a first guess of the way takes; the path found does not depend on it."""


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """An object's `direction` (3,) at `since` s after a job's origin, ICRS.

    `velocity` (3,) 1/s: of its place relative to ours, over its distance; zero for a place to look at.
    """

    direction: FloatArray
    velocity: FloatArray
    since: float

    @property
    def span(self) -> Span:
        """The span of its tables."""
        return PASSING if self.velocity.any() else STEADY


@dataclass(frozen=True, slots=True, eq=False)
class PointingJob:
    """A job: the orbit's state, attitude (4,) and rate (3,) rad/s at `origin_ns`, ICRS and body axes.

    `inertia` (3, 3) kg m^2, `sizes` (9,) N m of the torques, `limit` A m^2 of a coil in the mean. Without
    `slew` the path is that of the weights alone. With a `sight` that is pointed to, whatever the target.
    """

    number: int
    origin_ns: int
    orbit: OrbitState
    inertia: FloatArray
    axes: BodyAxes
    weights: PointingWeights
    target: PointingTarget
    quaternion: FloatArray
    rate: FloatArray
    sizes: FloatArray
    limit: float
    slew: SlewWish | None = None
    sight: Sight | None = None

    @property
    def span(self) -> Span:
        """The span of the table."""
        return STEADY if self.sight is None else self.sight.span


def prepare() -> None:
    """Import what plans slews; the worker does so before its first job."""
    from scipy.linalg import lapack  # noqa: F401, PLC0415 - the control process names the job, and needs none


def run(job: PointingJob) -> PointingTable:
    """Return the table, its times in s after the origin; takes a second, two from far off.

    Raises FlightError where the field is not known, UsageError where the law has no attitude.
    """
    span = job.span
    ahead = predict(job.orbit, span.preview + 4.0 * STEADY.step)
    times = np.arange(LEAD, span.preview, span.step)
    kept = round(span.kept / span.step)
    quaternion = multiply(from_rotation_vector(LEAD * job.rate), job.quaternion)
    law = _law(job, quaternion, ahead)
    field, wanted = ahead.field_at(times), references(law, ahead, times)
    way = approach(law, quaternion, job.rate, LEAD, LEAD + _seconds(job, field))
    found = Ahead(
        wanted,
        references(way, ahead, times[: kept + 1]),
        field,
        ahead.position_at(times),
        pressures(ahead, times).facing(box_areas(job.inertia), attitude_matrix(wanted.quaternion)),
        job.sizes,
    )
    wish = job.slew
    if wish is not None and float(angle_between(quaternion, wanted.quaternion[0])) > FAR:
        begin = SlewBegin(quaternion, job.rate, times, kept, job.inertia, job.limit, job.sizes)
        path = slew(begin, wish, job.target, job.axes, ahead, job.weights.fastest)
        if path is not None:
            return slew_table(begin, path, wish.residual, job.target, job.axes, ahead, found, job.weights)
    return pointing_table(found, job.inertia, job.limit, job.weights)


def _law(job: PointingJob, quaternion: FloatArray, ahead: Ephemeris) -> Attitudes:
    """Return the law of a job from an attitude (4,) on."""
    sight, axis = job.sight, job.axes.pointing
    if sight is None:
        return law_of(job.target, job.axes, quaternion, ahead, LEAD)
    return following(axis, sight.direction, sight.velocity, sight.since, quaternion).attitudes


def _seconds(job: PointingJob, field: FloatArray) -> float:
    """Return how long a first guess of the way takes, s: WAY of the time scale that the weights give."""
    strength, inertia = float(np.mean(np.linalg.norm(field, axis=1))), float(np.diag(job.inertia).max())
    square = strength * job.weights.dipole / (inertia * job.weights.turn)
    return min(max(WAY / math.sqrt(square), 10.0 * job.span.step), job.span.kept)
