"""A slew as equations: Hermite-Simpson collocation in its separated form, of the fourth order.

Betts, Practical Methods for Optimal Control (2010), 4.5. The dipole is a straight line on each interval, so
that it keeps a limit everywhere when it keeps the limit at the nodes; states stand at nodes and midpoints.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.gnc.guidance.three_axes.slew_band import EQUATIONS, STEP, WIDE, layout
from knightcube.gnc.guidance.three_axes.slew_ends import Ending, EndLaw
from knightcube.gnc.guidance.three_axes.slew_model import Along, Motion, SlewCraft

_EYE7: FloatArray = np.eye(7)
_AXIS = np.arange(3)


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """States (2 k + 1, 7) at nodes and midpoints, and dipoles (k + 1, 3) at nodes.

    Times are counted in horizons, dipoles in the unit of the slew's motion.
    """

    states: FloatArray
    dipoles: FloatArray

    def all_dipoles(self) -> FloatArray:
        """Return the dipoles (2 k + 1, 3) at nodes and midpoints."""
        result = np.empty((len(self.states), 3))
        result[::2] = self.dipoles
        result[1::2] = 0.5 * (self.dipoles[1:] + self.dipoles[:-1])
        return result


@dataclass(frozen=True, slots=True, eq=False)
class Linear:
    """The equations around a trajectory: what remains of them, and their derivatives.

    Attributes:
        between: (k, 14); jacobian: (k, 14, WIDE), by what they touch.
        begun: (7,), ended: (ends,); ending: (ends, 7), by the last state.
    """

    at: Trajectory
    between: FloatArray
    begun: FloatArray
    ended: FloatArray
    jacobian: FloatArray
    ending: FloatArray


class Transcription:
    """The equations of a slew from a state (7,) over `scale` s, the unit of its times, on `count` intervals.

    `unit` A m^2 is that of the dipoles; `weights` (3,) are those of the dipoles' squares in the cost.
    """

    def __init__(
        self,
        craft: SlewCraft,
        unit: float,
        along: Along,
        start: FloatArray,
        end: EndLaw,
        count: int,
        scale: float,
        weights: FloatArray,
    ) -> None:
        self.start, self.end = start, end(scale)
        self._ending = Ending(self.end, scale)
        self.weights, self.count, self.scale = weights, count, scale
        self.times = np.linspace(0.0, scale, 2 * count + 1)
        self.around = along(self.times)
        self.motion = Motion(craft, scale, unit, self.around)
        self.layout = layout(count, self._ending.count)
        self._step = 1.0 / count

    def cost(self, at: Trajectory) -> float:
        """Return the integral of the weighted square of the dipole, exactly."""
        left, right = at.dipoles[:-1], at.dipoles[1:]
        squares = left * left + left * right + right * right
        return self._step / 3.0 * float(np.sum(squares @ self.weights))

    def remainders(self, at: Trajectory) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return what remains of the intervals' equations (k, 14), the start's (7,) and the end's."""
        x, h = at.states, self._step
        flow = self.motion.flow(x, at.all_dipoles())
        a, c, b = flow[:-1:2], flow[1::2], flow[2::2]
        left, middle, right = x[:-1:2], x[1::2], x[2::2]
        half = middle - 0.5 * (left + right) - h / 8.0 * (a - b)
        whole = right - left - h / 6.0 * (a + 4.0 * c + b)
        return np.concatenate([half, whole], axis=1), *self.ends_missed(at)

    def ends_missed(self, at: Trajectory) -> tuple[FloatArray, FloatArray]:
        """Return what remains of the equations of the start (7,) and of the end."""
        return at.states[0] - self.start, self._ending.miss(at.states[-1])

    def linear(self, at: Trajectory) -> Linear:
        """Return the equations around a trajectory."""
        h = self._step
        slopes = self.motion.slopes(at.states, at.all_dipoles())
        by_state, by_dipole = slopes[:, :, :7], slopes[:, :, 7:]
        jacobian = np.zeros((self.count, 14, WIDE))
        a, c, b = by_state[:-1:2], by_state[1::2], by_state[2::2]
        jacobian[:, :7, :7] = -0.5 * _EYE7 - h / 8.0 * a
        jacobian[:, 7:, :7] = -_EYE7 - h / 6.0 * a
        jacobian[:, :7, 17:24] = _EYE7
        jacobian[:, 7:, 17:24] = -4.0 * h / 6.0 * c
        jacobian[:, :7, 31:38] = -0.5 * _EYE7 + h / 8.0 * b
        jacobian[:, 7:, 31:38] = _EYE7 - h / 6.0 * b
        a, c, b = by_dipole[:-1:2], by_dipole[1::2], by_dipole[2::2]
        jacobian[:, :7, 7:10] = -h / 8.0 * a
        jacobian[:, 7:, 7:10] = -h / 6.0 * a - h / 3.0 * c
        jacobian[:, :7, 38:41] = h / 8.0 * b
        jacobian[:, 7:, 38:41] = -h / 6.0 * b - h / 3.0 * c
        ending = self._ending.slope(at.states[-1])
        return Linear(at, *self.remainders(at), jacobian, ending)

    def slope(self, linear: Linear, price: FloatArray) -> FloatArray:
        """Return the derivative (size,) of cost plus `price` (size,) times the equations.

        In the equations' places stands what remains of them; only there `price` counts.
        """
        at, place = linear.at, self.layout
        result = np.zeros(place.size)
        pulled = (price[place.equations][:, None, :] @ linear.jacobian)[:, 0]
        first = place.begins[:-1, None]
        result[first + np.arange(STEP)] = pulled[:, :STEP]
        result[first + STEP + np.arange(10)] += pulled[:, STEP:]
        result[place.states[0]] += price[place.start]
        result[place.states[-1]] += price[place.end] @ linear.ending
        m = at.dipoles
        heat = np.zeros_like(m)
        heat[:-1] += 2.0 * m[:-1] + m[1:]
        heat[1:] += 2.0 * m[1:] + m[:-1]
        result[place.dipoles] += self._step / 3.0 * heat * self.weights
        result[place.equations] = linear.between
        result[place.start], result[place.end] = linear.begun, linear.ended
        return result

    def band(
        self, linear: Linear, price: FloatArray, state_part: FloatArray, dipole_part: FloatArray
    ) -> FloatArray:
        """Return the band of the derivatives of `slope`.

        `state_part` (2 k + 1, 7, 7) and `dipole_part` (k + 1, 3) are added to the curvature by states and by
        dipoles: the parts of barriers and of convexity.
        """
        h = self._step
        bend = self._bend(linear, price[self.layout.equations])
        bend[:, :7, :7] += state_part
        nodes = bend[::2]
        heat = np.full(self.count + 1, 4.0 * h / 3.0)
        heat[[0, -1]] *= 0.5
        nodes[:, 7 + _AXIS, 7 + _AXIS] += heat[:, None] * self.weights + dipole_part
        block = np.zeros((self.count, WIDE, WIDE))
        block[:, :10, :10] = nodes[:-1]
        block[:, 17:24, 17:24] = bend[1::2, :7, :7]
        cross = 0.5 * bend[1::2, :7, 7:]
        for column in (7, 38):
            block[:, 17:24, column : column + 3] = cross
            block[:, column : column + 3, 17:24] = cross.transpose(0, 2, 1)
        block[:, 7 + _AXIS, 38 + _AXIS] = block[:, 38 + _AXIS, 7 + _AXIS] = h / 3.0 * self.weights
        block[:, EQUATIONS] += linear.jacobian
        block[:, :, EQUATIONS] += linear.jacobian.transpose(0, 2, 1)
        tail = np.zeros((10 + len(linear.ended),) * 2)
        tail[:10, :10] = nodes[-1]
        tail[:4, :4] += self._ending.curvature(price[self.layout.end])
        tail[10:, :7], tail[:7, 10:] = linear.ending, linear.ending.T
        return self.layout.band(block, tail)

    def _bend(self, linear: Linear, price: FloatArray) -> FloatArray:
        """Return the curvature (2 k + 1, 10, 10) of the equations times their `price` (k, 14)."""
        at, h = linear.at, self._step
        half, whole = price[:, :7], price[:, 7:]
        y = np.zeros_like(at.states)
        y[:-1:2] += -h / 8.0 * half - h / 6.0 * whole
        y[2::2] += h / 8.0 * half - h / 6.0 * whole
        y[1::2] = -4.0 * h / 6.0 * whole
        return self.motion.curvature(at.states, at.all_dipoles(), y)
