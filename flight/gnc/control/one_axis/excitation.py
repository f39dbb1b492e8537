"""The excitation: a controller that goes no path but moves the body so that its constants show.

Brought to rest by the tracker, the body is turned out and back by long and by short pulses (torque constant,
delay), then put aside and let go with the coils at zero (stiffness, damping: a coil that is off has no error
in its current). Then the same with the other sign. Between the manoeuvres, and whenever the body would leave
the bound even if braked at once, the tracker has the coil; if that cannot bring the body to rest, the current
stays zero for good. Whoever wanted a current, it stands in the log.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum

from flight.gnc.control.one_axis.controller import CoilCommand, attitude_error
from flight.gnc.control.one_axis.lq_tracker import LqTracker
from flight.gnc.errors import UsageError
from flight.gnc.guidance.one_axis.path import Sample
from flight.gnc.guidance.one_axis.plant import SingleAxisPlant, angle_of

_REST_ANGLE = 0.03
_REST_RATE = 4.0e-3
_REST_TIME = 1.0
_PATIENCE = 60.0
_REACH = 0.45  # of the bound: a body 1.4 times as lively as believed stays clear of it
_WEAK = 0.7  # of the believed torque counts when the room to brake is reckoned
_SHORT_PULSE = 1.0


@dataclass(frozen=True, slots=True)
class Pulse:
    """A share of the excitation's current, in [-1, 1], for some s."""

    share: float
    duration: float


Manoeuvre = tuple[Pulse, ...]


class _Phase(Enum):
    COMING_TO_REST = 0
    MOVING = 1
    GIVEN_UP = 2


@dataclass(frozen=True, slots=True)
class ExcitationSettings:
    """How hard and how far.

    Attributes:
        current_share: of the coil's limit, for pulses and tracker: at the limit itself the true current is
            not the commanded one.
        largest_q2: which the body never leaves by the excitation's doing.
        swing: s of each free swing.
    """

    current_share: float
    largest_q2: float
    swing: float


class ExcitationController:
    """Flies the manoeuvres one after the other, for as long as it is asked for commands."""

    def __init__(self, plant: SingleAxisPlant, period: float, settings: ExcitationSettings) -> None:
        """Lay the manoeuvres out for the believed `plant`, commanded every `period` s.

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
        """Whether the tracker could not bring the body to rest."""
        return self._phase is _Phase.GIVEN_UP

    def command(self, wanted: Sample, angle: float, rate: float, disturbance: float = 0.0) -> CoilCommand:
        """Return the command at `angle` rad, `rate` rad/s under `disturbance` rad/s^2, all estimated.

        `wanted` is where the body rests between manoeuvres. Raises UsageError when an input is not finite.
        """
        error = attitude_error(wanted, angle, rate, disturbance)
        if self._phase is _Phase.GIVEN_UP:
            return CoilCommand.without_authority(error)
        if self._phase is _Phase.MOVING:
            pulse = self._pulse()
            if pulse is not None and self._has_room(angle, rate):
                self._elapsed += self._period
                return CoilCommand.within(self._limit, pulse.share * self._limit, error)
            self._come_to_rest()
        self._wait(error, rate)
        return self._tracker.command(wanted, angle, rate, disturbance)

    def reset(self) -> None:
        """Begin again with bringing the body to rest; the manoeuvre that was under way is left out."""
        if self._phase is _Phase.MOVING:
            self._come_to_rest()
        self._resting = 0.0

    def _pulse(self) -> Pulse | None:
        """Return the pulse of now, None when the manoeuvre is over."""
        begin = 0.0
        for pulse in self._manoeuvres[self._next % len(self._manoeuvres)]:
            begin += pulse.duration
            if self._elapsed < begin - 1e-9:
                return pulse
        return None

    def _has_room(self, angle: float, rate: float) -> bool:
        """Tell whether the body can be stopped within the bound, or turns back by itself."""
        outward = rate if angle >= 0.0 else -rate
        braking = _WEAK * self._strength * math.cos(min(abs(angle), self._bound))
        run_out = 0.5 * max(outward, 0.0) ** 2 / braking
        return abs(angle) + run_out < self._bound

    def _come_to_rest(self) -> None:
        self._phase = _Phase.COMING_TO_REST
        self._next += 1
        self._elapsed = self._resting = self._waited = 0.0

    def _wait(self, error: float, rate: float) -> None:
        """Begin the next manoeuvre once the body has been at rest for a while."""
        quiet = abs(error) < _REST_ANGLE and abs(rate) < _REST_RATE
        self._resting = self._resting + self._period if quiet else 0.0
        self._waited += self._period
        if self._resting >= _REST_TIME:
            self._phase = _Phase.MOVING
        elif self._waited >= _PATIENCE:
            self._phase = _Phase.GIVEN_UP


def manoeuvres(strength: float, reach: float, swing: float) -> tuple[Manoeuvre, ...]:
    """Return the manoeuvres for pulses of `strength` rad/s^2 that turn the body out to `reach` rad.

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
