"""PID and adaptive controllers of the testbed's rotation angle, for comparison (Sease 2013, chapter 5).

The PID controller, which needs 0.15 W on the testbed, has either freely chosen gains, or gains that place all
three closed-loop poles of a double integrator at -w, with a bandwidth w. The gains for three poles at -w are
3 w on the rate, 3 w^2 on the angle and w^3 on the integral of the angle. The reference angle enters the
proportional part with a weight b (set-point weighting, Astrom and Hagglund 1995, section 3.4). If the
reference angle has no weight (b = 0), a step of the target causes no step of the current and no overshoot.
The integration stops while the current is saturated and the error would increase the saturation (conditional
integration). The only plant parameter that the PID controller uses is the ratio of inertia to torque
constant, which scales the gains.

The adaptive controller, which needs 0.66 W on the testbed, follows Slotine and Li 1991, section 8.5. With the
composite error s = e' + l e and the reference acceleration a_r = theta_m'' + l e', the current I is defined
by

    I cos(theta) = p . Y + g s,     Y = (a_r, theta, w, -1),     p' = G Y s

The adapted parameters p are inertia, stiffness, damping and constant torque, each divided by the torque
constant. The adaptive controller converges for any true values of the parameters p. The reference angle
theta_m follows the target through a critically damped second-order model, so that the body can follow a step
of the target. The parameters p are adapted only while the coil is not saturated and the composite error
exceeds the noise level. The parameters p are also bounded, because noise alone would make the parameters
drift.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.errors import UsageError
from knightcube.gnc.control.one_axis import CurrentCommand, attitude_error
from knightcube.gnc.guidance.plant import PathSample, SingleAxisPlant


@dataclass(frozen=True, slots=True)
class PidSettings:
    """PID gains on the angle error, 1/s^2, on its integral, 1/s^3, and on the rate error, 1/s."""

    proportional: float
    integral: float
    derivative: float

    def __post_init__(self) -> None:
        """Raise UsageError for gains that are not finite and positive."""
        for name in ("proportional", "integral", "derivative"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise UsageError(f"PID {name} gain is {value}: it must be finite and positive")

    @classmethod
    def placed(cls, bandwidth: float) -> PidSettings:
        """Return the gains that place all three closed-loop poles at -`bandwidth`, rad/s."""
        return cls(3.0 * bandwidth**2, bandwidth**3, 3.0 * bandwidth)


class PidController:
    """PID controller of the angle, whose state is the integral of the angle error, rad s."""

    def __init__(
        self, plant: SingleAxisPlant, period: float, gains: PidSettings, target_weight: float
    ) -> None:
        """Prepare the controller for a command every `period` s.

        The weight b of the reference angle in the proportional part, `target_weight`, is 0 to 1. Raises
        UsageError if a value is outside its range.
        """
        if not (math.isfinite(period) and period > 0.0):
            raise UsageError(f"PID period is {period}: it must be finite and positive")
        if not 0.0 <= target_weight <= 1.0:
            raise UsageError(f"PID target_weight is {target_weight}: it must lie between 0 and 1")
        self._scale = plant.inertia / plant.torque_constant
        self._limit = plant.current_limit
        self._period = period
        self._weight = target_weight
        self._gains = gains
        self._sum: float | None = None

    def command(
        self, wanted: PathSample, angle: float, rate: float, disturbance: float = 0.0
    ) -> CurrentCommand:
        """Return the current command for the given state. The estimated disturbance is not used.

        Raises UsageError if an input is not finite.
        """
        error = attitude_error(wanted, angle, rate, disturbance)
        # The initial integral cancels the proportional part, so that the first command at rest is zero.
        unweighted = (1.0 - self._weight) * wanted.angle
        if self._sum is None:
            self._sum = self._gains.proportional / self._gains.integral * ((1.0 - self._weight) * angle)
        total = self._sum + self._period * error
        acceleration = (
            self._gains.proportional * (error - unweighted)
            + self._gains.integral * total
            + self._gains.derivative * (wanted.rate - rate)
            + wanted.acceleration
        )
        made = CurrentCommand.within(self._limit, self._scale * acceleration, error)
        if not (made.saturated and made.demanded * error > 0.0):
            self._sum = total
        return made

    def reset(self) -> None:
        """Reset the integral of the error."""
        self._sum = None


_MINIMUM_AUTHORITY = 0.05


@dataclass(frozen=True, slots=True)
class AdaptiveSettings:
    """Settings of the adaptive controller.

    Attributes:
        bandwidth: factor l in the composite error s = e' + l e, rad/s; also the gain on s, 1/s.
        adaptation: adaptation gain, divided by the square of each parameter's range, s/rad^2.
        reference_bandwidth: bandwidth of the reference model, rad/s, or None without a reference model.
        dead_zone: minimum absolute composite error s for adaptation of the parameters, rad/s.
    """

    bandwidth: float
    adaptation: float
    reference_bandwidth: float | None
    dead_zone: float = 1e-3

    def __post_init__(self) -> None:
        """Raise UsageError for values that are not finite and positive."""
        for name in ("bandwidth", "adaptation", "reference_bandwidth", "dead_zone"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0.0):
                raise UsageError(f"adaptive {name} is {value}: it must be finite and positive")


class AdaptiveController:
    """Adaptive controller; its state consists of adapted parameters and the reference model's state.

    The parameters (4,) are inertia (A s^2), stiffness (A), damping (A s) and constant torque (A), each
    divided by the torque constant.
    """

    def __init__(self, plant: SingleAxisPlant, period: float, settings: AdaptiveSettings) -> None:
        """Start with the inertia, stiffness and damping of the plant model as initial parameters.

        Raises UsageError if the time `period` between commands, s, is not positive.
        """
        if not (math.isfinite(period) and period > 0.0):
            raise UsageError(f"adaptive period is {period}: it must be finite and positive")
        self._settings = settings
        self._period = period
        self._limit = plant.current_limit
        inertia = plant.inertia / plant.torque_constant
        self._gain = inertia * settings.bandwidth
        begin = np.array([plant.inertia, plant.stiffness, plant.damping, 0.0]) / plant.torque_constant
        # The range of the stiffness corresponds to half the current limit at an angle of 1 rad.
        # The range of the damping corresponds to half the current limit at a rate of 0.2 rad/s.
        self._range = np.array([0.5 * inertia, 0.5 * self._limit, 2.5 * self._limit, 0.5 * self._limit])
        self._low = np.maximum(begin - self._range, [0.5 * inertia, 0.0, 0.0, -np.inf])
        self._high = begin + self._range
        self.parameters: FloatArray = begin
        self._model: tuple[float, float] | None = None

    def command(
        self, wanted: PathSample, angle: float, rate: float, disturbance: float = 0.0
    ) -> CurrentCommand:
        """Return the current command for the given state. The estimated disturbance is not used.

        Raises UsageError if an input is not finite.
        """
        error = attitude_error(wanted, angle, rate, disturbance)
        cosine = math.cos(angle)
        if abs(cosine) < _MINIMUM_AUTHORITY:
            return CurrentCommand.without_authority(error)
        model = self._follow(wanted, angle, rate)
        lead, lag = math.remainder(model.angle - angle, 2.0 * math.pi), model.rate - rate
        slide = lag + self._settings.bandwidth * lead
        regressor = np.array([model.acceleration + self._settings.bandwidth * lag, angle, rate, -1.0])
        demanded = (float(self.parameters @ regressor) + self._gain * slide) / cosine
        made = CurrentCommand.within(self._limit, demanded, error)
        if not made.saturated and abs(slide) > self._settings.dead_zone:
            change = self._settings.adaptation * self._range**2 * regressor * slide
            self.parameters = np.clip(self.parameters + self._period * change, self._low, self._high)
        return made

    def reset(self) -> None:
        """At the next command, restart the reference model from the body's state. The parameters are kept."""
        self._model = None

    def _follow(self, wanted: PathSample, angle: float, rate: float) -> PathSample:
        """Return the present motion of the reference model, and propagate the model by one period."""
        w = self._settings.reference_bandwidth
        if w is None:
            return wanted
        at, moving = self._model if self._model is not None else (angle, rate)
        acceleration = w * w * (wanted.angle - at) + 2.0 * w * (wanted.rate - moving)
        dt = self._period
        self._model = (at + dt * moving + 0.5 * dt * dt * acceleration, moving + dt * acceleration)
        return PathSample(at, moving, acceleration)
