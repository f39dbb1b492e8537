"""The coil monitor: detects broken coils from commands, supply current and motion, and identifies the fault.

Each cycle the loop passes the commands (`commanded`, `interrupted`), the samples of the inertial unit
(`observe_motion`) and the newest reading of the current monitor (`measured`) to `CoilMonitor`, and then reads
`verdicts`, `available`, `resting`, `braked`, `at_rest`, `probe`, `suspicion` and `monitor_doubted`. No call
waits. `CoilKnowledge` states whether the coil currents are known: they are unknown while the PWM driver
fails, after the loop has stalled, and while the supply current contradicts the commands.

The current monitor measures the sum of |I| of three bridges, so it cannot detect a reversed coil, and detects
an open coil only while that axis is commanded: axes that are not driven are not judged. Every reading is
compared with the prediction of each hypothesis (healthy; each axis open, shorted, either leg of either input
stuck; see `flight.loop.coil_response`). There is a verdict when `healthy` is rejected and the hypotheses that
explain the readings since then all name one axis; between axes that are not driven, a small probe current on
each axis in turn decides. A reversed coil is found from the angular acceleration, which also distinguishes a
wrong monitor from a broken coil; over longer bins the acceleration also shows missing torque at currents that
are too small for the monitor.

A leg stuck high is found by setting the coils to zero and braking bridges. Braking (both inputs high) removes
the voltage from any coil, whether its bridge is healthy or not. When the supply current is far too large or
too small, all coils are commanded to zero. A current that remains is caused by a fault. All bridges are then
braked at once. If the current stops, the bridges are released one by one, and the bridge with which the
current returns is broken. During this search no healthy coil carries current, and no other verdict is given.
If neither zero commands nor braking change the current, as with a shorted coil or a wrong monitor, the search
ends. When commands change continuously, as in the windows of B-dot detumbling, the command during an ADC
sample is ambiguous. The coils are then commanded to zero every few seconds as a check, without a suspicion.

A reversed coil draws the same supply current as a healthy coil, so that the monitor cannot confirm the
verdict. In a tumble the motion depends more on the inertia than on the coils. A coil that looks reversed in a
tumble is therefore not isolated. It is kept at zero current, and used and judged again when the body is
slower than `tumble_rate`, or after ten minutes.

The bounds are the thesis's 3.5 mA on each coil's current (Sease 2013 ch. 5), the resistance's error, and the
18 % error of a single ADC sample of the chopped current (`hal.drivers.ina219`).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum, auto

import numpy as np

from flight.loop.coil_response import (
    ELECTRICAL,
    MEAN,
    NEWEST,
    Bounds,
    CoilCommands,
    CoilFault,
    CoilResponse,
    MotionWitness,
    Predicted,
    ResponseSettings,
    Sampling,
    Supplied,
    fits,
    predict,
)
from hal.interfaces.devices import NO_AXES, Axes, CoilState, PowerReading
from knightcube.astro.arrays import BoolArray, FloatArray

_SURE = 2
"""Number of ADC samples in a row that must agree."""
_PATIENCE = 12
"""Number of ADC samples without agreement after which a step is given up."""
_PAUSE = 50
"""Number of ADC samples between a check at zero command that found no fault and the next check."""
_UNCLEAR = 20
"""Number of ADC samples in a row with an ambiguous command after which the coils are checked at zero."""


class _Step(Enum):
    WATCHING = auto()
    RESTING = auto()
    ALL_BRAKED = auto()
    ONE_RELEASED = auto()
    NO_CURE = auto()


class StuckLeg:
    """Searches for a stuck leg: processes ADC samples, requests rest and brakes, and returns an axis.

    Attributes:
        brake: which bridges must be braked now.
        rest: whether all commands must be zero now.
        suspicion: reason for the search; empty without a search.
    """

    def __init__(self, excess: float) -> None:
        """`excess` is the smallest excess current (A) that indicates a fault."""
        self._excess = excess
        self._pause = self._unclear = 0
        self._high = self._short = self._normal = self._looks = 0
        self.reset()

    def reset(self) -> None:
        """Release all bridges and end the search."""
        self._step = _Step.WATCHING
        self._left: list[int] = []
        self._braked: tuple[int, ...] = ()
        self._await()
        self.brake = NO_AXES
        self.rest = False
        self.suspicion = ""

    @property
    def is_searching(self) -> bool:
        """Whether a search is running, during which the coils are at zero command and may be braked."""
        return self.rest

    def exceeds(self, supplied: Supplied) -> bool:
        """Return whether an ADC sample exceeds the current of healthy coils."""
        return supplied.current > supplied.most + self._excess

    def ask_for_rest(self, why: str) -> None:
        """Request zero commands, unless a search is running or the last request was too recent."""
        if self._step is _Step.WATCHING and not self._pause:
            self._rest(why)

    def look(self, supplied: Supplied) -> int | None:
        """Process an ADC sample; return the axis of a stuck leg once it is found."""
        self._pause = max(self._pause - 1, 0)
        if self.rest and supplied.driven:
            return None  # the coils are not yet at rest
        high = self.exceeds(supplied)
        short = supplied.current < supplied.least - self._excess
        self._high = self._high + 1 if high else 0
        self._short = self._short + 1 if short else 0
        self._normal = 0 if high or short else self._normal + 1
        self._looks += 1
        if self.is_searching and self._looks > _PATIENCE:
            self._give_up()  # an intermittent current is not a stuck leg
            return None
        self._unclear = self._unclear + 1 if supplied.spread > self._excess else 0
        if self._unclear >= _UNCLEAR and self._step is _Step.WATCHING:
            self._rest("")
            return None
        if self._high >= _SURE:
            return self._judge_too_much(supplied)
        if self._short >= _SURE and self._step is _Step.WATCHING:
            self._put_to_rest(supplied)
        elif self._normal >= _SURE:
            self._judge_normal()
        return None

    def _judge_too_much(self, supplied: Supplied) -> int | None:
        match self._step:
            case _Step.WATCHING if supplied.driven:
                self._put_to_rest(supplied)
            case _Step.WATCHING | _Step.RESTING if supplied.at_rest:
                self._brake_all(supplied)
            case _Step.ONE_RELEASED:
                found = self._left[0]
                self.reset()
                return found
            case _:
                self._give_up()
        return None

    def _judge_normal(self) -> None:
        match self._step:
            case _Step.RESTING if not self.suspicion:
                self.reset()
            case _Step.RESTING:
                self._pause = _PAUSE
                self._give_up()
            case _Step.ALL_BRAKED:
                self._release_next()
            case _Step.ONE_RELEASED:
                del self._left[0]
                self._release_next()
            case _Step.NO_CURE:
                self.reset()
            case _Step.WATCHING:
                pass

    def _brake_all(self, supplied: Supplied) -> None:
        self.suspicion = self.suspicion or _reason(supplied)
        self._step, self._left, self._braked = (
            _Step.ALL_BRAKED,
            list(supplied.at_rest),
            tuple(supplied.at_rest),
        )
        self.brake, self.rest = _only(supplied.at_rest), True
        self._await()

    def _put_to_rest(self, supplied: Supplied) -> None:
        if self._pause:
            self._give_up()
            return
        self._rest(_reason(supplied))

    def _rest(self, why: str) -> None:
        self.suspicion = self.suspicion or why
        self._step = _Step.RESTING
        self.brake, self.rest = NO_AXES, True
        self._await()

    def _release_next(self) -> None:
        """Release the next bridge; end the search after the last bridge."""
        if not self._left:
            self.reset()
            return
        self._step = _Step.ONE_RELEASED
        self.brake = _only([axis for axis in self._braked if axis != self._left[0]])
        self._await()

    def _give_up(self) -> None:
        """End the search until the current is normal again."""
        self.reset()
        self._step = _Step.NO_CURE

    def _await(self) -> None:
        self._high = self._short = self._normal = self._looks = 0


def _reason(supplied: Supplied) -> str:
    due = f"{1e3 * max(supplied.least, 0.0):.0f} to {1e3 * supplied.most:.0f} mA"
    return f"supply current {1e3 * supplied.current:.0f} mA where {due} are due"


def _only(axes: Sequence[int]) -> Axes:
    return 0 in axes, 1 in axes, 2 in axes


_PROOFS = 2
"""Number of ADC samples in a row that must agree."""


class BrakeProof:
    """Collects ADC samples to confirm that the braked bridges have a leg stuck high."""

    def __init__(self) -> None:
        self._axes: set[int] = set()
        self._exceeds: deque[bool] = deque(maxlen=_PROOFS)

    def __bool__(self) -> bool:
        """Return whether any brake is unconfirmed."""
        return bool(self._axes)

    def add(self, axis: int) -> None:
        """Add an axis that is braked because of a verdict, without confirmation."""
        self._axes.add(axis)

    def discard(self, axis: int) -> None:
        """Remove an axis."""
        self._axes.discard(axis)

    def ingest(self, exceeds: bool) -> frozenset[int]:
        """Accept whether an ADC sample shows current despite braking.

        Return the axes that were braked wrongly.
        """
        self._exceeds.append(exceeds)
        if len(self._exceeds) < _PROOFS:
            return frozenset()
        wrong = frozenset(self._axes) if all(self._exceeds) else frozenset()
        if len(set(self._exceeds)) == 1:
            self._axes.clear()
            self._exceeds.clear()
        return wrong


@dataclass(frozen=True, slots=True)
class CoilVerdict:
    """The fault of one axis, numbered 0, 1, 2 for x, y, z."""

    axis: int
    fault: CoilFault
    time_ns: int
    text: str


@dataclass(frozen=True, slots=True)
class CoilMonitorSettings:
    """Properties of the coils' circuit and of the monitor.

    Attributes:
        full_current: current of a coil that is fully on, A: supply voltage divided by resistance.
        current_uncertainty: bound (A) on the deviation of each driven coil's current from its command.
        gain_error: relative error bound due to resistance, supply voltage, and sampling of the chopped
            current.
        monitor_noise: error bound of the monitor at any current, A.
        window_ns: averaging time of a reading's mean. A longer gap between readings resets the monitor.
        persistence: number of readings in a row inconsistent with a healthy circuit that raise a suspicion.
        settle: number of further readings until the averaging window lies entirely after the fault.
        evidence: number of readings that a verdict needs.
        probe_current: amplitude (A) of the square wave that distinguishes faults of axes that are not driven.
        probe_half_ns: half the period of this square wave, ns.
        response: the body's response to the coils; None if the motion is not used.
        slow: as `response`, with longer bins, which show the torque of currents below the monitor's noise.
        tumble_rate: body rate (rad/s) above which a coil that looks reversed is kept at zero current.
    """

    full_current: tuple[float, float, float]
    current_uncertainty: float = 3.5e-3
    gain_error: float = 0.2
    monitor_noise: float = 1.5e-3
    window_ns: int = 1_100_000_000
    persistence: int = 3
    settle: int = 2
    evidence: int = 3
    probe_current: float = 0.04
    probe_half_ns: int = 800_000_000
    response: ResponseSettings | None = None
    slow: ResponseSettings | None = None
    tumble_rate: float = math.inf


_UNSEEN_NS = 600_000_000
"""Largest age (ns) of an error when it is detected; the driver reads its outputs back twice a second."""
_UNSUSPECTED_NS = 800_000_000
"""Longest time (ns) between a fault and its suspicion, which is four readings of the monitor."""
STOOD_NS = 200_000_000
"""Stall of the loop (ns) after which the guardian may have zeroed the coils."""


@dataclass(frozen=True, slots=True)
class CurrentValidity:
    """Whether the coil currents are known.

    Attributes:
        now: whether the currents in force are known.
        since_last_look: whether the chip kept all commands since the previous look.
        since_ns: time (ns) since which the currents are known.
        uncertain_since_ns: time (ns) from which currents that were recorded as known are uncertain; else
            None.
    """

    now: bool
    since_last_look: bool
    since_ns: int
    uncertain_since_ns: int | None


class CoilKnowledge:
    """Determines once a cycle whether the coil currents are known."""

    def __init__(self) -> None:
        self._obeys = True
        self._suspected = False
        self._since_ns = -1
        self._looked_ns: int | None = None

    def look(self, in_force: CoilState, now_ns: int, *, suspected: bool = False) -> CurrentValidity:
        """Return which currents are known, from the driver's state and the time since the last look.

        `suspected` is whether the supply current contradicts a healthy circuit, so that a coil current may be
        arbitrary.
        """
        obeyed, self._obeys = self._obeys, not in_force.error
        was_suspected, self._suspected = self._suspected, suspected
        looked_ns, self._looked_ns = self._looked_ns, now_ns
        stood = looked_ns is not None and now_ns - looked_ns > STOOD_NS
        since_last_look = obeyed and self._obeys and not stood
        now = self._obeys and not suspected
        if now and (was_suspected or not since_last_look):
            self._since_ns = now_ns
        uncertain = [now_ns - _UNSEEN_NS] if obeyed and not self._obeys else []
        if suspected and not was_suspected:
            uncertain.append(now_ns - _UNSUSPECTED_NS)
        if looked_ns is not None and stood:
            uncertain.append(looked_ns)
        return CurrentValidity(now, since_last_look, self._since_ns, min(uncertain, default=None))


class Probe:
    """Applies a square wave with zero mean to one axis after the other.

    The two halves last `half_ns` each and carry +`current` and -`current` (A), so that the mean torque is
    zero.
    """

    def __init__(self, current: float, half_ns: int) -> None:
        self._current = current
        self._half_ns = half_ns
        self._running: tuple[int, int] | None = None  # axis, and start time (ns)
        self._tried: set[int] = set()

    def begin(self, axes: set[int], now_ns: int) -> int | None:
        """Begin a wave on the next untried axis of `axes`; return its end (ns), None if all were tried."""
        candidates = sorted(axes - self._tried)
        if not candidates:
            self._tried.clear()
            return None
        self._tried.add(candidates[0])
        self._running = (candidates[0], now_ns)
        return now_ns + 2 * self._half_ns

    def stop(self) -> None:
        """End the wave; count all axes as untried."""
        self._running = None
        self._tried.clear()

    def wave(self, now_ns: int) -> FloatArray:
        """Return the currents (3,) A to add to the commands at `now_ns`."""
        wave = np.zeros(3)
        if self._running is not None:
            axis, since_ns = self._running
            half = (now_ns - since_ns) // self._half_ns
            if half < 2:
                wave[axis] = self._current * (1.0 if half == 0 else -1.0)
            else:
                self._running = None
        return wave


AXES = "xyz"

_BRAKED = {CoilFault.A_HIGH, CoilFault.B_HIGH, CoilFault.HIGH}
_STUCK_EXCESS = 0.3
"""Minimum excess current of a leg stuck high, as a fraction of the current of a coil that is fully on."""
_LEAST_SHORT = 0.02
"""Minimum excess current (A) of a shorted coil that the motion of the body can confirm."""
_READING_NS = 200_000_000
_MOST_EVIDENCE = 40
_IN_DOUBT = 5
"""Number of readings after which a verdict may name an axis without a kind of fault."""
_LONGEST_REST_NS = 600_000_000_000
"""Longest time (ns) at zero current for a coil that looks reversed in a tumble."""


class CoilMonitor:
    """Detects broken coils from the commands and readings of the last seconds.

    Longer than 200 lines because all methods share the state of one suspicion, from detection to verdict.

    Attributes:
        tumble_rate: rate (rad/s) above which no coil is isolated by the motion alone.
    """

    def __init__(self, settings: CoilMonitorSettings) -> None:
        self._settings = settings
        self.tumble_rate = settings.tumble_rate
        self._bounds = Bounds(
            settings.full_current,
            settings.current_uncertainty,
            settings.gain_error,
            settings.monitor_noise,
        )
        self._commands = CoilCommands(2 * settings.window_ns)
        self._reading_ns = -(1 << 62)
        self._fresh = 0
        self._strange = 0
        self._suspected_ns: int | None = None
        self._judge_ns = 0  # time (ns) after which a verdict needs no kind of fault
        self._sound_ns = 0  # time at which a driven coil last drew the expected current
        self._unmixed_ns = 0  # time after which a reading's mean covers one state of the circuit
        self._evidence: deque[Predicted] = deque(maxlen=_MOST_EVIDENCE)
        self._probe = Probe(settings.probe_current, settings.probe_half_ns)
        self._response = None if settings.response is None else CoilResponse(settings.response)
        self._slow = None if settings.slow is None else CoilResponse(settings.slow)
        self._weak = ""  # the coil whose torque is missing in the motion, as text
        self._verdicts: dict[int, CoilVerdict] = {}
        # By resting axis: time at which its rest began, and the reason.
        self._rests: dict[int, tuple[int, str]] = {}
        self._looked_ns = 0
        self._leg = StuckLeg(_STUCK_EXCESS * min(settings.full_current))
        self._proof = BrakeProof()
        self._witness = MotionWitness(self._response, settings.full_current)
        self._strangeness = ""

    @property
    def verdicts(self) -> tuple[CoilVerdict, ...]:
        """The broken axes, at most one verdict each, in the order found; kept until `forget`."""
        return tuple(self._verdicts.values())

    @property
    def available(self) -> BoolArray:
        """Flags (3,) of the axes that may be used, for `knightcube.gnc.control.allocation`."""
        return np.array([axis not in self._verdicts for axis in range(3)])

    @property
    def resting(self) -> BoolArray:
        """Flags (3,) of the axes that are kept at zero current because they look reversed in a tumble."""
        return np.array([axis in self._rests for axis in range(3)])

    @property
    def suspicion(self) -> str:
        """Why a coil is suspected; empty while the readings are consistent with a healthy circuit."""
        rests = "; ".join(why for _, why in self._rests.values())
        return self._unknown or rests

    @property
    def doubts_currents(self) -> bool:
        """Whether the current of a coil in use may differ from its command."""
        return bool(self._unknown)

    @property
    def _unknown(self) -> str:
        """Why a coil's current may differ from its command; empty if it does not."""
        return self._leg.suspicion or self._strangeness or self._weak

    @property
    def braked(self) -> Axes:
        """The bridges to brake: bridges with a leg stuck high, and bridges under test in the search."""
        if not self._verdicts:
            return self._leg.brake
        x, y, z = (
            asked or (axis in self._verdicts and self._verdicts[axis].fault in _BRAKED)
            for axis, asked in enumerate(self._leg.brake)
        )
        return x, y, z

    @property
    def at_rest(self) -> bool:
        """Whether all commands must be zero now, to reveal a leg stuck high."""
        return self._leg.rest

    def forget(self, axis: int) -> None:
        """Discard the verdict on an axis, on command. A lasting fault is detected again."""
        self._verdicts.pop(axis, None)
        self._rests.pop(axis, None)
        self._proof.discard(axis)
        self.interrupted(self._commands.newest_ns if self._commands else 0)

    def commanded(
        self, time_ns: int, currents: FloatArray, braked: Axes = NO_AXES, written_ns: int | None = None
    ) -> None:
        """Record the currents (3,) A and brakes on the wire at `time_ns`, written at `written_ns` or then."""
        values = tuple(currents.tolist())
        self._commands.note(time_ns, values, braked)
        # Without readings of the monitor, the search would never end.
        if self._leg.is_searching and time_ns - self._looked_ns > self._settings.window_ns:
            self._leg.reset()
        for response in self._responses:
            response.commanded(time_ns if written_ns is None else written_ns, values)

    def observe_motion(self, time_ns: int, rate: FloatArray, field: FloatArray) -> None:
        """Add a sample of the body rate (3,) rad/s and the magnetic field (3,) T, body axes."""
        if self._rests:
            self._end_rests(time_ns, float(np.sqrt(rate @ rate)))
        for response in self._responses:
            if response.observe_motion(time_ns, rate, field):
                self._judge_motion(response, time_ns)

    def _judge_motion(self, response: CoilResponse, now_ns: int) -> None:
        """Give a verdict on a reversed axis, and suspect an axis without torque.

        In a tumble an axis that looks reversed rests without a verdict.
        """
        for axis in response.reversed_axes():
            # An uncommanded current makes a torque too, so that the motion gives no evidence.
            if axis in self._verdicts or axis in self._rests or self._leg.suspicion or self._strangeness:
                continue
            if response.fastest <= self.tumble_rate:
                self._give(axis, CoilFault.REVERSED, now_ns, response.text(axis))
            else:
                why = f"coil {AXES[axis]}: {response.text(axis)}; it rests while the body tumbles"
                self._rests[axis] = now_ns, why
        if response is self._slow:
            known = self._verdicts.keys() | self._rests.keys()
            axes = [axis for axis in response.feeble_axes() if axis not in known]
            # If several coils look weak at once, the gyro or the field is more likely wrong.
            self._weak = f"coil {AXES[axes[0]]}: {response.text(axes[0])}" if len(axes) == 1 else ""

    def _end_rests(self, now_ns: int, speed: float) -> None:
        """Try the resting axes again, on new evidence, once the body is slow or the rest has lasted long."""
        oldest_ns = min(since_ns for since_ns, _ in self._rests.values())
        if speed <= self.tumble_rate or now_ns - oldest_ns > _LONGEST_REST_NS:
            self._rests.clear()
            for response in self._responses:
                response.reset()

    def interrupted(self, now_ns: int) -> None:
        """Discard all evidence until now, because the coil currents of that time are unknown."""
        self._fresh = 0
        self._leg.reset()
        self._reset()
        self._weak = ""
        for response in self._responses:
            response.interrupted(now_ns)

    def measured(self, reading: PowerReading) -> None:
        """Add a reading of the monitor; a repeated reading is ignored."""
        gap_ns = reading.time_ns - self._reading_ns
        if gap_ns <= 0 or not self._commands:
            return
        self._reading_ns = reading.time_ns
        self._look_at_legs(reading)
        if self._leg.is_searching:
            self._unmixed_ns = reading.time_ns
            if self._suspected_ns is None and self._leg.suspicion:
                self._suspect(self._leg.suspicion)
            return
        self._fresh = self._fresh + 1 if gap_ns < self._settings.window_ns else 1
        if self._fresh <= self._settings.settle:
            self._reset()
            self._unmixed_ns = reading.time_ns
            return
        predictions = self._predictions(reading)
        if self._suspected_ns is None:
            self._check_healthy(predictions, reading)
        elif reading.time_ns - self._suspected_ns > self._settle_ns:
            self._evidence.extend(predictions)
            self._judge(reading.time_ns)

    @property
    def probe(self) -> FloatArray:
        """Currents (3,) A to add to the commands now: zero, or the probe's square wave."""
        return self._probe.wave(self._commands.newest_ns) if self._commands else np.zeros(3)

    @property
    def monitor_doubted(self) -> str:
        """Why the current monitor is assumed to be wrong; empty while the monitor is trusted."""
        return self._witness.doubt

    @property
    def _responses(self) -> list[CoilResponse]:
        return [response for response in (self._response, self._slow) if response is not None]

    @property
    def _settle_ns(self) -> int:
        return self._settings.settle * _READING_NS

    @property
    def _known(self) -> dict[int, CoilFault]:
        """The known fault of each broken axis, for the supply current; a braked axis draws no current."""
        return {
            axis: CoilFault.OPEN if verdict.fault in _BRAKED else verdict.fault
            for axis, verdict in self._verdicts.items()
        }

    def _look_at_legs(self, reading: PowerReading) -> None:
        """Search for a leg stuck high, if this ADC sample was made under the present brakes."""
        commands = self._commands
        if commands.braked != self.braked or not commands.is_known_since(reading.newest_since_ns):
            return
        self._looked_ns = reading.time_ns
        seen = commands.supplied(reading, self._bounds, self._known)
        if self._proof:
            for axis in self._proof.ingest(self._leg.exceeds(seen)):  # back to both inputs low
                self._verdicts[axis] = replace(self._verdicts[axis], fault=CoilFault.UNCERTAIN)
            return
        found = self._leg.look(seen)
        if found is not None:
            text = f"{1e3 * reading.newest:.0f} mA without a command"
            self._give(found, CoilFault.HIGH, reading.time_ns, text)
            self.interrupted(reading.time_ns)

    def _predictions(self, reading: PowerReading) -> list[Predicted]:
        """Return predictions of a reading's newest ADC sample, and of its mean if it has one state."""
        windows: list[tuple[float, int, Sampling]] = [(reading.newest, reading.newest_since_ns, NEWEST)]
        begin_ns = reading.time_ns - self._settings.window_ns
        if begin_ns >= self._unmixed_ns:
            windows.append((reading.current, begin_ns, MEAN))
        return [
            predict(
                current,
                self._commands.window(since_ns, reading.time_ns),
                self._bounds,
                sampling,
                reading.clipped,
            )
            for current, since_ns, sampling in windows
        ]

    def _check_healthy(self, predictions: list[Predicted], reading: PowerReading) -> None:
        asked = float(predictions[0].mean[:, 0].sum())
        if all(fits([one], self._bounds, self._known) for one in predictions):
            self._strange = 0
            self._witness.trust_monitor()
            if asked > self._bounds.uncertainty:
                self._sound_ns = reading.newest_since_ns
            return
        self._strange += 1
        if self._strange >= self._settings.persistence:
            why = f"supply current {1e3 * reading.newest:.0f} mA where {1e3 * asked:.0f} are due"
            self._suspect(why)
            if reading.newest > asked > 0.0:
                self._leg.ask_for_rest(why)

    def _suspect(self, why: str) -> None:
        self._suspected_ns = self._unmixed_ns = self._reading_ns
        self._judge_ns = self._reading_ns + self._settle_ns + _IN_DOUBT * _READING_NS
        self._evidence.clear()
        self._strangeness = why

    def _judge(self, now_ns: int) -> None:
        """Give a verdict if the evidence leaves one axis; discard the suspicion of healthy readings."""
        evidence = tuple(self._evidence)
        if len(evidence) < self._settings.evidence:
            return
        if fits(evidence[-8:], self._bounds, self._known):
            self._reset()
            return
        sound = [axis for axis in range(3) if axis not in self._verdicts]
        left = [
            (axis, fault)
            for axis in sound
            for fault in ELECTRICAL
            if fits(evidence, self._bounds, self._known, axis, fault)
        ]
        axes = {axis for axis, _ in left}
        waited = now_ns >= self._judge_ns
        if len(axes) == 1 and (len(left) == 1 or waited):
            axis, fault = left[0]
            self._conclude(axis, fault if len(left) == 1 else CoilFault.UNCERTAIN, now_ns)
        elif waited:
            self._look_further(axes, now_ns)

    def _conclude(self, axis: int, fault: CoilFault, now_ns: int) -> None:
        excess = max(one.current - float(one.mean[:, 0].sum()) for one in self._evidence)
        if fault is CoilFault.SHORTED and excess < _LEAST_SHORT:
            self._reset()  # the motion cannot confirm so small an excess; the monitor may be wrong
            return
        if self._is_contradicted(axis, fault):
            why = f"{self._strangeness}; yet the motion shows no change of coil {AXES[axis]}"
            self._witness.doubt_monitor(why, now_ns)
        else:
            self._give(axis, fault, now_ns, self._strangeness)
            if fault in _BRAKED:
                self._proof.add(axis)
                self._fresh = 0
        self._reset()

    def _is_contradicted(self, axis: int, fault: CoilFault) -> bool:
        if self._suspected_ns is None:
            return False
        begun_ns = min(self._sound_ns, self._suspected_ns - self._settings.window_ns)
        return self._witness.contradicts(axis, fault, begun_ns, self._suspected_ns, self._reading_ns)

    def _look_further(self, axes: set[int], now_ns: int) -> None:
        """Probe the next suspected axis; after the last one, collect new evidence.

        An intermittent fault, or a fault of the monitor, is not explained by any hypothesis.
        """
        ends_ns = self._probe.begin(axes, now_ns)
        if ends_ns is None:
            self._evidence.clear()
            self._judge_ns = now_ns + _IN_DOUBT * _READING_NS
        else:
            self._judge_ns = ends_ns + _READING_NS

    def _give(self, axis: int, fault: CoilFault, now_ns: int, why: str) -> None:
        text = f"coil {AXES[axis]} {fault.value} ({why})"
        self._verdicts[axis] = CoilVerdict(axis, fault, now_ns, text)

    def _reset(self) -> None:
        self._strange = 0
        self._suspected_ns = None
        self._evidence.clear()
        self._probe.stop()
        self._strangeness = ""
