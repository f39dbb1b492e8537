"""Control about one axis with a linear-quadratic tracker, and excitation manoeuvres that identify the plant.

The tracker applies feedback linearisation to the attitude error and then a linear-quadratic regulator (Sease
2013, eqs. (5.16) to (5.32)). The error is e = sin(d), d = theta_p - theta (Sease, eq. (5.21)), where theta_p
is the angle of the path and theta the angle of the body. The derivatives of the error (Sease, eqs. (5.24) to
(5.27), corrected) are

    e'  = cos(d) (theta_p' - w)
    e'' = cos(d) (theta_p'' - w') - sin(d) (theta_p' - w)^2.

The regulator demands e'' = -K (e', e), with the gain K from the Riccati equation. The expression for e'' is
solved for the angular acceleration w', and the plant model converts w' into the current.

The tracker extends the controller of Sease's thesis by two features, which the option `as_in_thesis` switches
off. The first feature is a feedforward of the estimated disturbance, so that a constant torque causes no
offset. The estimator integrates the difference between actual and modelled acceleration. The model uses the
limited current, so the integral does not wind up. The second feature limits the rate at which an angle error
is reduced, so that the coil can decelerate the body in time and the angle does not overshoot. Small errors e
are reduced at the rate s e with s = K_e / K_e', and errors above A / s^2 at the rate sqrt(2 A |e| - (A /
s)^2), where A is the available deceleration. The limit is the rate limit of the proximate time-optimal
servomechanism (Workman 1987), but with a continuous slope.

The error e = sin(d) is monotonic in d only up to 90 degrees. The angle error d is therefore clamped to
`largest_error`, so that the demanded acceleration stays bounded and does not decrease for larger errors.

The excitation manoeuvres do not follow a path. Long and short current pulses rotate the body away from rest
and back, and the torque constant and the delay are identified from the response. Further pulses displace the
body, which then oscillates with the coils off, and stiffness and damping are identified from the oscillation.
All pulses are repeated with the opposite sign. Before and between manoeuvres, the tracker brings the body to
rest. The tracker also replaces a manoeuvre if the body could otherwise not be stopped within the allowed
angle. If the tracker cannot bring the body to rest, the current stays zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum
from typing import NamedTuple, Protocol

from knightcube.errors import UsageError
from knightcube.gnc.guidance.plant import PathSample, SingleAxisPlant, angle_of


class CurrentCommand(NamedTuple):
    """Coil current that a controller commands in one cycle.

    Attributes:
        current: commanded current within the limit, A.
        demanded: demanded current before limiting, A; zero if the coil has no control authority.
        saturated: whether the current was limited.
        authority: whether |cos(theta)| was large enough for a useful torque; otherwise the current is zero.
        error: angle of the path minus angle of the body, before clamping, from -pi to pi, rad.
        held: whether the angle error exceeded `largest_error` and was clamped.
    """

    current: float
    demanded: float
    saturated: bool
    authority: bool
    error: float
    held: bool = False

    @classmethod
    def within(cls, limit: float, demanded: float, error: float, held: bool = False) -> CurrentCommand:
        """Return the command for the demanded current (A), limited to +-`limit` (A)."""
        current = min(max(demanded, -limit), limit)
        return cls(current, demanded, current != demanded, True, error, held)

    @classmethod
    def without_authority(cls, error: float) -> CurrentCommand:
        """Return the command of zero current, for an angle at which the coil has no useful torque."""
        return cls(0.0, 0.0, False, False, error)


class AngleController(Protocol):
    """Interface of a controller that computes a coil current from commanded and estimated motion."""

    def command(
        self, wanted: PathSample, angle: float, rate: float, disturbance: float = 0.0
    ) -> CurrentCommand:
        """Return the command for an estimated angle (rad), rate (rad/s) and disturbance (rad/s^2).

        Raises UsageError if an input is not finite.
        """

    def reset(self) -> None:
        """Clear the controller's internal state after the coils were off or the estimate was lost."""


def attitude_error(wanted: PathSample, angle: float, rate: float, disturbance: float) -> float:
    """Return the angle of the path minus `angle`, in [-pi, pi].

    Raises UsageError if an input is not finite.
    """
    total = wanted.angle + wanted.rate + wanted.acceleration + angle + rate + disturbance
    if not math.isfinite(total):
        raise UsageError(
            f"controller input is not finite: {wanted}, angle {angle}, rate {rate}, disturbance {disturbance}"
        )
    return math.remainder(wanted.angle - angle, 2.0 * math.pi)


LARGEST_ERROR = 1.0
MINIMUM_AUTHORITY = 0.05

_BRAKING_SHARE = 0.8
_MINIMUM_BRAKING = 0.05


class LqTracker:
    """The linear-quadratic tracker of an angle, without internal state.

    Attributes:
        error_gain, rate_gain: elements of the gain K for the error e (1/s^2) and for its derivative e' (1/s).
    """

    def __init__(
        self,
        plant: SingleAxisPlant,
        state_weight: float,
        input_weight: float,
        largest_error: float = LARGEST_ERROR,
        minimum_authority: float = MINIMUM_AUTHORITY,
        as_in_thesis: bool = False,
    ) -> None:
        """Create a tracker with the weights Q = state_weight I and R = input_weight.

        The gains follow from the Riccati equation (Sease, eqs. (5.28) to (5.32)). The error bound
        `largest_error` (rad) must be below pi/2. The current is zero while |cos(theta)| is below
        `minimum_authority`. The option `as_in_thesis` switches off the disturbance feedforward and the
        limited deceleration. Raises UsageError if a value is outside its range.
        """
        for name, value in (("Q", state_weight), ("R", input_weight)):
            if not (math.isfinite(value) and value > 0.0):
                raise UsageError(f"LQ weight {name} is {value}: it must be finite and positive")
        if not 0.0 < largest_error < 0.5 * math.pi:
            raise UsageError(f"largest_error is {largest_error} rad: it must lie between 0 and pi/2")
        if not 0.0 < minimum_authority < 1.0:
            raise UsageError(f"minimum_authority is {minimum_authority}: it must lie between 0 and 1")
        self._plant = plant
        self._largest_error = largest_error
        self._minimum_authority = minimum_authority
        self._as_in_thesis = as_in_thesis
        self._strength = plant.torque_constant * plant.current_limit / plant.inertia
        self.rate_gain, self.error_gain = lq_gains(state_weight, input_weight)

    def command(
        self, wanted: PathSample, angle: float, rate: float, disturbance: float = 0.0
    ) -> CurrentCommand:
        """Return the command for an estimated angle (rad), rate (rad/s) and disturbance (rad/s^2).

        Raises UsageError if an input is not finite.
        """
        error = attitude_error(wanted, angle, rate, disturbance)
        if abs(math.cos(angle)) < self._minimum_authority:
            return CurrentCommand.without_authority(error)
        held = abs(error) > self._largest_error
        used = math.copysign(self._largest_error, error) if held else error
        sine, cosine = math.sin(used), math.cos(used)
        lag = wanted.rate - rate
        if self._as_in_thesis:
            v = -(self.rate_gain * cosine * lag + self.error_gain * sine)
            acceleration = wanted.acceleration - (v + sine * lag * lag) / cosine
        else:
            # The deceleration `braking` (rad/s^2) is available until the body reaches the angle of the path.
            authority = max(min(math.cos(angle), math.cos(wanted.angle)), 0.0)
            taken = abs(disturbance - self._plant.stiffness * angle / self._plant.inertia)
            braking = max(
                _BRAKING_SHARE * self._strength * authority - taken, _MINIMUM_BRAKING * self._strength
            )
            approach = self._approach(sine, braking)
            v = -self.rate_gain * (cosine * lag + approach)
            acceleration = wanted.acceleration - (v + sine * lag * lag) / cosine - disturbance
        demanded = self._plant.current(angle, rate, acceleration)
        return CurrentCommand.within(self._plant.current_limit, demanded, error, held)

    def _approach(self, error: float, braking: float) -> float:
        """Return the rate (1/s) at which `error` is reduced with an available deceleration `braking`."""
        slope = self.error_gain / self.rate_gain
        reach = braking / slope
        if abs(error) * slope <= reach:
            return slope * error
        return math.copysign(math.sqrt(2.0 * braking * abs(error) - reach * reach), error)

    def reset(self) -> None:
        """Do nothing, because the tracker has no internal state."""


def lq_gains(state_weight: float, input_weight: float) -> tuple[float, float]:
    """Return the gains K_e' (1/s) and K_e (1/s^2) for Q = state_weight I and R = input_weight.

    The plant e'' = v, with the error e and the control v, is a double integrator. The Riccati equation of
    this plant (Sease, eqs. (5.28) to (5.32)) has the solution K_e = sqrt(w) and K_e' = sqrt(w + 2 K_e) with w
    = Q / R. A general Riccati solver would take 0.2 s at the start.
    """
    weight = state_weight / input_weight
    error_gain = math.sqrt(weight)
    return math.sqrt(weight + 2.0 * error_gain), error_gain


_REST_ANGLE = 0.03
_REST_RATE = 4.0e-3
_REST_TIME = 1.0
_TIMEOUT = 60.0
_REACH = 0.45  # modelled amplitude divided by the angle bound; the true amplitude may be 1.4 times as large
_WEAK = 0.7  # fraction of the modelled torque that is assumed to be available for braking
_SHORT_PULSE = 1.0


@dataclass(frozen=True, slots=True)
class Pulse:
    """A current pulse of `duration` s, with the fraction `share` (-1 to 1) of the excitation current."""

    share: float
    duration: float


Manoeuvre = tuple[Pulse, ...]


class _Phase(Enum):
    COMING_TO_REST = 0
    MOVING = 1
    GIVEN_UP = 2


@dataclass(frozen=True, slots=True)
class ExcitationSettings:
    """Current, angle and duration of the excitation manoeuvres.

    Attributes:
        current_share: largest current of the pulses and of the tracker, as a fraction of the coil's current
            limit. A fraction below 1 leaves a margin: at the current limit, the true current would differ
            from the commanded current.
        largest_q2: largest quaternion component q2 to which the excitation may rotate the body.
        swing: duration of each free oscillation, s.
    """

    current_share: float
    largest_q2: float
    swing: float


class ExcitationController:
    """A controller that repeats the excitation manoeuvres for as long as commands are requested."""

    def __init__(self, plant: SingleAxisPlant, period: float, settings: ExcitationSettings) -> None:
        """Create the manoeuvres for a plant model and a control period of `period` seconds.

        Raises UsageError if a value is outside its range.
        """
        if not (math.isfinite(period) and period > 0.0):
            raise UsageError(f"excitation period is {period}: it must be finite and positive")
        if not 0.0 < settings.current_share <= 1.0:
            raise UsageError(
                f"excitation current_share is {settings.current_share}: it must lie between 0 and 1"
            )
        if not 0.0 < settings.largest_q2 <= 0.5:
            raise UsageError(f"excitation largest_q2 is {settings.largest_q2}: it must lie between 0 and 0.5")
        gentle = replace(plant, current_limit=plant.current_limit * settings.current_share)
        self._tracker = LqTracker(gentle, state_weight=2.0, input_weight=1.0)
        self._limit = gentle.current_limit
        self._strength = plant.torque_constant * self._limit / plant.inertia
        self._bound = angle_of(settings.largest_q2)
        self._period = period
        self._manoeuvres = manoeuvres(self._strength, _REACH * self._bound, settings.swing)
        self._next = 0
        self._elapsed = 0.0
        self._resting = 0.0
        self._waited = 0.0
        self._phase = _Phase.COMING_TO_REST

    @property
    def gave_up(self) -> bool:
        """Whether the excitation has ended because the tracker failed to bring the body to rest."""
        return self._phase is _Phase.GIVEN_UP

    def command(
        self, wanted: PathSample, angle: float, rate: float, disturbance: float = 0.0
    ) -> CurrentCommand:
        """Return the command for an estimated angle (rad), rate (rad/s) and disturbance (rad/s^2).

        The argument `wanted` contains the angle at which the body rests between manoeuvres. Raises UsageError
        if an input is not finite.
        """
        error = attitude_error(wanted, angle, rate, disturbance)
        if self._phase is _Phase.GIVEN_UP:
            return CurrentCommand.without_authority(error)
        if self._phase is _Phase.MOVING:
            pulse = self._pulse()
            # A manoeuvre continues if the body can still stop within the bound or moves inwards.
            outward = rate if angle >= 0.0 else -rate
            braking = _WEAK * self._strength * math.cos(min(abs(angle), self._bound))
            has_room = abs(angle) + 0.5 * max(outward, 0.0) ** 2 / braking < self._bound
            if pulse is not None and has_room:
                self._elapsed += self._period
                return CurrentCommand.within(self._limit, pulse.share * self._limit, error)
            self._come_to_rest()
        quiet = abs(error) < _REST_ANGLE and abs(rate) < _REST_RATE
        self._resting = self._resting + self._period if quiet else 0.0
        self._waited += self._period
        if self._resting >= _REST_TIME:
            self._phase = _Phase.MOVING
        elif self._waited >= _TIMEOUT:
            self._phase = _Phase.GIVEN_UP
        return self._tracker.command(wanted, angle, rate, disturbance)

    def reset(self) -> None:
        """Abort a manoeuvre that has begun, and bring the body to rest again."""
        if self._phase is _Phase.MOVING:
            self._come_to_rest()
        self._resting = 0.0

    def _pulse(self) -> Pulse | None:
        """Return the present pulse of the manoeuvre, or None if the manoeuvre has ended."""
        begin = 0.0
        for pulse in self._manoeuvres[self._next % len(self._manoeuvres)]:
            begin += pulse.duration
            if self._elapsed < begin - 1e-9:
                return pulse
        return None

    def _come_to_rest(self) -> None:
        self._phase = _Phase.COMING_TO_REST
        self._next += 1
        self._elapsed = self._resting = self._waited = 0.0


def manoeuvres(strength: float, reach: float, swing: float) -> tuple[Manoeuvre, ...]:
    """Return manoeuvres whose pulses of `strength` rad/s^2 rotate the body by up to `reach` rad.

    A pulse of T seconds followed by an opposite pulse rotates a body from rest to rest by strength * T^2.
    """
    out = math.sqrt(reach / strength)
    made = []
    for sign in (1.0, -1.0):
        made.append(_out_and_back(sign, 0.75 * out) + _out_and_back(-sign, min(_SHORT_PULSE, 0.5 * out)))
        made.append((Pulse(sign, out), Pulse(-sign, out), Pulse(0.0, swing)))
    return tuple(made)


def _out_and_back(sign: float, duration: float) -> Manoeuvre:
    return Pulse(sign, duration), Pulse(-sign, 2.0 * duration), Pulse(sign, duration)
