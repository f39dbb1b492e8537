"""Excitation: a controller that follows no path but moves the body so that its constants can be identified.

The tracker brings the body to rest. Long and short pulses then turn the body out and back (torque constant,
delay), and further pulses displace it and release it with the coils at zero (stiffness, damping: the current
of a coil that is off is known exactly). The same follows with the other sign. Between manoeuvres, and
whenever the body would leave the bound even if stopped at once, the tracker commands the coil; if the tracker
cannot bring the body to rest, the current stays zero for good. The log holds the current, whichever commanded
it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum

from knightcube.errors import UsageError
from knightcube.gnc.control.one_axis.lq_tracker import CurrentCommand, LqTracker, attitude_error
from knightcube.gnc.guidance.one_axis.path import PathSample
from knightcube.gnc.guidance.one_axis.plant import SingleAxisPlant, angle_of

_REST_ANGLE = 0.03
_REST_RATE = 4.0e-3
_REST_TIME = 1.0
_PATIENCE = 60.0
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
            if pulse is not None and self._has_room(angle, rate):
                self._elapsed += self._period
                return CurrentCommand.within(self._limit, pulse.share * self._limit, error)
            self._come_to_rest()
        self._wait(error, rate)
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

    def _has_room(self, angle: float, rate: float) -> bool:
        """Return whether the body can be stopped within the bound, or moves inwards."""
        outward = rate if angle >= 0.0 else -rate
        braking = _WEAK * self._strength * math.cos(min(abs(angle), self._bound))
        run_out = 0.5 * max(outward, 0.0) ** 2 / braking
        return abs(angle) + run_out < self._bound

    def _come_to_rest(self) -> None:
        self._phase = _Phase.COMING_TO_REST
        self._next += 1
        self._elapsed = self._resting = self._waited = 0.0

    def _wait(self, error: float, rate: float) -> None:
        """Begin the next manoeuvre once the body has rested long enough; give up when that takes too long."""
        quiet = abs(error) < _REST_ANGLE and abs(rate) < _REST_RATE
        self._resting = self._resting + self._period if quiet else 0.0
        self._waited += self._period
        if self._resting >= _REST_TIME:
            self._phase = _Phase.MOVING
        elif self._waited >= _PATIENCE:
            self._phase = _Phase.GIVEN_UP


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
