"""Control about one axis: the LQ tracker, and an excitation from which the plant can be identified.

The tracker applies feedback linearisation to the attitude error, then a linear-quadratic regulator (Sease
2013, 5.16-5.32). With p the path and q the body, 5.17-5.20 give e = sin(theta_p - theta) exactly (5.21), and
5.24-5.27 corrected are

    e'  = cos(d) (theta_p' - w)
    e'' = cos(d) (theta_p'' - w') - sin(d) (theta_p' - w)^2,     d = theta_p - theta.

e'' = v is solved for w' and the plant model gives the current; v = -K (e', e) with K from the Riccati
equation.

Two things go beyond the thesis; `as_in_thesis` restores its loop. First, the estimated disturbance is fed
forward. The estimator integrates the acceleration that the model did not predict, so that a constant torque
leaves no offset. It knows the current that was written, limits included, so that nothing winds up while
the coil saturates. Second, an error is reduced no faster than the coil can decelerate: at the rate s e,
s = K_e / K_e', up to a distance, and beyond it at sqrt(2 A |e| - (A / s)^2), from which a constant
deceleration A leads to that distance (the proximate time-optimal servo, Workman 1987, here with a continuous
slope too). A linear law overshoots there.

e is monotone in d only up to 90 degrees. Beyond `largest_error` d is clamped, its sign kept, so that the
demand stays bounded and does not weaken as sin(d) falls again.

The excitation follows no path. The tracker brings the body to rest. Long and short pulses then rotate the
body out and back (torque constant, delay), and further pulses displace it and release it with the coils at
zero (stiffness, damping: the current of a coil that is off is known exactly). The same follows with the other
sign. Between manoeuvres, and whenever the body would leave the bound even if stopped at once, the tracker
commands the coil. If the tracker cannot bring the body to rest, the current stays zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum
from typing import Protocol

from knightcube.errors import UsageError
from knightcube.gnc.guidance.one_axis.plant import PathSample, SingleAxisPlant, angle_of


@dataclass(frozen=True, slots=True)
class CurrentCommand:
    """A controller's command to the coil.

    Attributes:
        current: A, within the limit.
        demanded: A, before the limit; zero without authority.
        saturated: the limit was applied.
        authority: cos(theta) was large enough to make a torque; when False the current is zero.
        error: theta_p - theta in rad, as measured, in [-pi, pi].
        held: the error exceeded the largest allowed and was clamped to it.
    """

    current: float
    demanded: float
    saturated: bool
    authority: bool
    error: float
    held: bool = False

    @classmethod
    def within(cls, limit: float, demanded: float, error: float, held: bool = False) -> CurrentCommand:
        """Return the command for `demanded` A, limited to +-`limit` A."""
        current = min(max(demanded, -limit), limit)
        return cls(current, demanded, current != demanded, True, error, held)

    @classmethod
    def without_authority(cls, error: float) -> CurrentCommand:
        """Return the zero command for an angle at which no current turns the body."""
        return cls(0.0, 0.0, False, False, error)


class AngleController(Protocol):
    """Computes a coil current from the commanded and the estimated motion, once per control cycle."""

    def command(
        self, wanted: PathSample, angle: float, rate: float, disturbance: float = 0.0
    ) -> CurrentCommand:
        """Return the command at `angle` rad, `rate` rad/s under `disturbance` rad/s^2, all estimated.

        Raises UsageError when an input is not finite.
        """

    def reset(self) -> None:
        """Clear integrated state, after the coils were off or the state was lost."""


def attitude_error(wanted: PathSample, angle: float, rate: float, disturbance: float) -> float:
    """Return theta_p - theta in [-pi, pi], rad; raises UsageError when an input is not finite."""
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
    """Computes commands from gains and a plant model; has no state.

    Attributes:
        error_gain, rate_gain: K on e in 1/s^2 and on e' in 1/s.
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
        """Solve the Riccati equation for Q = state_weight I and R = input_weight (5.28-5.32).

        `largest_error` is in rad, below pi/2; `minimum_authority` bounds |cos(theta)|; `as_in_thesis` leaves
        out disturbance and braking. Raises UsageError when a value is outside its range.
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
        """Return the command at `angle` rad, `rate` rad/s under `disturbance` rad/s^2, all estimated.

        Raises UsageError when an input is not finite.
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
            # The deceleration available between here and the path, rad/s^2.
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
        """Return the rate at which to reduce `error`, 1/s, with its sign."""
        slope = self.error_gain / self.rate_gain
        reach = braking / slope
        if abs(error) * slope <= reach:
            return slope * error
        return math.copysign(math.sqrt(2.0 * braking * abs(error) - reach * reach), error)

    def reset(self) -> None:
        """Do nothing: the tracker has no state."""


def lq_gains(state_weight: float, input_weight: float) -> tuple[float, float]:
    """Return K, on e' in 1/s and on e in 1/s^2, for Q = state_weight I and R = input_weight (5.28-5.32).

    The plant e'' = v is a double integrator, whose Riccati equation has the solution, with w = Q / R,
    K_e = sqrt(w) and K_e' = sqrt(w + 2 K_e). A general solver would take 0.2 s at start.
    """
    weight = state_weight / input_weight
    error_gain = math.sqrt(weight)
    return math.sqrt(weight + 2.0 * error_gain), error_gain


_REST_ANGLE = 0.03
_REST_RATE = 4.0e-3
_REST_TIME = 1.0
_TIMEOUT = 60.0
_REACH = 0.45  # of the bound: a body with 1.4 times the modelled response stays within it
_WEAK = 0.7  # of the modelled torque is assumed available for braking
_SHORT_PULSE = 1.0


@dataclass(frozen=True, slots=True)
class Pulse:
    """A share of the excitation's current, in [-1, 1], for `duration` s."""

    share: float
    duration: float


Manoeuvre = tuple[Pulse, ...]


class _Phase(Enum):
    COMING_TO_REST = 0
    MOVING = 1
    GIVEN_UP = 2


@dataclass(frozen=True, slots=True)
class ExcitationSettings:
    """Amplitudes of the excitation.

    Attributes:
        current_share: fraction of the coil's limit, for pulses and tracker; at the limit itself the true
            current differs from the commanded one.
        largest_q2: the excitation never moves the body beyond.
        swing: duration of each free swing, s.
    """

    current_share: float
    largest_q2: float
    swing: float


class ExcitationController:
    """Runs the manoeuvres in turn for as long as commands are requested."""

    def __init__(self, plant: SingleAxisPlant, period: float, settings: ExcitationSettings) -> None:
        """Build the manoeuvres for the plant model `plant`, commanded every `period` s.

        Raises UsageError when a value is outside its range.
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
        """Whether the tracker failed to bring the body to rest."""
        return self._phase is _Phase.GIVEN_UP

    def command(
        self, wanted: PathSample, angle: float, rate: float, disturbance: float = 0.0
    ) -> CurrentCommand:
        """Return the command at `angle` rad, `rate` rad/s under `disturbance` rad/s^2, all estimated.

        `wanted` is the rest position between manoeuvres. Raises UsageError when an input is not finite.
        """
        error = attitude_error(wanted, angle, rate, disturbance)
        if self._phase is _Phase.GIVEN_UP:
            return CurrentCommand.without_authority(error)
        if self._phase is _Phase.MOVING:
            pulse = self._pulse()
            # The body can be stopped within the bound, or moves inwards.
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
        """Bring the body to rest again; a manoeuvre that was under way is skipped."""
        if self._phase is _Phase.MOVING:
            self._come_to_rest()
        self._resting = 0.0

    def _pulse(self) -> Pulse | None:
        """Return the current pulse; None when the manoeuvre is over."""
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
    """Return the manoeuvres with pulses of `strength` rad/s^2 that turn the body by up to `reach` rad.

    From rest a pulse and its opposite, T s each, turn the body by strength T^2.
    """
    out = math.sqrt(reach / strength)
    made = []
    for sign in (1.0, -1.0):
        made.append(_out_and_back(sign, 0.75 * out) + _out_and_back(-sign, min(_SHORT_PULSE, 0.5 * out)))
        made.append((Pulse(sign, out), Pulse(-sign, out), Pulse(0.0, swing)))
    return tuple(made)


def _out_and_back(sign: float, duration: float) -> Manoeuvre:
    return Pulse(sign, duration), Pulse(-sign, 2.0 * duration), Pulse(sign, duration)
