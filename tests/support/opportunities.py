"""Times at which a camera in orbit can observe a space object (Sease ch. 4, Table 4.3).

    scenario = table_4_3(epoch=2_461_041.5)
    for opportunity in opportunities(scenario, cadence=60.0, exposure=0.5):
        times, attitudes = exposure_attitudes(scenario, opportunity.start, 0.5)

An object is observable if it is in the field of view, in sunlight and not behind the Earth, and if neither
the Sun nor the Earth is in the field of view.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from hal.interfaces.errors import OutOfRange
from knightcube.astro import quaternion
from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.astro.earth.sun import DAY, Shadow, sunlit_share
from knightcube.vision.camera.lens import Pinhole
from sim_hal.star_camera.objects import ResidentSpaceObject, directions, hidden_by_earth
from sim_hal.worlds.orbit import KeplerianElements, Orbit, propagate, sun_position
from tests.support.exclusion import boresights, earth_in_field, in_field, sun_in_field

DEVICE = "observation opportunities"
ORBITS = 10

Attitude = Callable[[FloatArray], FloatArray]
"""Function from times (m,), s, to camera attitudes (m, 4), ICRS to camera."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Scenario:
    """A camera, the objects that it may observe, and its exclusion angles.

    Attributes:
        epoch: Julian date TT of time 0.
        duration: duration, s.
        camera: orbit of the camera.
        attitude: attitude of the camera over time.
        pinhole: geometry of the camera.
        objects: orbits of the objects.
        half_angle: half angle (rad) of the cone about the boresight in which Sun and Earth exclude a frame.
        buffer: additional angle (rad) for stray light past the baffle.
        shadow: conical or cylindrical.
    """

    epoch: float
    duration: float
    camera: Orbit
    attitude: Attitude
    pinhole: Pinhole
    objects: Sequence[ResidentSpaceObject]
    half_angle: float
    buffer: float = 0.0
    shadow: Shadow = "conical"


@dataclass(frozen=True, slots=True)
class Window:
    """Interval from `start` to `end` (s) in which object number `index` is observable."""

    index: int
    start: float
    end: float


@dataclass(frozen=True, slots=True)
class Opportunity:
    """A frame that shows object number `index` during the whole exposure.

    Attributes:
        index: number of the object in the scenario.
        start: start of the exposure, s.
        first: pixel (x, y) of the object at the start of the exposure.
        last: pixel (x, y) of the object at the end of the exposure.
        distance: distance (m) from the camera at mid-exposure.
    """

    index: int
    start: float
    first: tuple[float, float] = field(compare=False)
    last: tuple[float, float] = field(compare=False)
    distance: float = field(compare=False)


def constant_slew(rate: FloatArray, initial: FloatArray = quaternion.IDENTITY) -> Attitude:
    """Return the attitude of a camera that rotates from `initial` (4,) at a constant `rate` (3,), rad/s."""

    def attitude(times: FloatArray) -> FloatArray:
        turn = np.asarray(times, dtype=float)[:, None] * np.asarray(rate, dtype=float)
        return quaternion.multiply(quaternion.from_rotation_vector(turn), initial)

    return attitude


def table_4_3(
    epoch: float,
    magnitude: float = 4.0,
    pinhole: Pinhole | None = None,
    half_angle: float | None = None,
) -> Scenario:
    """Return the ten orbits of Table 4.3 of the thesis. The camera rotates at 0.05 rad/s about its y axis.

    The initial attitude is the identity. The thesis states neither a date nor the interval of the frames, so
    `epoch` (Julian date TT) determines the position of the Sun. By default, `pinhole` has 1024 x 1024 pixels
    over 20 degrees, and `half_angle` is its half diagonal. The thesis uses half the field of view (2.17,
    2.19). The scenario lasts ten orbits of the camera, 15.3 h. The text of the thesis states "approximately
    14".
    """
    pinhole = pinhole or Pinhole.from_field_of_view(1024, 1024, math.radians(20.0))
    camera = KeplerianElements(semi_major_axis=6748e3, inclination=math.radians(28.5))
    spacecraft = KeplerianElements(
        semi_major_axis=7078e3,
        inclination=math.radians(89.0),
        argument_of_perigee=math.radians(30.0),
        true_anomaly=math.radians(120.0),
    )
    duration = ORBITS * camera.period
    return Scenario(
        epoch=epoch,
        duration=duration,
        camera=propagate(camera, duration),
        attitude=constant_slew(np.array([0.0, 0.05, 0.0])),
        pinhole=pinhole,
        objects=[ResidentSpaceObject(propagate(spacecraft, duration), magnitude)],
        half_angle=pinhole.half_diagonal if half_angle is None else half_angle,
    )


def exposure_attitudes(
    scenario: Scenario, start: float, exposure: float, step: float = 0.01
) -> tuple[FloatArray, FloatArray]:
    """Return times (k,), s, at most `step` s apart, and the attitudes (k, 4) of an exposure."""
    times = np.linspace(start, start + exposure, max(2, math.ceil(exposure / step) + 1))
    return times, scenario.attitude(times)


def observable(scenario: Scenario, index: int, times: FloatArray) -> BoolArray:
    """Return whether object `index` is observable at `times` (m,), lit by at least half of the Sun."""
    camera = scenario.camera.positions_at(times)
    position = scenario.objects[index].orbit.positions_at(times)
    attitudes = scenario.attitude(times)
    good = in_field(scenario.pinhole, attitudes, directions(camera, position))
    # The slower tests are made only at the few times that passed all faster tests.
    left = np.flatnonzero(good)
    camera, position, boresight = camera[left], position[left], boresights(attitudes[left])
    sun_at = sun_position(scenario.epoch + np.asarray(times)[left] / DAY)
    excluded = sun_in_field(boresight, camera, sun_at, scenario.half_angle, scenario.buffer)
    excluded |= earth_in_field(boresight, camera, scenario.half_angle, scenario.buffer)
    excluded |= hidden_by_earth(camera, position)
    excluded |= sunlit_share(position, sun_at, scenario.shadow) < 0.5
    good[left] = ~excluded
    return good


def windows(scenario: Scenario, step: float = 0.25, precision: float = 1e-3) -> list[Window]:
    """Return all windows in which an object is observable, in order of time.

    The search uses a grid of `step` s, and finds the ends to `precision` s by bisection. A window that is
    shorter than `step` may be missed. Raises OutOfRange for a step that is not positive.
    """
    _check("step", step)
    grid = np.append(np.arange(0.0, scenario.duration, step), scenario.duration)
    found = []
    for index in range(len(scenario.objects)):
        good = observable(scenario, index, grid)
        edges = np.flatnonzero(np.diff(good))
        moments = _bisect(scenario, index, grid[edges], grid[edges + 1], good[edges], precision)
        starts = np.concatenate([grid[:1][good[:1]], moments[~good[edges]]])
        ends = np.concatenate([moments[good[edges]], grid[-1:][good[-1:]]])
        found += [Window(index, float(a), float(b)) for a, b in zip(starts, ends, strict=True)]
    return sorted(found, key=lambda window: (window.start, window.index))


def opportunities(scenario: Scenario, cadence: float, exposure: float) -> list[Opportunity]:
    """Return the frames that show an object during the whole exposure; a frame is due every `cadence` s.

    Observability is tested at nine instants of each exposure, which lasts `exposure` s. Raises OutOfRange if
    the cadence or the exposure is not positive.
    """
    _check("cadence", cadence)
    _check("exposure", exposure)
    starts = np.arange(0.0, scenario.duration - exposure, cadence)
    instants = exposure * np.linspace(0.0, 1.0, 9)
    found = []
    for index in range(len(scenario.objects)):
        left = starts
        for instant in instants:
            left = left[observable(scenario, index, left + instant)]
        found += [_opportunity(scenario, index, float(start), exposure) for start in left]
    return sorted(found, key=lambda opportunity: (opportunity.start, opportunity.index))


def _opportunity(scenario: Scenario, index: int, start: float, exposure: float) -> Opportunity:
    times = start + exposure * np.array([0.0, 0.5, 1.0])
    camera, position = scenario.camera.positions_at(times), scenario.objects[index].orbit.positions_at(times)
    matrices = quaternion.attitude_matrix(scenario.attitude(times))
    seen = (matrices @ directions(camera, position)[..., None])[..., 0]
    first, _, last = scenario.pinhole.project(seen).tolist()
    distance = float(np.linalg.norm(position[1] - camera[1]))
    return Opportunity(index, start, (first[0], first[1]), (last[0], last[1]), distance)


def _bisect(
    scenario: Scenario, index: int, low: FloatArray, high: FloatArray, before: BoolArray, precision: float
) -> FloatArray:
    """Return the times (j,), s, at which observability changes, one in each interval `low` to `high`."""
    while low.size and np.max(high - low) > precision:
        middle = 0.5 * (low + high)
        same = observable(scenario, index, middle) == before
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return 0.5 * (low + high)


def _check(name: str, value: float) -> None:
    if not 0.0 < value < math.inf:
        raise OutOfRange(DEVICE, name, value, 0.0, math.inf, "s")
