"""Three torque coils on a PCA9685 and SN754410 H-bridges; any failure leads to zero current.

A coil is connected to two inputs of its bridge (Sease 2013, Table 5.2, eq. 5.33). The sign of a count gives
the direction and its magnitude the duty: +n drives input A for n/4096 of the period with input B low, -n
drives input B, and 0 keeps both inputs low. The coil's L/R of 0.1 ms is far below the PWM period of 20 ms,
so the mean current over a period follows from the mean voltage: n/4096 V/R.

`command` puts the newest currents into a mailbox and wakes a job of the clock; only that job, and a request
for zero, uses the bus. The job writes the newest command, replaces a stale command by zero, repeats zero at
every period while zero is requested, reads set-up and outputs back twice a second, and sets the chip up
again after a brown-out. It never ends on a failure without a last attempt to write zero.

Zero current means that both inputs of a bridge are low: this is the only message that needs no set-up of the
chip. With low inputs a leg that is stuck high would drive its coil, so a bridge with such a leg is braked
(both inputs high) immediately afterwards.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from threading import RLock
from typing import TypeVar

import numpy as np

from hal.drivers.pca9685 import BLOCK_CHANNELS, CHANNELS, COUNTS, FULL_OFF, FULL_ON, Pca9685, PwmCounts
from hal.interfaces.devices import NO_AXES, Axes, CoilState, FloatArray
from hal.interfaces.errors import DeviceError, NotResponding, OutOfRange, Refused
from hal.interfaces.wires import Clock, Ticker

DEVICE = "coils"


@dataclass(frozen=True, slots=True)
class CoilWiring:
    """Wiring of one coil to the PWM chip, as measured.

    Attributes:
        channel_a: PWM channel of bridge input A, high for a positive current.
        channel_b: PWM channel of input B.
        resistance: ohm, of the coil.
        sign: +1, or -1 for a coil with its leads swapped.
    """

    channel_a: int
    channel_b: int
    resistance: float
    sign: int = 1

    def __post_init__(self) -> None:
        if not 0.0 < self.resistance < math.inf:
            raise OutOfRange(DEVICE, "coil resistance", self.resistance, 0.0, math.inf, "ohm")
        if self.sign not in {1, -1}:
            raise OutOfRange(DEVICE, "coil sign", self.sign, -1, 1, "(-1 or +1)")

    @property
    def channels(self) -> tuple[int, int]:
        """The PWM channels of inputs A and B."""
        return self.channel_a, self.channel_b


Wirings = tuple[CoilWiring, CoilWiring, CoilWiring]


def wirings(
    channels: Sequence[tuple[int, int]], resistance: Sequence[float], signs: Sequence[int]
) -> Wirings:
    """Return the wiring of the three coils from three values of each kind. Raises OutOfRange."""
    x, y, z = (
        CoilWiring(a, b, ohm, sign) for (a, b), ohm, sign in zip(channels, resistance, signs, strict=True)
    )
    return x, y, z


@dataclass(frozen=True, slots=True)
class CoilSettings:
    """Wiring and drive of the three coils.

    Attributes:
        coils: wiring of the coils on body x, y, z.
        supply_voltage: V across a coil that is fully on, after the losses of the bridge.
        current_limit: A, of each coil; V/R is a limit too.
        stale_after: s without a command until the coils go to zero; at most 0.4, so that they are at zero
            within 0.5.
        tries: attempts of one write before it counts as failed.
        retry_wait: s between them.
    """

    coils: Wirings
    supply_voltage: float
    current_limit: float
    stale_after: float
    tries: int = 3
    retry_wait: float = 0.002

    def __post_init__(self) -> None:
        for quantity, value, low, high, unit in (
            ("number of coils", len(self.coils), 3, 3, ""),
            ("supply voltage", self.supply_voltage, 0.1, 36.0, "V"),
            ("current limit", self.current_limit, 1e-3, 1.0, "A"),
            ("stale_after", self.stale_after, 0.05, 0.4, "s"),
            ("tries", self.tries, 1, 5, ""),
            ("retry_wait", self.retry_wait, 0.0, 0.01, "s"),
        ):
            # Written so that NaN is rejected too.
            if not low <= value <= high:
                raise OutOfRange(DEVICE, quantity, value, low, high, unit)
        used = [channel for coil in self.coils for channel in coil.channels]
        for channel in used:
            if not 0 <= channel < CHANNELS or used.count(channel) > 1:
                raise OutOfRange(DEVICE, "PWM channel (each once)", channel, 0, CHANNELS - 1, "")

    def blocks(self) -> tuple[tuple[int, tuple[int, ...]], ...]:
        """Return the pins grouped into blocks of neighbouring channels: (first channel, pins).

        Pins are numbered coil by coil, in the order of `CoilWiring.channels`; a block is one transaction.
        """
        channels = [channel for coil in self.coils for channel in coil.channels]
        blocks: list[tuple[int, tuple[int, ...]]] = []
        for pin in sorted(range(len(channels)), key=channels.__getitem__):
            first, pins = blocks[-1] if blocks else (-1, ())
            if pins and channels[pin] == first + len(pins) and len(pins) < BLOCK_CHANNELS:
                blocks[-1] = (first, (*pins, pin))
            else:
                blocks.append((channels[pin], (pin,)))
        return tuple(blocks)


def current_step(resistance: float, supply_voltage: float) -> float:
    """Return the mean current in A of one count, V/R/4096, from ohm and volt."""
    return supply_voltage / resistance / COUNTS


def largest_counts(step: float, current_limit: float) -> int:
    """Return the largest count whose current exceeds neither the limit in A nor V/R."""
    # A limit that is a whole number of steps must not lose one to rounding.
    return min(COUNTS, math.floor(current_limit / step * (1.0 + 1e-12)))


def counts_for(current: float, step: float, largest: int) -> tuple[int, bool]:
    """Return the signed counts nearest to a mean current in A, and whether it was limited.

    Raises ValueError for NaN.
    """
    bound = largest * step
    if current > bound:
        return largest, True
    if current < -bound:
        return -largest, True
    return round(current / step), False


def mean_current(counts: int, step: float) -> float:
    """Return the mean current in A of signed counts."""
    return counts * step


def inputs_for(counts: int) -> tuple[PwmCounts, PwmCounts]:
    """Return the PWM counts of inputs A and B; the idle one is low the whole period (Table 5.2)."""
    if counts > 0:
        return _pulse(counts), FULL_OFF
    if counts < 0:
        return FULL_OFF, _pulse(-counts)
    return FULL_OFF, FULL_OFF


def brake() -> tuple[PwmCounts, PwmCounts]:
    """Return the PWM counts of both inputs that hold a coil at zero although a leg is stuck high.

    Both ends of the coil are then at the upper rail, for either leg and for a sound bridge.
    """
    return FULL_ON, FULL_ON


def _pulse(counts: int) -> PwmCounts:
    return FULL_ON if counts >= COUNTS else (0, counts)


Counts = tuple[int, int, int]
"""Signed PWM counts of the three coils."""

ZERO: Counts = (0, 0, 0)


class CommandMailbox:
    """Holds the newest command and brake request; replaces a command that is too old by zero.

    Attributes:
        lock: guards everything here; re-entrant, because a signal handler may request zero in the middle of
            its own thread's call.
        braked: the bridges to be braked.
        number: of the newest command, withdrawal or brake.
        command: A, as requested.
        command_ns: host time of the newest command, -1 before the first.
        saturated: whether any axis of the command was limited.
        stale: the command was too old and was replaced by zero.
    """

    def __init__(self, clock: Clock, stale_ns: int) -> None:
        """Accept commands; one that is older than `stale_ns` becomes zero."""
        self.lock = threading.RLock()
        self.braked = NO_AXES
        self.number = 0
        self.command: tuple[float, float, float] = (0.0, 0.0, 0.0)
        self.command_ns = -1
        self.saturated = False
        self.stale = False
        self._clock = clock
        self._stale_ns = stale_ns
        self._wanted: Counts | None = None  # None: zero

    def put(self, command: tuple[float, float, float], counts: Counts, saturated: bool) -> None:
        """Replace the command, in A, by a new one and its signed counts."""
        with self.lock:
            self.command = command
            self.command_ns = self._clock.now_ns()
            self._wanted = counts
            self.saturated = saturated
            self.stale = False
            self.number += 1

    def brake(self, axes: Axes) -> None:
        """Request that these bridges be braked from now on, whatever is commanded."""
        with self.lock:
            self.braked = axes
            self.number += 1

    def withdraw(self) -> None:
        """Request zero."""
        with self.lock:
            self._wanted = None
            self.command = (0.0, 0.0, 0.0)
            self.saturated = False
            self.stale = False
            self.number += 1

    def newest(self) -> tuple[Counts, Axes, int]:
        """Return the signed counts and braked bridges that should be on the wire now, and their number."""
        with self.lock:
            if self._wanted is not None and self._clock.now_ns() - self.command_ns > self._stale_ns:
                self._wanted = None
                self.saturated = False
                self.stale = True
                self.number += 1
            x, y, z = self._wanted or ZERO
            brake_x, brake_y, brake_z = self.braked
            counts = 0 if brake_x else x, 0 if brake_y else y, 0 if brake_z else z
            return counts, self.braked, self.number


_CHECK_PERIOD_NS = 500_000_000

_Answer = TypeVar("_Answer")


class CoilOutputs:
    """Writes signed counts to the PWM chip and records what the chip acknowledged.

    Attributes:
        written: signed counts of the coils that the chip acknowledged last.
        braked: the bridges that are braked.
        written_ns: host time since which these counts are written, -1 before the first write.
        failing: the last exchange failed; the chip's state is not known.
        faults: failed transactions since start.
        error: the text of the last failure while it lasts.
    """

    def __init__(self, pca: Pca9685, clock: Clock, settings: CoilSettings, lock: RLock) -> None:
        """Drive the chip; `lock` guards `written`, `braked` and `written_ns`."""
        self.written = ZERO
        self.braked = NO_AXES
        self.written_ns = -1
        self.failing = False
        self.faults = 0
        self.error = ""
        self._pca = pca
        self._clock = clock
        self._settings = settings
        self._lock = lock
        self._blocks = settings.blocks()
        self._retry_ns = round(settings.retry_wait * 1e9)
        self._check_ns = 0

    def set_up(self) -> None:
        """Set the chip up with every output off, with retries. Raises DeviceError."""
        self._retried(self.configure)
        self.failing, self.error = False, ""

    def configure(self) -> None:
        """Set the chip up with every output off, once. Raises DeviceError."""
        self._pca.configure()
        self._record(ZERO, NO_AXES)
        self._postpone_check()

    def check_is_due(self) -> bool:
        """Return whether set-up and outputs should be read back now."""
        return self._clock.now_ns() >= self._check_ns

    def is_intact(self) -> bool:
        """Return whether the chip holds its set-up and outputs, with retries. Raises NotResponding."""
        held, kept = self._retried(self._read_back)
        if kept:
            self._postpone_check()
        elif held:
            self.count(self.not_kept())
        else:
            self.count(Refused(self._pca.name, "has lost its set-up (brown-out?)"))
        return kept

    def keeps_written(self) -> bool:
        """Return whether the outputs hold the last written counts. Raises NotResponding."""
        blocks = self._channel_blocks(self.written, self.braked)
        return all(self._pca.holds(first, block) for first, block in blocks)

    def not_kept(self) -> DeviceError:
        """Return the error of a chip whose outputs differ from the written counts."""
        return Refused(self._pca.name, "does not keep what is written to its outputs")

    def write(self, counts: Counts, braked: Axes) -> None:
        """Write signed counts and brakes, once. Raises DeviceError."""
        self._write(counts, braked)
        self._record(counts, braked)

    def zero(self, braked: Axes) -> bool:
        """Write zero once, then brake the bridges of `braked`; return whether that was acknowledged."""
        try:
            self._pca.all_off()
            self._record(ZERO, NO_AXES)
            # A chip that may have lost its set-up would misread a block.
            if any(braked) and not self.failing:
                self.write(ZERO, braked)
        except NotResponding as error:
            self.count(error)
            return False
        return True

    def count(self, error: DeviceError) -> None:
        """Count a failed transaction and keep its text."""
        self.faults += 1
        self.error = str(error)

    def wait(self) -> None:
        """Wait before the next try."""
        self._clock.sleep_until_ns(self._clock.now_ns() + self._retry_ns)

    def _retried(self, action: Callable[[], _Answer]) -> _Answer:
        """Return what `action` returns, tried a few times; raises the last DeviceError."""
        for left in reversed(range(self._settings.tries)):
            try:
                return action()
            except DeviceError as error:
                self.count(error)
                if left == 0:
                    raise
                self.wait()
        raise AssertionError("tries is at least 1")

    def _read_back(self) -> tuple[bool, bool]:
        """Return whether the chip holds its set-up, and whether its outputs as well."""
        held = self._pca.is_configured()
        # Zero is sent in more than one way, and again at each period, so it is not read back.
        driven = any(self.written) or any(self.braked)
        return held, held and (not driven or self.keeps_written())

    def _postpone_check(self) -> None:
        self._check_ns = self._clock.now_ns() + _CHECK_PERIOD_NS

    def _write(self, counts: Counts, braked: Axes) -> None:
        for first, block in self._channel_blocks(counts, braked):
            self._pca.write_channels(first, block)

    def _channel_blocks(self, counts: Counts, braked: Axes) -> list[tuple[int, list[PwmCounts]]]:
        """Return (first channel, counts from there on) of each block for signed counts of the coils."""
        pins: list[PwmCounts] = []
        for value, held in zip(counts, braked, strict=True):
            pins += brake() if held else inputs_for(value)
        return [(first, [pins[member] for member in members]) for first, members in self._blocks]

    def _record(self, counts: Counts, braked: Axes) -> None:
        """Record what the chip acknowledged; a repetition keeps its first time."""
        with self._lock:
            if self.written_ns < 0 or (counts, braked) != (self.written, self.braked):
                self.written, self.braked = counts, braked
                self.written_ns = self._clock.now_ns()


SERVE_PERIOD_NS = 50_000_000
_OFF_PATIENCE = 0.3  # s that `off` waits for a transaction of the job before it writes without the lock
_AXES = "xyz"


class PwmTorqueCoils:
    """The torque coils. Safe to call from several threads; zero can be requested at any time."""

    def __init__(self, pca: Pca9685, clock: Clock, settings: CoilSettings) -> None:
        self._clock = clock
        self._settings = settings
        self._steps = tuple(current_step(coil.resistance, settings.supply_voltage) for coil in settings.coils)
        self._largest = tuple(largest_counts(step, settings.current_limit) for step in self._steps)
        # Currents of one count; the sign is exact in either place.
        self._signed = tuple(coil.sign * step for coil, step in zip(settings.coils, self._steps, strict=True))
        self._mailbox = CommandMailbox(clock, round(settings.stale_after * 1e9))
        self._outputs = CoilOutputs(pca, clock, settings, self._mailbox.lock)
        self._running = False
        self._ticker: Ticker | None = None
        # Re-entrant: a signal handler may request zero in the middle of its own thread's call.
        self._wire = threading.RLock()
        self._serving = False
        self._served = -1  # the number of the command on the wire

    def start(self, patient: bool = False) -> None:
        """Set the PWM chip up with every output off.

        Raises DeviceError when it is silent or refuses; a `patient` start reports that in `state` and keeps
        trying.
        """
        with self._wire:
            try:
                self._outputs.set_up()
            except DeviceError as error:
                self._try_zero()
                if not patient:
                    raise
                self._outputs.failing, self._outputs.error = True, str(error)
        with self._mailbox.lock:
            self._mailbox.withdraw()
            self._mailbox.braked = NO_AXES
            self._running = True
            if self._ticker is None:
                self._ticker = self._clock.ticker(DEVICE, SERVE_PERIOD_NS, self._serve)

    def command(self, currents: FloatArray) -> None:
        """Request currents (3,) in A; values beyond the limit are limited. Never waits for the bus.

        Raises OutOfRange, and brings the coils to zero, for a wrong shape or a value that is not finite;
        Refused before `start` and after `close`.
        """
        values = np.asarray(currents, dtype=np.float64)
        problem = self._problem(values)
        ticker = self._ticker
        if problem is not None:
            self._mailbox.withdraw()
            if ticker is not None:
                ticker.kick()
            raise problem
        x, y, z = values.tolist()
        counts_x, limited_x = self._counts(0, x)
        counts_y, limited_y = self._counts(1, y)
        counts_z, limited_z = self._counts(2, z)
        with self._mailbox.lock:
            if ticker is None or not self._running:
                raise Refused(DEVICE, "a command before start() or after close()")
            self._mailbox.put((x, y, z), (counts_x, counts_y, counts_z), limited_x or limited_y or limited_z)
        ticker.kick()

    def brake(self, axes: Axes) -> None:
        """Hold both inputs of these bridges high from now on, whatever is commanded. Never waits for the bus.

        Refused before `start` and after `close`.
        """
        with self._mailbox.lock:
            ticker = self._ticker
            if ticker is None or not self._running:
                raise Refused(DEVICE, "a brake before start() or after close()")
            self._mailbox.brake(axes)
        ticker.kick()

    def off(self) -> None:
        """Bring all coils to zero now, with retries; returns when written or given up. Never raises.

        Any pending command is withdrawn, so that nothing energises the coils again until the next command.
        """
        self._mailbox.withdraw()
        held = self._wire.acquire(timeout=_OFF_PATIENCE)
        try:
            for left in reversed(range(self._settings.tries)):
                if self._try_zero():
                    if not self._outputs.failing:
                        self._outputs.error = ""
                    return
                if left:
                    self._outputs.wait()
            self._outputs.failing = True
        finally:
            if held:
                self._wire.release()

    def state(self) -> CoilState:
        """Return the written state; after a failure, the last acknowledged state."""
        mailbox, outputs = self._mailbox, self._outputs
        with mailbox.lock:
            return _state_of(
                mailbox.command,
                outputs.written,
                self._signed,
                outputs.written_ns,
                mailbox.saturated,
                mailbox.command_ns,
                mailbox.stale,
                outputs.faults,
                outputs.error,
                outputs.braked,
            )

    def close(self) -> None:
        """Stop the job and bring the coils to zero. Safe to call twice. The shared bus stays open."""
        with self._mailbox.lock:
            was_running, self._running = self._running, False
            ticker, self._ticker = self._ticker, None
            self._mailbox.withdraw()
        if ticker is not None:
            ticker.stop()
        if was_running or self._outputs.failing or any(self._outputs.written):
            self.off()

    def _problem(self, values: FloatArray) -> OutOfRange | None:
        if values.shape != (3,):
            return OutOfRange(DEVICE, "number of currents", values.size, 3, 3, "")
        for axis, value in enumerate(values.tolist()):
            if not math.isfinite(value):
                bound = mean_current(self._largest[axis], self._steps[axis])
                return OutOfRange(DEVICE, f"current of coil {_AXES[axis]}", value, -bound, bound, "A")
        return None

    def _counts(self, axis: int, current: float) -> tuple[int, bool]:
        counts, limited = counts_for(current, self._steps[axis], self._largest[axis])
        return counts * self._settings.coils[axis].sign, limited

    def _try_zero(self) -> bool:
        return self._outputs.zero(self._mailbox.braked)

    def _serve(self) -> None:
        """Bring the wire up to date; the job of the clock."""
        with self._wire:
            # Re-entered while waiting: simulated time runs then, and signals arrive.
            if self._serving or not self._running:
                return
            self._serving = True
            try:
                self._update_outputs()
            finally:
                self._serving = False

    def _update_outputs(self) -> None:
        outputs = self._outputs
        counts, _, number = self._mailbox.newest()
        due = outputs.check_is_due()
        if number == self._served and any(counts) and not due and not outputs.failing:
            return
        # A failing chip first gets the one message that is right in every state: off.
        if outputs.failing and not self._try_zero():
            return
        try:
            doubtful = outputs.failing
            repaired = ""
            if (outputs.failing or due) and not outputs.is_intact():
                repaired = "" if outputs.failing else outputs.error
                outputs.configure()
                doubtful = True
            self._write_newest()
            if doubtful and not outputs.keeps_written():
                raise outputs.not_kept()
        except DeviceError as error:
            outputs.failing = True
            self._try_zero()
            outputs.error = str(error)
        else:
            outputs.failing = False
            # A failure that was repaired at once is still reported until the next period.
            outputs.error = repaired

    def _write_newest(self) -> None:
        for left in reversed(range(self._settings.tries)):
            # Read again at each try: a newer command counts, above all a withdrawal.
            counts, braked, number = self._mailbox.newest()
            try:
                self._outputs.write(counts, braked)
            except DeviceError as error:
                self._outputs.count(error)
                if left == 0:
                    raise
                self._outputs.wait()
            else:
                self._served = number
                if number == self._mailbox.number:
                    return


@lru_cache(maxsize=4)
def _state_of(
    command: tuple[float, ...],
    written: tuple[int, ...],
    signed: tuple[float, ...],
    written_ns: int,
    saturated: bool,
    command_ns: int,
    stale: bool,
    faults: int,
    error: str,
    braked: Axes,
) -> CoilState:
    """Return the state, made once for all who ask in a cycle; `signed` A are the currents of a count."""
    return CoilState(
        command=np.array(command),
        current=np.array([mean_current(*axis) for axis in zip(written, signed, strict=True)]),
        written_ns=written_ns,
        saturated=saturated,
        command_ns=command_ns,
        stale=stale,
        faults=faults,
        error=error,
        braked=braked,
    )
