"""The table of a slew: the path of least heat into an attitude law, gains along it, and the law after it.

The slew is planned by `slew_plan` with the torques that the filter estimates. Its dipoles are flown as
planned: a criterion that weighs turn against dipole would leave the path of least heat. The gains are those
of linear-quadratic tracking along slew and law, with the field of the revolution ahead; an error at the end
of the slew is the dearest. They tell by how much the dipole changes where the torques are estimated otherwise
than planned.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.disturbance import Pressures, box_areas, pressures, shapes
from knightcube.astro.earth.ephemeris import Ephemeris
from knightcube.astro.quaternion import attitude_matrix
from knightcube.errors import PlanningError
from knightcube.gnc.control.three_axes.pointing_sweep import Cost, ToGo, linearised, sweep
from knightcube.gnc.control.three_axes.pointing_table import (
    Ahead,
    PointingTable,
    PointingWeights,
    pointing_table,
    prices,
)
from knightcube.gnc.guidance.three_axes.attitude_law import References, references
from knightcube.gnc.guidance.three_axes.pointing_target import PointingTarget
from knightcube.gnc.guidance.three_axes.slew_model import SlewCraft
from knightcube.gnc.guidance.three_axes.slew_order import end_law
from knightcube.gnc.guidance.three_axes.slew_path import SlewPath
from knightcube.gnc.guidance.three_axes.slew_plan import plan_slew
from knightcube.gnc.guidance.three_axes.slew_sky import along, cones
from knightcube.gnc.guidance.three_axes.slew_task import SlewTask
from knightcube.gnc.guidance.three_axes.target_law import BodyAxes, law_of

RESERVE = 0.8
"""Of the coils' limit that a slew is planned with; the rest is for the errors."""
STIFFER = 5.0
"""Times the dipole that costs as much as the turn that costs one, while slewing."""
LONGEST = 1_500.0
"""s, of a slew: a table needs some of the law after it."""
FINE = 5
"""Parts of a step of pointing: a slewing body turns farther in one."""
TAIL = 300.0
"""s of the law after a slew that its gains look at."""
END = 2_000.0
"""s on the way, for which an error costs what it costs at a slew's end: torques are not known well before it,
and what they have done meanwhile is to be gone by then."""
_SLOWER, _MOST_SLOWER, _TRIALS = 1.05, 1.5, 5
"""A slew that turns too fast is planned over a time longer by the excess and this, so much, so often."""


@dataclass(frozen=True, slots=True, eq=False)
class SlewWish:
    """How a slew is wanted.

    Attributes:
        seconds: asked; longer where that does not suffice.
        heat: (3,) W/(A m^2)^2 of the coils.
        residual: (3,) A m^2, the craft's own dipole.
        camera, angles: body axis (3,) that keeps cones of `sun`, `earth` and `moon`, rad.
    """

    seconds: float
    heat: FloatArray
    residual: FloatArray
    camera: FloatArray
    angles: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class SlewBegin:
    """Where a slew begins: attitude (4,) and rate (3,) rad/s at the first of `times` (m,) s, even, previewed.

    `kept` steps of them are wanted. `inertia` kg m^2, `limit` A m^2 of each coil in the mean, `sizes` (9,)
    N m of the torques.
    """

    quaternion: FloatArray
    rate: FloatArray
    times: FloatArray
    kept: int
    inertia: FloatArray
    limit: float
    sizes: FloatArray


def slew(
    begin: SlewBegin, wish: SlewWish, target: PointingTarget, axes: BodyAxes, ahead: Ephemeris, fastest: float
) -> SlewPath | None:
    """Return the slew into a target's law that stays slower than `fastest` rad/s; None where there is none.

    Cones are kept but where the body already is within one, or no slew keeps them.
    """
    first = float(begin.times[0])
    craft = SlewCraft(begin.inertia, np.full(3, RESERVE * begin.limit), wish.heat, wish.residual)
    task = SlewTask(
        craft.facing(begin.sizes),
        along(ahead, first),
        begin.quaternion,
        begin.rate,
        end_law(target, axes, ahead, first),
        wish.seconds,
        LONGEST,
        cones=cones(ahead, first, wish.camera, **wish.angles),
    )
    found = _slow_enough(task, fastest)
    if found is None and task.cones:
        task = replace(task, cones=())
        found = _slow_enough(task, fastest)
    if found is None or not begin.sizes.any():
        return found
    # What presses on the body depends on the areas that it shows along the path.
    pressed = along(ahead, first, box_areas(begin.inertia), found)
    return _slow_enough(replace(task, along=pressed, horizon=found.horizon), fastest, found) or found


def _slow_enough(task: SlewTask, fastest: float, near: SlewPath | None = None) -> SlewPath | None:
    """Return the path of a task, over a longer time where it would turn too fast; None without one.

    `near` is the path of a task that is nearly the same.
    """
    for _ in range(_TRIALS):
        try:
            path = plan_slew(task, near).path
        except PlanningError:
            return None
        speed = float(np.linalg.norm(path.rate, axis=1).max())
        if speed < fastest:
            return path
        longer = path.horizon * min(_SLOWER * speed / fastest, _MOST_SLOWER)
        if longer > LONGEST:
            return None
        task, near = replace(task, horizon=longer), None
    return None


def slew_table(
    begin: SlewBegin,
    path: SlewPath,
    residual: FloatArray,
    target: PointingTarget,
    axes: BodyAxes,
    ahead: Ephemeris,
    expected: Ahead,
    weights: PointingWeights,
) -> PointingTable:
    """Return the table of a slew and of the law after it, in steps of a fifth of the begin's.

    `residual` (3,) A m^2 is the craft's own dipole that the path was planned with. `expected` is what acts at
    the begin's times; its motions are not looked at.
    """
    step, first = float(begin.times[1] - begin.times[0]) / FINE, float(begin.times[0])
    law = law_of(target, axes, path.quaternion[-1], ahead, first + path.horizon)
    coarse = math.ceil(path.horizon / (FINE * step))
    after = _since(expected, references(law, ahead, begin.times), coarse, begin.kept)
    held = pointing_table(after, begin.inertia, begin.limit, weights)
    count = FINE * coarse
    times = np.asarray(first + step * np.arange(FINE * begin.kept + 1), dtype=float)
    wanted = references(law, ahead, times)
    flown = path.references(times[:count] - first)
    dipole = path.dipoles(times[:count] + 0.5 * step - first) + residual  # the pointing law subtracts it
    stop = count + round(TAIL / step)
    tracked = _joined(flown, wanted.until(stop + 1))
    gain, torque_part = _tracking(tracked, ahead, dipole, begin, weights)
    dipoles, gains, torque_parts = (
        np.concatenate([slewed, np.repeat(kept, FINE, axis=0)])
        for slewed, kept in (
            (dipole, held.dipole),
            (gain, held.gain),
            (torque_part, held.torque_part),
        )
    )
    whole = _joined(flown, _finer(held.path, times, count))
    return PointingTable(whole, wanted, dipoles, gains, torque_parts, begin.sizes, path)


def _finer(path: References, times: FloatArray, count: int) -> References:
    """Return a path at `times` (n,) s from the instant `count` on; those before are not looked at."""
    rest = [path.at(float(time)) for time in times[count:]]
    whole = [*[rest[0]] * count, *rest]
    return References(
        times,
        np.array([part.quaternion for part in whole]),
        np.array([part.rate for part in whole]),
        np.array([part.acceleration for part in whole]),
    )


def _joined(first: References, then: References) -> References:
    """Return `then`, begun with `first`."""
    count = len(first.times)
    return References(
        then.times,
        np.concatenate([first.quaternion, then.quaternion[count:]]),
        np.concatenate([first.rate, then.rate[count:]]),
        np.concatenate([first.acceleration, then.acceleration[count:]]),
    )


def _since(expected: Ahead, wanted: References, count: int, kept: int) -> Ahead:
    """Return what is expected from instant `count` on, where the body is in the law."""
    pressed = Pressures(expected.pressures.air[count:], expected.pressures.light[count:])
    after = wanted.since(count)
    begun = after.until(kept + 1 - count)
    return Ahead(after, begun, expected.field[count:], expected.position[count:], pressed, expected.sizes)


def _tracking(
    tracked: References, ahead: Ephemeris, dipole: FloatArray, begin: SlewBegin, weights: PointingWeights
) -> tuple[FloatArray, FloatArray]:
    """Return the gains (n, 3, 6) along the dipoles (n, 3), and dipoles by the torques (n, 3, sizes)."""
    count, steps = len(dipole), len(tracked.times) - 1
    times, step = tracked.times[:steps], float(tracked.times[1] - tracked.times[0])
    planned = np.concatenate([dipole, np.zeros((steps - count, 3))])
    linear = linearised(
        tracked.until(steps), begin.inertia, ahead.field_at(times), ahead.position_at(times), planned
    )
    to_body = attitude_matrix(tracked.quaternion[:steps])
    shape = shapes(pressures(ahead, times).facing(box_areas(begin.inertia), to_body), to_body)
    affine = linear.by_torque @ shape
    state, price = prices(replace(weights, roll=None), step)
    control = np.full((steps, 3), price / STIFFER**2)
    nothing, states = np.zeros(affine.shape), np.repeat(state[None], steps, axis=0)
    states[count] *= END / step
    cost = Cost(states, control, nothing, nothing[:, :3])
    gain, steady, _ = sweep(linear, affine, cost, ToGo(state, nothing[0]))
    return gain[:count], steady[:count]
