"""Rotation of a camera over one exposure: a smooth motion and a vibration.

Times are in units of the exposure time, and are zero at mid-exposure. With the rate u at mid-exposure and the
angular acceleration g in camera axes, the rotation vector since mid-exposure is u t + g t^2/2 + (u x g)
t^3/12 (Magnus expansion). The Magnus expansion is exact if the acceleration g is zero, and otherwise has an
error of fourth order in t. If the navigation filter provides terms of third and higher order in t, they are
added to the rotation vector.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from knightcube.astro.arrays import FloatArray, cross_product

TINY = 1e-12
"""Lower limit of angles and times, which avoids divisions by zero."""
# Start and end of the exposure, in exposure times since mid-exposure.
_ENDS = np.array([-0.5, 0.5])


@dataclass(frozen=True, slots=True, eq=False)
class Vibration:
    """Vibration of the camera: a small rotation vector that is a sum of k sinusoids.

    The contribution of a sinusoid to the rotation vector at the time t is `sine` sin(2 pi `frequency` t) +
    `cosine` (cos(2 pi `frequency` t) - 1), which is zero at mid-exposure. The frequencies (k,) are in cycles
    per exposure, and the amplitudes (k, 3) in rad.
    """

    frequency: FloatArray = field(default_factory=lambda: np.zeros(0))
    sine: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    cosine: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def exists(self) -> bool:
        """Whether the camera vibrates."""
        return len(self.frequency) > 0

    @property
    def amplitude(self) -> FloatArray:
        """The amplitudes (k,), rad, of the sinusoids; they are exact for a vibration about a fixed axis."""
        return np.asarray(np.sqrt(np.sum(self.sine**2 + self.cosine**2, axis=1)))

    def with_frequency(self, frequency: float) -> Vibration:
        """Return the vibration with one more sinusoid of zero amplitude."""
        amplitudes = (np.concatenate([each, np.zeros((1, 3))]) for each in (self.sine, self.cosine))
        return Vibration(np.append(self.frequency, frequency), *amplitudes)

    def rotation(self, time: FloatArray, derivative: int = 0) -> FloatArray:
        """Return the rotation vector (3, m) at `time` (m,), rad, or its first or second time derivative."""
        angular = 2.0 * np.pi * self.frequency[:, None]
        sine, cosine = np.sin(angular * time), np.cos(angular * time)
        if derivative == 0:
            return np.asarray(self.sine.T @ sine + self.cosine.T @ (cosine - 1.0))
        if derivative == 1:
            return np.asarray(self.sine.T @ (angular * cosine) - self.cosine.T @ (angular * sine))
        return np.asarray(-self.sine.T @ (angular**2 * sine) - self.cosine.T @ (angular**2 * cosine))

    def reversed(self) -> Vibration:
        """Return the vibration with time reversed."""
        return replace(self, sine=-self.sine)


@dataclass(frozen=True, slots=True, eq=False)
class CameraMotion:
    """Rotation of the camera over one exposure, in camera axes, with the exposure as unit of time.

    The rotation of the vibration is applied after that of the smooth motion, about axes fixed in the camera.
    The smooth motion is described by its rate (3,), rad per exposure, and angular acceleration (3,) at
    mid-exposure, and by the known coefficients `higher_terms` (k, 3), rad, of t^3, t^4, ... in the rotation
    vector.
    """

    rate: FloatArray
    acceleration: FloatArray
    higher_terms: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    vibration: Vibration = field(default_factory=Vibration)

    @classmethod
    def steady(cls, rate: FloatArray) -> CameraMotion:
        """Return the motion at a constant `rate` (3,), rad per exposure."""
        return cls(np.asarray(rate, dtype=float), np.zeros(3))

    @classmethod
    def between(cls, rotation: FloatArray, acceleration: FloatArray, higher: FloatArray) -> CameraMotion:
        """Return the motion with the given `rotation` (3,), rad, from start to end of the exposure."""
        unscaled = cls(np.zeros(3), acceleration, higher)
        return replace(unscaled, rate=rotation - unscaled.rotation)

    @property
    def constant(self) -> bool:
        """Whether the angular rate is constant over the exposure."""
        return not (self.accelerates or self.vibration.exists)

    @property
    def accelerates(self) -> bool:
        """Whether the angular rate changes over the exposure even without the vibration."""
        return bool(self.acceleration.any() or self.higher_terms.any())

    @property
    def smooth(self) -> CameraMotion:
        """The motion without its vibration."""
        return replace(self, vibration=Vibration()) if self.vibration.exists else self

    def directed(self, direction: FloatArray) -> CameraMotion:
        """Return this motion or its time reversal, whichever rotates in the same sense as `direction` (3,).

        A motion and its time reversal have the same angular acceleration.
        """
        if self.rotation @ direction >= 0.0:
            return self
        odd = (-1.0) ** np.arange(3, 3 + len(self.higher_terms))
        higher = odd[:, None] * self.higher_terms
        return CameraMotion(-self.rate, self.acceleration, higher, self.vibration.reversed())

    def scaled_to(self, rotation: FloatArray) -> CameraMotion:
        """Return this motion with the mean rate `rotation` (3,) or its negative, whichever is nearer."""
        sign = -1.0 if self.rotation @ rotation < 0.0 else 1.0
        return replace(self, rate=self.rate + sign * rotation - self.rotation)

    @property
    def rotation(self) -> FloatArray:
        """The rotation vector (3,), rad, from start to end of the exposure."""
        if not (len(self.higher_terms) or self.vibration.exists):
            return self.rate
        rotation = self.rate + self.smooth.higher(_ENDS) @ np.array([-1.0, 1.0])
        if self.vibration.exists:
            before, after = self.vibration.rotation(_ENDS).T
            rotation = rotation + after - before + 0.5 * np.cross(rotation, before + after)
        return np.asarray(rotation)

    @property
    def halfway(self) -> FloatArray:
        """The rotation vector (3,), rad, from mid-exposure to the attitude halfway between start and end."""
        return np.asarray(self.acceleration / 8.0 + self.higher(_ENDS) @ np.array([0.5, 0.5]))

    @property
    def relative_acceleration(self) -> float:
        """Change of the rate along the mean rotation axis over the exposure, divided by the mean rate."""
        square = float(self.rotation @ self.rotation)
        rate = self.smooth.higher(_ENDS, 1)
        change = self.acceleration + rate[:, 1] - rate[:, 0]
        return float(self.rotation @ change) / square if square else 0.0

    def rate_at(self, time: FloatArray) -> FloatArray:
        """Return the rate (3, m) at `time` (m,), or an array (3, 1) if the rate is constant."""
        if self.constant:
            return self.rate[:, None]
        return self.rate[:, None] + self.acceleration[:, None] * time + self.higher(time, 1)

    def rotation_until(self, time: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return axis (3, m), sine (m,) and cosine (m,) of the rotation from mid-exposure to `time` (m,).

        The axis has the shape (3, 1) if the rate is constant.
        """
        if self.constant:
            angle = float(np.linalg.norm(self.rate))
            a = (self.rate / max(angle, TINY))[:, None]
            phi = angle * time
        else:
            twist = cross_product(self.rate, self.acceleration) / 12.0
            parts = np.stack([self.rate, 0.5 * self.acceleration, twist], axis=1)
            square = time * time
            vector = parts @ np.stack([time, square, square * time]) + self.higher(time)
            phi = np.sqrt(np.sum(vector**2, axis=0))
            a = vector / np.maximum(phi, TINY)
        return a, np.sin(phi), np.cos(phi)

    def progress(self, time: FloatArray) -> FloatArray:
        """Return the fraction (m,) of the rotation that is completed between mid-exposure and `time` (m,)."""
        vector = self.rate[:, None] * time + 0.5 * self.acceleration[:, None] * time**2 + self.higher(time)
        return np.asarray(self.rotation @ vector / max(float(self.rotation @ self.rotation), TINY))

    def relative_rate(self, time: FloatArray, derivative: int = 0) -> FloatArray:
        """Return the rate about the mean axis at `time` (m,), divided by the mean rate, or its derivative."""
        vector = self.rate_at(time) if derivative == 0 else self.acceleration[:, None] + self.higher(time, 2)
        relative = self.rotation @ vector / max(float(self.rotation @ self.rotation), TINY)
        return np.asarray(np.broadcast_to(relative, time.shape))

    def higher(self, time: FloatArray, derivative: int = 0) -> FloatArray:
        """Return higher-order terms plus vibration (3, m) of the rotation vector, or their time derivative.

        The contribution of the vibration is correct to second order in the rotation.
        """
        if self.vibration.exists:
            return self.smooth.higher(time, derivative) + self._shaken(time)[derivative]
        out = np.zeros((3, len(time)))
        if not len(self.higher_terms):
            return out
        powers = np.arange(3.0, 3.0 + len(self.higher_terms))
        factors = (np.ones(len(powers)), powers, powers * (powers - 1.0))[derivative]
        # Horner's scheme is faster than the computation of each power.
        for coefficient in (factors[:, None] * self.higher_terms)[::-1]:
            out = coefficient[:, None] + time * out
        return out * (time * time * time, time * time, time)[derivative]

    def _shaken(self, time: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the vibration's part (3, m) of the rotation vector at `time` (m,), and two derivatives."""
        smooth, acceleration = self.smooth, self.acceleration[:, None]
        turn = self.rate[:, None] * time + 0.5 * acceleration * time**2 + smooth.higher(time)
        rate, bent = smooth.rate_at(time) + 0.0 * turn, acceleration + smooth.higher(time, 2)
        v, faster, pulled = (self.vibration.rotation(time, order) for order in range(3))
        first = cross(rate, v) + cross(turn, faster)
        second = cross(bent, v) + 2.0 * cross(rate, faster) + cross(turn, pulled)
        return v + 0.5 * cross(turn, v), faster + 0.5 * first, pulled + 0.5 * second


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the cross products of vectors `a` (..., 3, m) with `b` (3, m), or with one vector `b` (3, 1)."""
    if b.shape[1] == 1:
        x, y, z = b[:, 0]
        return np.asarray(np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]) @ a)
    after, before = [1, 2, 0], [2, 0, 1]
    return np.asarray(a[..., after, :] * b[before] - a[..., before, :] * b[after])
