"""The filter's model of the rigid body: Euler's equation under coils in a known field, and a thread.

J w' = -w x J w + m x A(q) B + thread (Sease 5.2 corrected), m the coils' dipole moment. On the testbed's
thread the body turns about its y axis alone: the constraint balances all other torques, so the response to a
torque T is T_y / J22 about y only, and the thread adds -k theta - c w (5.4). The parameters that the filter
may estimate are arguments.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.errors import UsageError
from knightcube.gnc.estimation.turn import Matrix, Quaternion, Vector, cross, matrix, skew, times, twist


class Parameters(NamedTuple):
    """Uncertain parameters of the model, which may be estimated.

    Attributes:
        torsion: 1/s^2, k / J22 of the thread.
        damping: 1/s, c / J22 of the thread.
        gain: true over modelled acceleration by the coils (dipole times field over inertia).
    """

    torsion: float = 0.0
    damping: float = 0.0
    gain: float = 1.0


NOMINAL = Parameters()


@dataclass(frozen=True, slots=True)
class Torquing:
    """The action of the coils: dipole moment (body, A m^2) in a field (reference, T); 1 for each driven coil.

    Not `known` while the PWM chip does not respond to commands: any coil may then be driven.
    """

    dipole: Vector
    field: Vector
    driven: Vector
    known: bool = True


class Accelerated(NamedTuple):
    """Angular acceleration w' (rad/s^2), and its derivatives (3, 3) by torsion, damping and gain."""

    acceleration: Vector
    by_parameters: Matrix


class Linearised(NamedTuple):
    """Angular acceleration w' (rad/s^2) and its derivatives.

    `by_turn` and `by_rate` (3, 3) are its derivatives by a small turn about the body's axes and by the rate;
    `by_current` (3, 3) rad/s^2/A are those by the coils' currents, `by_parameters` (3, 3) those by torsion,
    damping and gain.
    """

    acceleration: Vector
    by_parameters: Matrix
    by_turn: FloatArray
    by_rate: FloatArray
    by_current: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class RigidBody:
    """The constants of the body, its coils, the field and the thread.

    Attributes:
        inertia: (3, 3) kg m^2, body axes.
        dipole_per_ampere: n A of each coil, m^2.
        field: (3,) T, reference axes; a command may give another.
        suspended: on the thread, free to turn about body y only.
        stiffness: k of the thread, N m/rad, nominal.
        damping: c, N m s/rad, likewise.
    """

    inertia: FloatArray
    dipole_per_ampere: float
    field: FloatArray
    suspended: bool = False
    stiffness: float = 0.0
    damping: float = 0.0
    response: FloatArray = dataclasses.field(init=False)
    _response: Matrix = dataclasses.field(init=False)
    _inertia: Matrix = dataclasses.field(init=False)

    def __post_init__(self) -> None:
        """Raise UsageError for constants that no body has."""
        inertia = np.asarray(self.inertia, dtype=float)
        if inertia.shape != (3, 3) or not np.all(np.isfinite(inertia)):
            raise UsageError(f"inertia {inertia.tolist()} must be (3, 3) and finite")
        if not np.allclose(inertia, inertia.T) or float(np.linalg.eigvalsh(inertia)[0]) <= 0.0:
            raise UsageError(f"inertia {inertia.tolist()} must be symmetric and positive")
        if np.shape(self.field) != (3,) or not np.all(np.isfinite(self.field)):
            raise UsageError(f"field {self.field} must be (3,) and finite")
        for name in ("dipole_per_ampere", "stiffness", "damping"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise UsageError(f"{name} is {value}: it must be finite and not negative")
        if not self.suspended and (self.stiffness or self.damping):
            raise UsageError("a thread's stiffness and damping need a body that is suspended")
        response = np.linalg.inv(inertia)
        if self.suspended:
            response = np.diag([0.0, 1.0 / inertia[1, 1], 0.0])
        object.__setattr__(self, "response", response)
        object.__setattr__(self, "_response", _rows(response))
        object.__setattr__(self, "_inertia", _rows(inertia))

    def torquing(
        self, currents: FloatArray, reference_field: FloatArray | None = None, known: bool = True
    ) -> Torquing:
        """Return the torquing of `currents` (3,) A in `reference_field` (3,) T, by default the body's own."""
        x, y, z = (float(i) for i in currents)
        bx, by, bz = (float(b) for b in (self.field if reference_field is None else reference_field))
        n = self.dipole_per_ampere
        return Torquing(
            (n * x, n * y, n * z), (bx, by, bz), (float(x != 0.0), float(y != 0.0), float(z != 0.0)), known
        )

    @property
    def parameters(self) -> Parameters:
        """The nominal parameters."""
        return Parameters(self.stiffness * self._response[1][1], self.damping * self._response[1][1])

    def accelerate(
        self, q: Quaternion, rate: Vector, parameters: Parameters, torquing: Torquing
    ) -> Accelerated:
        """Return the acceleration under `torquing` at attitude q."""
        return self._accelerate(q, rate, parameters, torquing, times(matrix(q), torquing.field))

    def linearise(
        self, q: Quaternion, rate: Vector, parameters: Parameters, torquing: Torquing, ahead: float
    ) -> Linearised:
        """Return the acceleration under `torquing` at attitude q, with its derivatives.

        The gyroscopic torque is taken at the rate `ahead` s later, which makes it second order for a body
        that tumbles.
        """
        x, y, z = times(self._response, self._gyroscopic(rate))
        rate = (rate[0] + ahead * x, rate[1] + ahead * y, rate[2] + ahead * z)
        field_body = times(matrix(q), torquing.field)
        acceleration, by_parameters = self._accelerate(q, rate, parameters, torquing, field_body)
        parts = zip(_by_turn(torquing.dipole, field_body), self._by_rate(rate), skew(field_body), strict=True)
        derivatives = self.response @ np.array([(*turn, *spin, *field) for turn, spin, field in parts])
        by_turn, by_rate, by_field = derivatives[:, :3], derivatives[:, 3:6], derivatives[:, 6:]
        torsion, damping, gain = parameters
        by_turn *= gain
        by_turn[1, 1] -= torsion
        by_rate[1, 1] -= damping
        by_current = -gain * self.dipole_per_ampere * by_field
        return Linearised(acceleration, by_parameters, by_turn, by_rate, by_current)

    def _accelerate(
        self, q: Quaternion, rate: Vector, parameters: Parameters, torquing: Torquing, field_body: Vector
    ) -> Accelerated:
        torsion, damping, gain = parameters
        cx, cy, cz = times(self._response, cross(torquing.dipole, field_body))
        fx, fy, fz = times(self._response, self._gyroscopic(rate))
        angle = twist(q) if self.suspended else 0.0
        thread = -torsion * angle - damping * rate[1]
        acceleration = (gain * cx + fx, gain * cy + fy + thread, gain * cz + fz)
        return Accelerated(acceleration, ((0.0, 0.0, cx), (-angle, -rate[1], cy), (0.0, 0.0, cz)))

    def _gyroscopic(self, rate: Vector) -> Vector:
        return cross(times(self._inertia, rate), rate)

    def _by_rate(self, rate: Vector) -> Matrix:
        """Return the derivative of -w x J w by w, which is [J w x] - [w x] J."""
        (a, b, c), (d, e, f), (g, h, i) = self._inertia
        x, y, z = rate
        jx, jy, jz = times(self._inertia, rate)
        return (
            (z * d - y * g, -jz + z * e - y * h, jy + z * f - y * i),
            (jz + x * g - z * a, x * h - z * b, -jx + x * i - z * c),
            (-jy + y * a - x * d, jx + y * b - x * e, y * c - x * f),
        )


def _by_turn(dipole: Vector, field_body: Vector) -> Matrix:
    """Return the derivative of m x B by a small turn of the body: m x (B x turn) = B m.turn - turn m.B."""
    (mx, my, mz), (bx, by, bz) = dipole, field_body
    dot = mx * bx + my * by + mz * bz
    return (
        (bx * mx - dot, bx * my, bx * mz),
        (by * mx, by * my - dot, by * mz),
        (bz * mx, bz * my, bz * mz - dot),
    )


def _rows(array: FloatArray) -> Matrix:
    a, b, c = (tuple(row) for row in array.tolist())
    return a, b, c
