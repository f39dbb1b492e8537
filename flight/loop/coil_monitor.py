"""The coil monitor: detects broken coils from commands, supply current and motion, and identifies the fault.

In each cycle, the loop passes the commands (`commanded`, `interrupted`), the samples of the inertial unit
(`observe_motion`) and the newest reading of the current monitor (`measured`) to `CoilMonitor`. Then the loop
reads the results: `verdicts`, `available`, `resting`, `braked`, `at_rest`, `probe`, `suspicion` and
`monitor_doubted`. No call waits.

The current monitor measures the sum of |I| over all H-bridges. The current monitor cannot detect a reversed
coil, and it detects an open coil only while that coil is driven. Every reading is compared with the
prediction of each hypothesis (`flight.loop.coil_currents`). One hypothesis is that all coils are healthy.
Each other hypothesis assumes one fault of one coil: the coil is open or shorted, or one leg of its H-bridge
is stuck. A coil is diagnosed as broken when the readings reject the hypothesis of healthy coils, and all
hypotheses that explain the later readings concern this coil. If no axis or several axes are driven, several
axes may remain suspected. The suspected axes are driven alone, one after another, by a small probe current.
During the 1.6 s of a probe, the other coils carry no current, so that the probe shows whether its coil draws
current. Coils that have been at zero current since a fault was suspected are probed too, because the control
law may drive them too briefly for a diagnosis. A reversed coil is detected from the angular acceleration,
which also distinguishes a faulty current monitor from a broken coil. Averaged over longer bins, the
acceleration reveals missing torque at currents that are too small for the current monitor. If torque is
missing, a probe shows whether the coil is open. If one gain of the current monitor explains the readings
while different coils are driven, the current monitor is considered faulty, and its later readings are divided
by this gain.

An output leg that is stuck high is found by commanding zero currents and braking the bridges. Braking (both
inputs high) removes the voltage from a coil, whether its bridge is healthy or not. If the supply current is
far too large or too small, all coils are commanded to zero. If current still flows although zero is
commanded, there is a fault, and all bridges are braked at once. If braking stops the current, braking is
ended bridge by bridge. If the current returns when the braking of a bridge ends, that bridge is broken.
During the search for a stuck leg, no healthy coil carries current, and no other fault is diagnosed. The
search ends if neither commanding zero currents nor braking changes the current, as with a shorted coil or a
faulty current monitor. If the commands change continuously, as in the windows of B-dot detumbling, the
command that was in force during an ADC sample is ambiguous. While commands change continuously, all coils are
commanded to zero every few seconds as a check, even if no fault is suspected.

A reversed coil draws the same supply current as a healthy coil, so only the motion of the body can reveal it.
A coil that rotates the body in the wrong direction is not isolated, but used with the opposite sign. A coil
whose torque is too small is used with its estimated gain. The class `CoilCorrection` contains sign and gain
of each coil, and converts actual coil currents to effective currents and back. The actual currents determine
the supply current. Healthy coils with the effective currents would cause the same torque. A correction made
in a tumble is reviewed when the body is slower than `tumble_rate`. In the review, the motion confirms the
coil's sign, or the sign is changed again. A coil whose sign changes more than twice in ten minutes is kept at
zero current until the body is slow, but at most for ten minutes.

The diagnosis of a broken coil is not final. While the body is slow, a broken coil is used again for a trial
ten minutes after its diagnosis, and at most three times. If the fault persists, the coil is diagnosed as
broken again.

The predicted supply current has three error bounds: 3.5 mA for each coil's current (Sease thesis, chapter 5),
the error of the coils' resistance, and 18 % for a single ADC sample of the chopped current
(`hal.drivers.current_monitors`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np

from flight.loop.coil_currents import (
    MEAN,
    NEWEST,
    Bounds,
    BrakeProof,
    CoilFault,
    Commands,
    Evidence,
    Sampling,
    StuckLeg,
    fits,
    is_healthy_current,
    predict,
)
from flight.loop.coil_response import (
    LARGEST_GAIN,
    LONGEST_REST_NS,
    CoilCommands,
    CoilCorrection,
    CoilResponse,
    Finding,
    MotionWitness,
    ResponseSettings,
)
from hal.interfaces.devices import COIL_NAMES, NO_AXES, Axes, PowerReading
from knightcube.astro.arrays import BoolArray, FloatArray


@dataclass(frozen=True, slots=True)
class SelfTestSettings:
    """Settings of the coils' self-test.

    Attributes:
        interval_ns: longest time (ns) without evidence about a coil, after which the coil is tested.
        limits: largest currents (n,), A, of a test.
        gyro_hz: number of gyro samples per second.
    """

    interval_ns: int
    limits: FloatArray
    gyro_hz: float


_SHOWN = 8.0
"""Gain of a healthy coil divided by the standard deviation with which a self-test measures the gain."""
_EFFICIENCY = 0.7
"""Ratio of two standard deviations of a gain: without and with the simultaneous estimation of a constant
torque."""
_SHORTEST_QUARTER, _LONGEST_QUARTER = 1.0, 4.0
"""Minimum and maximum duration (s) of each of the four quarters of a test."""
_GAP_NS = 400_000_000
"""Time (ns) with zero current before a test, during which the magnetic field is measured."""
_CALM_NS = 10_000_000_000
"""Time (ns) for which the commands must be small before a test."""
_QUIET = 0.25
"""Largest commanded current at which a test is made, as a fraction of the largest current of the test."""
_REPORT_NS = 5_000_000_000
"""Time (ns) between the last test and the report, during which the motion is evaluated."""
_NEAR_FIELD_NS = 60_000_000_000
"""Time (ns) after which a coil that was nearly parallel to the magnetic field is tested again."""


class SelfTest:
    """Self-test of rarely used coils by short test currents, whose effect on the body's motion is measured.

    While a satellite points, its coil currents of a few mA reveal neither an open nor a reversed coil. A coil
    that the motion has not confirmed for `interval_ns` is therefore driven alone by a known current with the
    signs +, -, -, + in four equal quarters. After the four quarters of a test, rate and attitude are the same
    as before the test. Duration and current of a test follow from the gyro's noise, so that a test measures
    the gain of a healthy coil with a standard deviation of 1/`_SHOWN`. The largest rotation angle during a
    test is the angular acceleration times the square of the duration of one quarter. `CoilResponse` evaluates
    the response, with the errors of the inertia as nuisance parameters. The supply current is compared with
    the command during a test too.
    """

    def __init__(self, response: CoilResponse, rate_noise: float, settings: SelfTestSettings) -> None:
        """Set the standard deviation `rate_noise` (rad/s) of a gyro sample."""
        self._response, self._settings = response, settings
        self._least = _SHOWN * rate_noise / (_EFFICIENCY * math.sqrt(4.0 * settings.gyro_hz / 3.0))
        self._quiet: list[float] = (_QUIET * settings.limits).tolist()
        self._shown_ns: list[int | None] = [None] * len(settings.limits)
        self._running: tuple[int, int, int, float] | None = None
        self._loud_ns = self._called_ns = 0
        self._tested: dict[int, int] = {}  # end (ns) of each unreported test, by axis

    def request(self) -> None:
        """Test all coils as soon as possible, because the body does not move as commanded."""
        self._shown_ns = [-self._settings.interval_ns] * len(self._shown_ns)

    def stop(self) -> None:
        """End the tests, because a coil is suspected or the correction of a coil has changed."""
        self._running = None
        self._tested.clear()

    def wave(self, wanted: FloatArray, usable: Callable[[], BoolArray], now_ns: int) -> FloatArray | None:
        """Return test currents (n,), A, which drive one coil and replace the `wanted` currents, or None.

        The function `usable`, which is called before a test, returns flags (n,) of the coils to be tested.
        """
        if any(abs(current) > limit for current, limit in zip(wanted.tolist(), self._quiet, strict=True)):
            self._loud_ns, self._running = now_ns, None
        if now_ns - self._called_ns > _GAP_NS:  # another mode has interrupted the test
            self._running = None
        self._called_ns = now_ns
        for axis, shown_ns in enumerate(self._shown_ns):
            if shown_ns is None or self._response.is_healthy(axis):
                self._shown_ns[axis] = now_ns
        if self._running is None and now_ns - self._loud_ns >= _CALM_NS:
            self._begin(usable, now_ns)
        if self._running is None:
            return None
        axis, since_ns, quarter_ns, current = self._running
        quarter = (now_ns - since_ns) // quarter_ns
        currents = np.zeros(len(self._shown_ns))
        if quarter >= 4:
            self._running, self._tested[axis], self._shown_ns[axis] = None, now_ns, now_ns
        elif now_ns >= since_ns:
            currents[axis] = current if quarter in {0, 3} else -current
        return currents

    def report(self, now_ns: int) -> str:
        """Return the results of the last tests as text, once the motion has been evaluated, or ""."""
        if not self._tested or self._running or now_ns - max(self._tested.values()) < _REPORT_NS:
            return ""
        tested, self._tested = sorted(self._tested), {}
        return "; ".join(f"coil {COIL_NAMES[axis]}: {self._response.text(axis)}" for axis in tested)

    def _begin(self, usable: Callable[[], BoolArray], now_ns: int) -> None:
        """Begin the test of the next coil that is due."""
        interval_ns = self._settings.interval_ns
        due = [
            axis
            for axis, shown_ns in enumerate(self._shown_ns)
            if shown_ns is not None and now_ns - shown_ns >= interval_ns
        ]
        due = list(compress(due, usable()[due])) if due else []
        strength = self._response.strength if due else None
        if strength is None:
            return
        for axis in due:
            current, limit = self._least / float(strength[axis]), float(self._settings.limits[axis])
            quarter = max(_SHORTEST_QUARTER, (current / limit) ** (2.0 / 3.0))
            if quarter > _LONGEST_QUARTER:
                self._shown_ns[axis] = now_ns - interval_ns + _NEAR_FIELD_NS
                continue
            self._running = axis, now_ns + _GAP_NS, round(quarter * 1e9), min(current, limit)
            return


@dataclass(frozen=True, slots=True)
class CoilVerdict:
    """The diagnosed fault of one coil, whose index is `axis`."""

    axis: int
    fault: CoilFault
    time_ns: int
    text: str


@dataclass(frozen=True, slots=True)
class CoilMonitorSettings:
    """Properties of the coil circuit, and the settings of the diagnosis by the body's motion.

    Attributes:
        full_current: current (A) of each coil when fully on: the supply voltage divided by the coil's
            resistance.
        response: settings of the fit of the coil gains to the body's motion, or None if the motion is not
            used.
        slow: settings like `response` with longer bins, which reveal missing torque at small currents.
        tumble_rate: body rate (rad/s) below which corrections are reviewed and broken coils are tried again.
        trial_after_ns: time (ns) from the diagnosis of a broken coil to its next trial.
        trials: largest number of trials of each coil.
        self_test: settings of the self-test, or None if the coils are not tested.
        absent: axes without a coil.
    """

    full_current: tuple[float, ...]
    response: ResponseSettings | None = None
    slow: ResponseSettings | None = None
    tumble_rate: float = math.inf
    trial_after_ns: int = 600_000_000_000
    trials: int = 3
    self_test: SelfTestSettings | None = None
    absent: frozenset[int] = frozenset()


class Probe:
    """Drives an axis alone with +`current` and then -`current` (A), each for `half_ns`."""

    def __init__(self, current: float, half_ns: int, coils: int) -> None:
        self._current, self._coils = current, coils
        self._half_ns = half_ns
        self._running: tuple[int, int] | None = None  # axis, and start time (ns)
        self._tried: set[int] = set()

    def begin(self, axes: set[int], now_ns: int, prime: int | None = None) -> int | None:
        """Drive an untried axis, preferably `prime`; return the end time (ns), or None if all were tried."""
        candidates = axes - self._tried
        if not candidates:
            self._tried.clear()
            return None
        axis = min(candidates, key=lambda axis: (axis != prime, axis))
        self._tried.add(axis)
        self._running = (axis, now_ns)
        return now_ns + 2 * self._half_ns

    @property
    def has_begun(self) -> bool:
        """Whether at least one axis has been tried in the present round of probes."""
        return bool(self._tried)

    def stop(self) -> None:
        """End the square wave and consider all axes untried."""
        self._running = None
        self._tried.clear()

    def wave(self, now_ns: int) -> FloatArray | None:
        """Return the currents (n,), A, of the square wave at `now_ns`, or None while no wave is applied."""
        if self._running is None:
            return None
        axis, since_ns = self._running
        half = (now_ns - since_ns) // self._half_ns
        if half >= 2:
            self._running = None
            return None
        wave = np.zeros(self._coils)
        wave[axis] = self._current * (1.0 if half == 0 else -1.0)
        return wave


_BRAKED = {CoilFault.A_HIGH, CoilFault.B_HIGH, CoilFault.HIGH}
_STUCK_EXCESS = 0.3
"""Smallest excess current of a leg stuck high, as a fraction of the current of a coil that is fully on."""
_LEAST_SHORT = 0.02
"""Smallest excess current (A) of a shorted coil that the motion of the body can confirm."""
_READING_NS = 200_000_000
_WINDOW_NS = 1_100_000_000
"""Averaging time (ns) of the current monitor. After a longer gap between readings, the evidence is
discarded."""
_SETTLE = 2
"""Number of readings after a fault until the averaging window excludes the time before the fault."""
_SETTLE_NS = _SETTLE * _READING_NS
_PERSISTENCE = 3
"""Number of consecutive readings that contradict a healthy circuit after which a fault is suspected."""
_EVIDENCE = 3
"""Number of readings that are needed for a diagnosis."""
_PROBE_CURRENT, _PROBE_HALF_NS = 0.04, 800_000_000
"""Amplitude (A) and half period (ns) of the square wave that reveals which of several axes is faulty."""
_IN_DOUBT = 5
"""Number of readings after which an axis may be diagnosed as faulty although the kind of fault is
uncertain."""
_AGAIN_NS = 60_000_000_000
"""Shortest time (ns) between two searches for an axis without torque, each of which drives axis after
axis."""


class CoilMonitor:
    """Detects broken coils from the commands and readings of the last seconds.

    Corrections are reviewed, and broken coils are tried again, below the body rate `tumble_rate` (rad/s). The
    attribute `correction` contains the signs and gains of the coils. The class has over 350 lines, because
    its methods share the state of one suspected fault from its detection to its diagnosis.
    """

    def __init__(self, settings: CoilMonitorSettings) -> None:
        self._settings, self.tumble_rate = settings, settings.tumble_rate
        self._bounds = Bounds(settings.full_current)
        self._commands = CoilCommands(2 * _WINDOW_NS)
        self._reading_ns = -(1 << 62)
        self._fresh = self._strange = 0
        self._suspected_ns: int | None = None
        self._judge_ns = 0  # time (ns) after which a diagnosis need not determine the kind of fault
        self._sound_ns = 0  # time (ns) at which a driven coil last drew the expected current
        self._unmixed_ns = 0  # time (ns) since which the circuit has not changed
        self._evidence = Evidence(self._bounds)
        coils = len(settings.full_current)
        self._probe = Probe(_PROBE_CURRENT, _PROBE_HALF_NS, coils)
        self._response = None if settings.response is None else CoilResponse(settings.response)
        self._slow = None if settings.slow is None else CoilResponse(settings.slow)
        self._responses = [response for response in (self._response, self._slow) if response is not None]
        self._self_test: SelfTest | None = None
        if self._slow is not None and settings.slow is not None and settings.self_test is not None:
            self._self_test = SelfTest(self._slow, settings.slow.rate_noise, settings.self_test)
        self._weak = ""  # text about a coil without the expected torque
        self._weak_ns = -_AGAIN_NS  # time (ns) of the last search for an axis without torque
        self._prime: int | None = None  # axis to probe first
        # Suspected, unconfirmed fault, while another coil is probed for comparison.
        self._compared: tuple[int, CoilFault] | None = None
        self._begun_at_rest = False  # whether probes began before any reading of a driven coil
        self._verdicts: dict[int, CoilVerdict] = {}
        self.correction = CoilCorrection(coils)
        self._news: list[str] = []  # texts about corrected signs and gains
        self._trials = [0] * coils
        self._speed = math.inf
        # Axes that are kept at zero current, with start time (ns) and reason.
        self._rests: dict[int, tuple[int, str]] = {}
        self._looked_ns = 0
        self._leg = StuckLeg(_STUCK_EXCESS * min(settings.full_current))
        self._proof = BrakeProof()
        self._witness = MotionWitness(self._response, settings.full_current)
        self._gain = 1.0  # gain of a current monitor that measures all currents with a common error
        self._strangeness = ""

    @property
    def verdicts(self) -> tuple[CoilVerdict, ...]:
        """The diagnoses of broken axes, at most one per axis, in order of time; `forget` discards them."""
        return tuple(self._verdicts.values())

    @property
    def available(self) -> BoolArray:
        """Flags (n,) of the axes with a coil that is not broken, for `knightcube.gnc.control.coil_map`."""
        broken = self._verdicts.keys() | self._settings.absent
        return np.array([axis not in broken for axis in range(len(self._trials))])

    @property
    def rests(self) -> bool:
        """Whether any axis is kept at zero current because its sign changed too often."""
        return bool(self._rests)

    @property
    def resting(self) -> BoolArray:
        """Flags (n,) of the axes that are kept at zero current because their sign changed too often."""
        return np.array([axis in self._rests for axis in range(len(self._trials))])

    @property
    def suspicion(self) -> str:
        """The reason why a coil is suspected; empty while all readings are consistent with healthy coils."""
        if not self._rests:
            return self._unknown
        return self._unknown or "; ".join(why for _, why in self._rests.values())

    @property
    def doubts_currents(self) -> bool:
        """Whether the current of a coil in use possibly differs from its command."""
        return bool(self._unknown)

    @property
    def _unknown(self) -> str:
        """The reason why a coil's current may differ from its command; empty if there is none."""
        return self._leg.suspicion or self._strangeness or self._weak

    @property
    def braked(self) -> Axes:
        """Indices of the bridges to brake: bridges with a leg stuck high, and bridges tested in a search."""
        if not self._verdicts:
            return self._leg.brake
        stuck = {axis for axis, verdict in self._verdicts.items() if verdict.fault in _BRAKED}
        return self._leg.brake | stuck

    @property
    def at_rest(self) -> bool:
        """Whether all currents must be commanded to zero now, to reveal a leg stuck high."""
        return self._leg.rest

    def forget(self, axis: int) -> None:
        """Discard the diagnosis of an axis by command of the ground; a persisting fault is detected again."""
        self._trials[axis] = 0
        self._release(axis)

    def begin_trial(self, now_ns: int) -> tuple[int, str] | None:
        """Use a broken axis again if its trial is due; return the axis and a text, or None."""
        if self._speed > self.tumble_rate or self.suspicion or self._leg.is_searching:
            return None
        for axis, verdict in self._verdicts.items():
            if now_ns - verdict.time_ns >= self._settings.trial_after_ns and (
                self._trials[axis] < self._settings.trials
            ):
                self._trials[axis] += 1
                self._release(axis)
                count = f"{self._trials[axis]} of {self._settings.trials}"
                return axis, f"coil {COIL_NAMES[axis]} is tried again, {count}"
        return None

    def news(self) -> list[str]:
        """Return texts about coil signs and gains that were corrected or confirmed since the last call."""
        news, self._news = self._news, []
        return news

    def _release(self, axis: int) -> None:
        self._verdicts.pop(axis, None)
        self._rests.pop(axis, None)
        self._proof.discard(axis)
        self.interrupted(self._commands.newest_ns if self._commands else 0)

    def commanded(
        self, time_ns: int, currents: FloatArray, braked: Axes = NO_AXES, written_ns: int | None = None
    ) -> None:
        """Record the actual coil currents (n,), A, and the braked bridges in force at `time_ns`.

        If `written_ns` is given, the evaluation of the motion uses it as the time at which the command was
        sent.
        """
        values = tuple(currents.tolist())
        self._commands.note(time_ns, values, braked)
        # Without readings of the current monitor, the search for a stuck leg cannot succeed, and is ended.
        if self._leg.is_searching and time_ns - self._looked_ns > _WINDOW_NS:
            self._leg.reset()
        effective = tuple(self.correction.effective(currents).tolist())
        for response in self._responses:
            response.commanded(time_ns if written_ns is None else written_ns, effective)

    def observe_motion(self, time_ns: int, rate: FloatArray, field: FloatArray) -> None:
        """Add a sample of body rate (3,), rad/s, and magnetic field (3,), T, in body axes."""
        self._speed = math.hypot(*rate.tolist())
        if self._rests:
            self._end_rests(time_ns, self._speed)
        for response in self._responses:
            if response.observe_motion(time_ns, rate, field):
                self._judge_motion(response, time_ns)

    def _judge_motion(self, response: CoilResponse, now_ns: int) -> None:
        """Correct sign or gain of a coil, and suspect a fault of an axis without torque."""
        slow = response.fastest <= self.tumble_rate
        for axis in self.correction.unreviewed:
            if slow and response.is_healthy(axis):
                self.correction.confirm(axis)
                self._tell(axis, f"{response.text(axis)} while the body is slow: the sign is confirmed")
        known = self._verdicts.keys() | self._rests.keys() | self._settings.absent
        # An uncommanded current also produces a torque, which could be mistaken for the torque of a reversed
        # coil.
        if not self._leg.suspicion and (not self._strangeness or self._prime is not None):
            for axis in response.axes(Finding.REVERSED):
                if axis not in known:
                    self._reverse(axis, response, now_ns, in_tumble=not slow)
                    return
            for axis in (*response.axes(Finding.WEAK), *response.axes(Finding.STRONG)):
                seen = response.text(axis)
                gain, sigma = float(response.gain[axis]), float(response.sigma[axis])
                if axis not in known and self.correction.weigh(axis, gain, sigma):
                    self._apply(axis, seen, now_ns)
                    return
        if response is self._slow:
            feeble = [axis for axis in response.axes(Finding.FEEBLE) if axis not in known]
            self._weak = f"coil {COIL_NAMES[feeble[0]]}: {response.text(feeble[0])}" if feeble else ""
            if feeble:
                self._probe_weak_coil(feeble[0], now_ns)

    def _probe_weak_coil(self, axis: int, now_ns: int) -> None:
        """Suspect a fault of a weak coil, so that a probe shows whether the coil is open."""
        silent = now_ns - self._reading_ns > _WINDOW_NS
        if silent or self._suspected_ns is not None or now_ns - self._weak_ns < _AGAIN_NS:
            return
        self._weak_ns = now_ns
        self._suspect(self._weak)
        self._prime = axis

    def _reverse(self, axis: int, response: CoilResponse, now_ns: int, *, in_tumble: bool) -> None:
        """Change the sign of a coil, or keep it at zero current if its sign has changed too often."""
        seen = response.text(axis)
        if self.correction.reverse(axis, now_ns, in_tumble=in_tumble):
            self._apply(axis, seen, now_ns)
        else:
            why = f"coil {COIL_NAMES[axis]}: {seen}; its sign changed too often, so its current stays zero"
            self._rests[axis] = now_ns, why

    def _apply(self, axis: int, seen: str, now_ns: int) -> None:
        """Report a change of the correction, and discard the earlier evidence from the motion."""
        self._tell(axis, seen)
        self._weak = ""
        if self._prime is not None:
            self._reset()
        self._adopt_correction()
        if self._self_test is not None:
            self._self_test.stop()
        for response in self._responses:
            response.interrupted(now_ns)

    def _adopt_correction(self) -> None:
        for response in self._responses:
            response.largest = LARGEST_GAIN / np.abs(self.correction.factors)

    def restore(self, factors: FloatArray, deviations: FloatArray) -> str:
        """Start from the correction of an earlier boot (`CoilCorrection.restore`), and report it."""
        problem = self.correction.restore(factors, deviations)
        if not problem:
            self._adopt_correction()
            for axis in np.flatnonzero(self.correction.factors != 1.0).tolist():
                self._tell(axis, "as before the restart")
        return problem

    def _tell(self, axis: int, seen: str) -> None:
        self._news.append(f"coil {COIL_NAMES[axis]}: {seen}; {self.correction.text(axis)}")

    def _end_rests(self, now_ns: int, speed: float) -> None:
        """Stop keeping axes at zero current if the body is slow or ten minutes have passed."""
        oldest_ns = min(since_ns for since_ns, _ in self._rests.values())
        if speed <= self.tumble_rate or now_ns - oldest_ns > LONGEST_REST_NS:
            self._rests.clear()
            for response in self._responses:
                response.reset()

    def interrupted(self, now_ns: int) -> None:
        """Discard all evidence until now, because the coil currents up to this time are unknown."""
        self._fresh = 0
        self._leg.reset()
        self._reset()
        self._weak = ""
        for response in self._responses:
            response.interrupted(now_ns)

    def measured(self, reading: PowerReading) -> None:
        """Process a reading of the current monitor, unless it was processed before."""
        gap_ns = reading.time_ns - self._reading_ns
        if gap_ns <= 0 or not self._commands:
            return
        self._reading_ns = reading.time_ns
        if self._gain != 1.0:
            current, newest = reading.current / self._gain, reading.newest / self._gain
            reading = replace(reading, current=current, newest=newest)
        self._look_at_legs(reading)
        if self._leg.is_searching:
            self._unmixed_ns = reading.time_ns
            if self._suspected_ns is None and self._leg.suspicion:
                self._suspect(self._leg.suspicion)
            return
        self._fresh = self._fresh + 1 if gap_ns < _WINDOW_NS else 1
        if self._fresh <= _SETTLE:
            self._reset()
            self._unmixed_ns = reading.time_ns
            return
        if self._suspected_ns is None:
            self._check_healthy(reading)
        elif reading.time_ns - self._suspected_ns > _SETTLE_NS:
            self._evidence.add([predict(*window) for window in self._windows(reading)])
            self._judge(reading.time_ns)

    @property
    def probe(self) -> FloatArray | None:
        """Actual coil currents (n,), A, that replace all commands while an axis is probed, or None."""
        return self._probe.wave(self._commands.newest_ns) if self._commands else None

    def test_wave(self, wanted: FloatArray) -> FloatArray | None:
        """Return the actual currents (n,), A, of a self-test that replace the `wanted` currents, or None."""
        if self._self_test is None or not self._commands:
            return None
        if self.suspicion or self._leg.is_searching:
            self._self_test.stop()
            return None
        return self._self_test.wave(wanted, lambda: self.available & ~self.resting, self._commands.newest_ns)

    def test_soon(self) -> None:
        """Test all coils as soon as possible."""
        if self._self_test is not None:
            self._self_test.request()

    def tested(self, now_ns: int) -> str:
        """Return the results of the last self-test as text, or an empty text before they are known."""
        return "" if self._self_test is None else self._self_test.report(now_ns)

    @property
    def monitor_doubted(self) -> str:
        """The reason why the current monitor is considered faulty; empty while it is trusted."""
        return self._witness.doubt

    @property
    def _known(self) -> dict[int, CoilFault]:
        """The fault of each broken axis, as it affects the supply current; a braked axis draws no current."""
        return dict.fromkeys(self._settings.absent, CoilFault.OPEN) | {
            axis: CoilFault.OPEN if verdict.fault in _BRAKED else verdict.fault
            for axis, verdict in self._verdicts.items()
        }

    def _look_at_legs(self, reading: PowerReading) -> None:
        """Search for a leg stuck high if the present brakes were in force during the whole ADC sample."""
        commands = self._commands
        if commands.braked != self.braked or not commands.is_known_since(reading.newest_since_ns):
            return
        self._looked_ns = reading.time_ns
        seen = commands.supplied(reading, self._bounds, self._known)
        if self._proof:
            for axis in self._proof.ingest(self._leg.exceeds(seen)):  # braking had no effect
                self._verdicts[axis] = replace(self._verdicts[axis], fault=CoilFault.UNCERTAIN)
            return
        found = self._leg.look(seen)
        if found is not None:
            text = f"{1e3 * reading.newest:.0f} mA without a command"
            self._give(found, CoilFault.HIGH, reading.time_ns, text)
            self.interrupted(reading.time_ns)

    def _windows(self, reading: PowerReading) -> list[tuple[float, Commands, Bounds, Sampling, bool]]:
        """Return the newest ADC sample, and the mean reading unless the circuit changed in its time window.

        Each tuple contains the arguments of `predict`.
        """
        commands, bounds, clipped = self._commands, self._bounds, reading.clipped
        newest = commands.window(reading.newest_since_ns, reading.time_ns)
        windows: list[tuple[float, Commands, Bounds, Sampling, bool]]
        windows = [(reading.newest, newest, bounds, NEWEST, clipped)]
        begin_ns = reading.time_ns - _WINDOW_NS
        if begin_ns >= self._unmixed_ns:
            windows.append(
                (reading.current, commands.window(begin_ns, reading.time_ns), bounds, MEAN, clipped)
            )
        return windows

    def _check_healthy(self, reading: PowerReading) -> None:
        windows = self._windows(reading)
        asked = sum([sum(map(abs, currents)) for currents in windows[0][1]]) / len(windows[0][1])
        healthy = self._are_healthy(windows)
        if self._gain != 1.0 and not healthy:
            healthy = self._are_healthy([(self._gain * one[0], *one[1:]) for one in windows])
            self._gain = 1.0 if healthy else self._gain
        if healthy:
            self._strange = 0
            if self._gain == 1.0:
                self._witness.trust_monitor()
            if asked > self._bounds.uncertainty:
                self._sound_ns = reading.newest_since_ns
            return
        self._strange += 1
        if self._strange >= _PERSISTENCE:
            why = f"supply current {1e3 * reading.newest:.0f} mA, expected {1e3 * asked:.0f} mA"
            self._suspect(why)
            if reading.newest > asked > 0.0:
                self._leg.ask_for_rest(why)

    def _are_healthy(self, windows: list[tuple[float, Commands, Bounds, Sampling, bool]]) -> bool:
        known = self._known
        if known:
            return all(fits([predict(*window)], self._bounds, known) for window in windows)
        return all(is_healthy_current(*window) for window in windows)

    def _suspect(self, why: str) -> None:
        self._suspected_ns = self._unmixed_ns = self._reading_ns
        self._judge_ns = self._reading_ns + _SETTLE_NS + _IN_DOUBT * _READING_NS
        self._evidence.clear()
        self._strangeness = why

    def _judge(self, now_ns: int) -> None:
        """Diagnose a fault if all evidence concerns one axis, or end the suspicion if readings are normal."""
        evidence = self._evidence
        if len(evidence) < _EVIDENCE:
            return
        left = evidence.possible_faults(self._known)
        waited = now_ns >= self._judge_ns
        if evidence.is_normal_again(self._known, left):
            # Coils at zero current since the suspicion are probed. If no probe is applied, suspicion ends.
            if not evidence.is_driven and not (self._probe.has_begun and waited):
                if not self._probe.has_begun:
                    self._begun_at_rest = True
                    self._look_further({axis for axis, _ in left}, now_ns)
                return
            if (gain := evidence.monitor_gain(self._known)) is not None:
                self._doubt_monitor("", gain, now_ns)
            self._reset()
            return
        axes = {axis for axis, _ in left}
        if self._compared is not None:
            if waited:
                self._conclude(*self._compared, now_ns)
            return
        # The only suspected axis may be healthy: the fault may have ended, or only the motion indicated it.
        certain = len(axes) == 1 and evidence.rejects_healthy_now(self._known)
        if certain and (len(left) == 1 or waited):
            axis, fault = left[0]
            self._conclude(axis, fault if len(left) == 1 else CoilFault.UNCERTAIN, now_ns)
        elif waited:
            self._look_further(axes, now_ns)

    def _conclude(self, axis: int, fault: CoilFault, now_ns: int) -> None:
        excess = max(one.current - float(one.mean[:, 0].sum()) for one in self._evidence.readings())
        if fault is CoilFault.SHORTED and excess < _LEAST_SHORT:
            self._reset()  # a small excess may be an error of the current monitor
            return
        works = self._evidence.shows_working_monitor(self._known)
        gain = self._evidence.monitor_gain(self._known)
        # A single probe cannot show whether the coil or the current monitor is faulty.
        contradicted = not works and (self._begun_at_rest or self._is_contradicted(axis, fault))
        if gain is not None or contradicted:
            if self._begin_comparison(axis, fault, now_ns):
                return
            why = f"but the measured motion shows no fault of coil {COIL_NAMES[axis]}"
            if self._begun_at_rest:
                why = "no probe of a coil shows a correct reading"
            self._doubt_monitor(why, gain, now_ns)
        else:
            self._give(axis, fault, now_ns, self._strangeness)
            if fault in _BRAKED:
                self._proof.add(axis)
                self._fresh = 0
        self._reset()

    def _doubt_monitor(self, why: str, gain: float | None, now_ns: int) -> None:
        """Consider the current monitor faulty, and divide its later readings by `gain` if it is known."""
        if gain is not None:
            self._gain *= gain
            why = f"the monitor measures {self._gain:.2f} times the current of each coil"
        if gain is not None and abs(self._gain - 1.0) <= self._bounds.gain:  # the fault has ended
            self._gain = 1.0
            self._witness.trust_monitor()
        else:
            self._witness.doubt_monitor(f"{self._strangeness}; {why}", now_ns)

    def _begin_comparison(self, axis: int, fault: CoilFault, now_ns: int) -> bool:
        """Probe another coil for comparison, and return whether the probe began.

        If the current monitor measures the current of the probed coil correctly, its readings of the
        suspected coil are trusted.
        """
        ends_ns = self._probe.begin(set(range(len(self._trials))) - {axis} - self._known.keys(), now_ns)
        if ends_ns is None or self._compared is not None:
            return False
        self._compared = axis, fault
        self._evidence.begin_segment()
        self._judge_ns = ends_ns + _READING_NS
        return True

    def _is_contradicted(self, axis: int, fault: CoilFault) -> bool:
        if self._suspected_ns is None:
            return False
        begun_ns = min(self._sound_ns, self._suspected_ns - _WINDOW_NS)
        return self._witness.contradicts(axis, fault, begun_ns, self._suspected_ns, self._reading_ns)

    def _look_further(self, axes: set[int], now_ns: int) -> None:
        """Probe the next suspected axis; after the last axis, collect new evidence.

        If all axes were probed, no coil fault explains the evidence; the fault may be intermittent, or the
        current monitor may be faulty.
        """
        ends_ns = self._probe.begin(axes, now_ns, self._prime)
        gain = self._evidence.monitor_gain(self._known) if ends_ns is None else None
        if gain is not None:
            self._doubt_monitor("", gain, now_ns)
            self._reset()
            return
        self._evidence.begin_segment()
        if ends_ns is None:
            self._evidence.clear()
            self._judge_ns = now_ns + _IN_DOUBT * _READING_NS
        else:
            self._judge_ns = ends_ns + _READING_NS

    def _give(self, axis: int, fault: CoilFault, now_ns: int, why: str) -> None:
        text = f"coil {COIL_NAMES[axis]} {fault.value} ({why})"
        self._verdicts[axis] = CoilVerdict(axis, fault, now_ns, text)

    def _reset(self) -> None:
        self._strange = 0
        self._suspected_ns = None
        self._evidence.clear()
        self._probe.stop()
        self._prime = self._compared = None
        self._begun_at_rest = False
        self._strangeness = ""
