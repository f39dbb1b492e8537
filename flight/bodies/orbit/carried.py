"""The satellite's estimate carried on by the model for a second or so, in the loop's form."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.directions import cross_product
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply
from knightcube.gnc.estimation import estimate as form
from knightcube.gnc.estimation import free_motion as states
from knightcube.gnc.estimation.estimate import FIELD_BIAS, Estimate
from knightcube.gnc.estimation.free_filter import FreeFilter, FreeMemory
from knightcube.gnc.estimation.free_motion import Around
from knightcube.gnc.estimation.rigid_body import Parameters

_FROM = np.r_[states.TURN, states.RATE, states.GYRO, states.MAGNET]
_TO = np.r_[form.TURN, form.RATE, form.BIAS, form.FIELD_BIAS]
_PICKED, _PLACED = np.ix_(_FROM, _FROM), np.ix_(_TO, _TO)
_SIZE = FIELD_BIAS.stop
_PARAMETERS = Parameters()
_NONE: FloatArray = np.zeros(3)


@dataclass(frozen=True, slots=True, eq=False)
class _Beginning:
    """An estimate at the end of a step, and what all those carried on from it have in common.

    Attributes:
        spread: (19, 19) the covariance in the loop's order.
        mixed: (3, 3) rad^2/s, of turn and rate, with its transpose.
        field, residual: (3,) T and A m^2, body axes.
    """

    around: Around
    quaternion: FloatArray
    rate: FloatArray
    bias: FloatArray
    magnet: FloatArray
    spread: FloatArray
    mixed: FloatArray
    field: FloatArray
    residual: FloatArray


class CarriedOn:
    """Carries estimates of a filter on; 0.03 ms each."""

    def __init__(self, free: FreeFilter) -> None:
        self._free = free
        self._newest: _Beginning | None = None
        self._changes = -1

    def now(
        self, time_ns: int, seconds: float, dipole: FloatArray, around: Around, measured_ns: int
    ) -> Estimate:
        """Return the newest estimate `seconds` s later under a dipole (3,) A m^2."""
        free, newest = self._free, self._newest
        if newest is None or self._changes != free.changes or newest.around is not around:
            bias, magnet = free.gyro_bias, free.magnet_bias
            newest = self._beginning(free.quaternion, free.rate, bias, magnet, free.covariance, around)
            self._newest, self._changes = newest, free.changes
        return self._carry(newest, time_ns, seconds, dipole, measured_ns)

    def then(
        self, memory: FreeMemory, time_ns: int, seconds: float, dipole: FloatArray, around: Around
    ) -> Estimate:
        """Return an earlier estimate `seconds` s later under a dipole (3,) A m^2."""
        bias, magnet = memory.constants[states.GYRO], memory.constants[states.MAGNET]
        begun = self._beginning(memory.quaternion, memory.rate, bias, magnet, memory.covariance, around)
        return self._carry(begun, time_ns, seconds, dipole, time_ns)

    def _beginning(
        self,
        quaternion: FloatArray,
        rate: FloatArray,
        bias: FloatArray,
        magnet: FloatArray,
        covariance: FloatArray,
        around: Around,
    ) -> _Beginning:
        spread = np.zeros((_SIZE, _SIZE))
        spread[_PLACED] = covariance[_PICKED]
        mixed = spread[form.TURN, form.RATE]
        field = attitude_matrix(quaternion) @ around.field
        residual = self._free.residual_dipole(around.sunlit)
        return _Beginning(around, quaternion, rate, bias, magnet, spread, mixed + mixed.T, field, residual)

    def _carry(
        self, begun: _Beginning, time_ns: int, seconds: float, dipole: FloatArray, measured_ns: int
    ) -> Estimate:
        free = self._free
        torque = cross_product(dipole + begun.residual, begun.field)
        acceleration = free.motion.acceleration(begun.rate, torque)
        turn = seconds * (begun.rate + 0.5 * seconds * acceleration)
        grown = seconds * free.rate_noise(dipole, begun.around)
        spread = begun.spread.copy()
        widened = seconds**2 * (begun.spread[form.RATE, form.RATE] + grown / 3.0)
        spread[form.TURN, form.TURN] += seconds * begun.mixed + widened
        spread[form.RATE, form.RATE] += grown
        return Estimate(
            time_ns=time_ns,
            quaternion=multiply(from_rotation_vector(turn), begun.quaternion),
            rate=begun.rate + seconds * acceleration,
            bias=begun.bias,
            disturbance=_NONE,
            parameters=_PARAMETERS,
            covariance=spread,
            measured_ns=measured_ns,
            field_bias=begun.magnet,
        )
