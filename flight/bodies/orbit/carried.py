"""The satellite's estimate carried on by the model for a second or so, in the loop's form."""

from __future__ import annotations

import numpy as np

from flight.gnc.estimation import estimate as form
from flight.gnc.estimation import free_motion as states
from flight.gnc.estimation.estimate import FIELD_BIAS, Estimate
from flight.gnc.estimation.free_filter import FreeFilter, FreeMemory
from flight.gnc.estimation.free_motion import Around, crossed
from flight.gnc.estimation.rigid_body import Parameters
from flight.gnc.math.arrays import FloatArray
from flight.gnc.math.quaternion import attitude_matrix, from_rotation_vector, multiply

_FROM = np.r_[states.TURN, states.RATE, states.GYRO, states.MAGNET]
_TO = np.r_[form.TURN, form.RATE, form.BIAS, form.FIELD_BIAS]
_PICKED, _PLACED = np.ix_(_FROM, _FROM), np.ix_(_TO, _TO)
_SIZE = FIELD_BIAS.stop
_PARAMETERS = Parameters()


class CarriedOn:
    """Carries estimates of a filter on; 0.05 ms each."""

    def __init__(self, free: FreeFilter) -> None:
        self._free = free

    def now(
        self, time_ns: int, seconds: float, dipole: FloatArray, around: Around, measured_ns: int
    ) -> Estimate:
        """Return the newest estimate `seconds` s later under a dipole (3,) A m^2."""
        free = self._free
        bias, magnet = free.gyro_bias, free.magnet_bias
        parts = free.quaternion, free.rate, bias, magnet, free.covariance
        return self._carry(parts, time_ns, seconds, dipole, around, measured_ns)

    def then(
        self, memory: FreeMemory, time_ns: int, seconds: float, dipole: FloatArray, around: Around
    ) -> Estimate:
        """Return an earlier estimate `seconds` s later under a dipole (3,) A m^2."""
        bias, magnet = memory.constants[states.GYRO], memory.constants[states.MAGNET]
        parts = memory.quaternion, memory.rate, bias, magnet, memory.covariance
        return self._carry(parts, time_ns, seconds, dipole, around, time_ns)

    def _carry(
        self,
        parts: tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray],
        time_ns: int,
        seconds: float,
        dipole: FloatArray,
        around: Around,
        measured_ns: int,
    ) -> Estimate:
        quaternion, rate, bias, magnet, covariance = parts
        field = attitude_matrix(quaternion) @ around.field
        whole = dipole + self._free.residual_dipole(around.sunlit)
        acceleration = self._free.motion.acceleration(rate, crossed(whole) @ field)
        turn = seconds * (rate + 0.5 * seconds * acceleration)
        spread = np.zeros((_SIZE, _SIZE))
        spread[_PLACED] = covariance[_PICKED]
        mixed = seconds * spread[form.TURN, form.RATE]
        grown = seconds * self._free.rate_noise(dipole, around)
        spread[form.TURN, form.TURN] += mixed + mixed.T
        spread[form.TURN, form.TURN] += seconds**2 * (spread[form.RATE, form.RATE] + grown / 3.0)
        spread[form.RATE, form.RATE] += grown
        return Estimate(
            time_ns=time_ns,
            quaternion=multiply(from_rotation_vector(turn), quaternion),
            rate=rate + seconds * acceleration,
            bias=bias,
            disturbance=np.zeros(3),
            parameters=_PARAMETERS,
            covariance=spread,
            measured_ns=measured_ns,
            field_bias=magnet,
        )
