"""Driver of up to six torque coils, which sets the currents to zero after a failure.

Each coil is driven by an H-bridge SN754410 with two inputs A and B on a PCA9685 (Sease 2013, Table 5.2, eq.
5.33). A signed count n from -4096 to 4096 gives the direction and the duty. For n > 0, input A is high for
n/4096 of the PWM period and input B is low. For n < 0, the roles of the inputs A and B are swapped. For n =
0, both inputs are low. The time constant L/R of a coil (0.1 ms) is far shorter than the PWM period (20 ms),
so that the mean current is n/4096 V/R.

The method `command` stores the newest currents in a mailbox and wakes a periodic job. Only the periodic job
and requests for zero current use the bus. The job writes the newest command and replaces a stale command by
zero. While zero is requested, the job writes zero in each period. Twice a second the job reads configuration
and outputs back, and after a brown-out it configures the chip again. After any failure the job tries to write
zero.

Zero current is commanded by low levels at both inputs of all bridges, because the chip executes a write to
its register ALL_LED_OFF_H even if it is not configured. If a leg of a bridge is stuck high, low inputs would
drive current through the coil, so the job brakes this bridge (both inputs high) directly after the write.

Instead of a PWM chip with H-bridges, DRV8830 bridges (TI SLVSAB2) with an I2C interface and a regulated
output voltage can drive the coils, one bridge for each coil. The output voltage has 58 steps of 0.08 V, and
no values between zero and 0.48 V. A periodic job alternates between steps so that the mean voltage is the
requested voltage: it writes the step nearest to the sum of the requested voltage and the accumulated error.
The DRV8830 bridges have the interface of a PWM chip, so that `PwmTorqueCoils` performs retries, checks and
braking.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from threading import RLock
from typing import Protocol, TypeVar

import numpy as np

from hal.drivers.pca9685 import BLOCK_CHANNELS, CHANNELS, COUNTS, FULL_OFF, FULL_ON, PwmCounts
from hal.interfaces.devices import COIL_NAMES, MOST_COILS, NO_AXES, Axes, CoilState, FloatArray
from hal.interfaces.errors import DeviceError, NotResponding, OutOfRange, Refused, answering
from hal.interfaces.wires import Clock, I2cBus, Ticker

DEVICE = "coils"


@dataclass(frozen=True, slots=True)
class CoilWiring:
    """Measured properties of the connection of one coil to the PWM chip.

    Attributes:
        channel_a: PWM channel of bridge input A, which is high for a positive current.
        channel_b: PWM channel of bridge input B.
        resistance: resistance of the coil, ohm.
        sign: +1, or -1 for a coil whose leads are swapped.
        current_limit: maximum current of this coil, A, if it is less than the common limit.
    """

    channel_a: int
    channel_b: int
    resistance: float
    sign: int = 1
    current_limit: float = math.inf

    def __post_init__(self) -> None:
        if not 0.0 < self.resistance < math.inf:
            raise OutOfRange(DEVICE, "coil resistance", self.resistance, 0.0, math.inf, "ohm")
        if not self.current_limit >= 1e-3:
            raise OutOfRange(DEVICE, "coil current limit", self.current_limit, 1e-3, math.inf, "A")
        if self.sign not in {1, -1}:
            raise OutOfRange(DEVICE, "coil sign", self.sign, -1, 1, "(-1 or +1)")

    @property
    def channels(self) -> tuple[int, int]:
        """PWM channels of the bridge inputs A and B."""
        return self.channel_a, self.channel_b


Wirings = tuple[CoilWiring, ...]


def wirings(
    channels: Sequence[tuple[int, int]],
    resistance: Sequence[float],
    signs: Sequence[int],
    limits: Sequence[float],
) -> Wirings:
    """Return the wiring of the coils from the attributes of each coil.

    Raises OutOfRange under the same conditions as CoilWiring.
    """
    return tuple(
        CoilWiring(a, b, ohm, sign, limit)
        for (a, b), ohm, sign, limit in zip(channels, resistance, signs, limits, strict=True)
    )


@dataclass(frozen=True, slots=True)
class CoilSettings:
    """Settings of the coil driver.

    Attributes:
        coils: wiring of the coils.
        supply_voltage: voltage across a coil at full duty, after the losses of the bridge, V.
        current_limit: maximum current of each coil, A.
        stale_after: maximum age of a command before the coils are set to zero, s; at most 0.4 s, so that the
            coils are at zero within 0.5 s.
        tries: number of attempts before a transaction counts as failed.
        retry_wait: waiting time between two attempts, s.
    """

    coils: Wirings
    supply_voltage: float
    current_limit: float
    stale_after: float
    tries: int = 3
    retry_wait: float = 0.002

    def __post_init__(self) -> None:
        for quantity, value, low, high, unit in (
            ("number of coils", len(self.coils), 1, MOST_COILS, ""),
            ("supply voltage", self.supply_voltage, 0.1, 36.0, "V"),
            ("current limit", self.current_limit, 1e-3, 1.0, "A"),
            ("stale_after", self.stale_after, 0.05, 0.4, "s"),
            ("tries", self.tries, 1, 5, ""),
            ("retry_wait", self.retry_wait, 0.0, 0.01, "s"),
        ):
            # The negated comparison also rejects NaN.
            if not low <= value <= high:
                raise OutOfRange(DEVICE, quantity, value, low, high, unit)
        used = [channel for coil in self.coils for channel in coil.channels]
        for channel in used:
            if not 0 <= channel < CHANNELS or used.count(channel) > 1:
                raise OutOfRange(DEVICE, "PWM channel (each once)", channel, 0, CHANNELS - 1, "")

    def blocks(self) -> tuple[tuple[int, tuple[int, ...]], ...]:
        """Return the bridge inputs grouped into blocks of consecutive PWM channels: (first channel, inputs).

        Each block is written in one transaction. The bridge inputs are numbered in the order xA, xB, yA, yB,
        and so on.
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
    """Return the mean current (A) of one PWM count, V/R/4096, from resistance (ohm) and voltage (V)."""
    return supply_voltage / resistance / COUNTS


def largest_counts(step: float, current_limit: float) -> int:
    """Return the largest count, at most 4096, within a limit (A), given the current `step` (A) of a count."""
    # The factor prevents rounding from reducing a limit that is an exact multiple of the step.
    return min(COUNTS, math.floor(current_limit / step * (1.0 + 1e-12)))


def counts_for(current: float, step: float, largest: int) -> tuple[int, bool]:
    """Return the signed PWM count nearest to a mean current (A), and whether the current was limited.

    The mean current of one count is `step` (A), and the largest permitted count is `largest`. Raises
    ValueError if the current is NaN.
    """
    bound = largest * step
    if current > bound:
        return largest, True
    if current < -bound:
        return -largest, True
    return round(current / step), False


def inputs_for(counts: int) -> tuple[PwmCounts, PwmCounts]:
    """Return the PWM counts of bridge inputs A and B for a signed count (Sease 2013, Table 5.2)."""
    pulse = FULL_ON if abs(counts) >= COUNTS else (0, abs(counts))
    if counts == 0:
        return FULL_OFF, FULL_OFF
    return (pulse, FULL_OFF) if counts > 0 else (FULL_OFF, pulse)


BRAKED: tuple[PwmCounts, PwmCounts] = (FULL_ON, FULL_ON)
"""PWM counts of both bridge inputs for braking, which makes the coil current zero.

While braking, both ends of the coil are at the supply voltage, even if one leg of the bridge is stuck high.
"""

Counts = tuple[int, ...]
"""Signed PWM count of each coil, from -4096 to 4096."""


class CommandMailbox:
    """Mailbox that holds the newest command and brake request, and replaces a stale command by zero.

    Attributes:
        lock: lock of all attributes; re-entrant, because a signal handler may request zero while its own
            thread holds the lock.
        braked: indices of the bridges to be braked.
        number: number of requests (commands, withdrawals and brakes) so far.
        command: requested current of each coil, A.
        command_ns: host time of the newest command, ns; -1 before the first command.
        saturated: whether the current of any coil was limited.
        stale: whether the command was too old and was replaced by zero.
    """

    def __init__(self, clock: Clock, stale_ns: int, coils: int) -> None:
        """Accept commands for `coils` coils, and replace a command that is older than `stale_ns` by zero."""
        self.lock = threading.RLock()
        self.braked = NO_AXES
        self.number = 0
        self.command = self._at_rest = (0.0,) * coils
        self.command_ns = -1
        self.saturated = False
        self.stale = False
        self._clock, self._stale_ns = clock, stale_ns
        self._wanted: Counts | None = None  # None requests zero

    def put(self, command: tuple[float, ...], counts: Counts, saturated: bool) -> None:
        """Store a new command (A) with the corresponding signed PWM counts."""
        with self.lock:
            self.command = command
            self.command_ns = self._clock.now_ns()
            self._wanted = counts
            self.saturated = saturated
            self.stale = False
            self.number += 1

    def brake(self, axes: Axes) -> None:
        """Request that the given bridges are braked from now on, whatever currents are commanded."""
        with self.lock:
            self.braked = axes
            self.number += 1

    def withdraw(self) -> None:
        """Withdraw the command and request zero current."""
        with self.lock:
            self._wanted = None
            self.command = self._at_rest
            self.saturated = False
            self.stale = False
            self.number += 1

    def newest(self) -> tuple[Counts, Axes, int]:
        """Return the signed counts and brakes that should be written now, and the number of the request."""
        with self.lock:
            if self._wanted is not None and self._clock.now_ns() - self.command_ns > self._stale_ns:
                self._wanted = None
                self.saturated = False
                self.stale = True
                self.number += 1
            counts = self._wanted or (0,) * len(self.command)
            if self.braked:
                counts = tuple(0 if axis in self.braked else value for axis, value in enumerate(counts))
            return counts, self.braked, self.number


_CHECK_PERIOD_NS = 500_000_000

_Answer = TypeVar("_Answer")


class PwmOutputs(Protocol):
    """Interface of a PWM chip or of bridges that act like one. Every method raises DeviceError on failure."""

    name: str

    def configure(self) -> None:
        """Configure the chip with all outputs off."""

    def is_configured(self) -> bool:
        """Return whether the chip still has its configuration."""

    def holds(self, first: int, counts: Sequence[PwmCounts]) -> bool:
        """Return whether consecutive channels from `first` on have the given counts."""

    def write_channels(self, first: int, counts: Sequence[PwmCounts]) -> None:
        """Write the counts of consecutive channels."""

    def all_off(self) -> None:
        """Switch all outputs off."""


class CoilOutputs:
    """Writes the coils' signed counts to the PWM chip, and records the last acknowledged outputs.

    Attributes:
        written: signed PWM counts of the last write that the chip acknowledged.
        braked: indices of the braked bridges.
        written_ns: host time at which these counts were first written, ns; -1 before the first write.
        failing: whether the last transaction failed, so that the state of the chip is unknown.
        faults: number of failed transactions since start.
        error: text of the present failure, or an empty text.
    """

    def __init__(self, pca: PwmOutputs, clock: Clock, settings: CoilSettings, lock: RLock) -> None:
        """Use a PWM chip. The lock protects the attributes `written`, `braked` and `written_ns`."""
        self.written = self._zero = (0,) * len(settings.coils)
        self.braked = NO_AXES
        self.written_ns = -1
        self.failing = False
        self.faults = 0
        self.error = ""
        self._pca, self._clock, self._settings, self._lock = pca, clock, settings, lock
        self._blocks = settings.blocks()
        # The newest counts and brakes, and the blocks that contain them.
        self._placed: tuple[tuple[Counts, Axes], list[tuple[int, tuple[PwmCounts, ...]]]] | None = None
        self._retry_ns = round(settings.retry_wait * 1e9)
        self._check_ns = 0

    def set_up(self) -> None:
        """Configure the chip with all outputs off, with retries. Raises DeviceError."""
        self._retried(self.configure)
        self.failing, self.error = False, ""

    def configure(self) -> None:
        """Configure the chip with all outputs off, without retries. Raises DeviceError."""
        self._pca.configure()
        self._record(self._zero, NO_AXES)
        self._postpone_check()

    def check_is_due(self) -> bool:
        """Return whether configuration and outputs should be read back now."""
        return self._clock.now_ns() >= self._check_ns

    def is_intact(self) -> bool:
        """Return, with retries, whether the chip has its configuration and outputs. Raises NotResponding."""
        held, kept = self._retried(self._read_back)
        if kept:
            self._postpone_check()
        elif held:
            self.count(self.not_kept())
        else:
            self.count(Refused(self._pca.name, "has lost its register settings (brown-out?)"))
        return kept

    def keeps_written(self) -> bool:
        """Return whether the outputs still have the last written counts. Raises NotResponding."""
        blocks = self._channel_blocks(self.written, self.braked)
        return all(self._pca.holds(first, block) for first, block in blocks)

    def not_kept(self) -> DeviceError:
        """Return an error that states that the outputs differ from the written counts."""
        return Refused(self._pca.name, "does not keep the values written to its output registers")

    def write(self, counts: Counts, braked: Axes) -> None:
        """Write signed counts and brakes without retries. Raises DeviceError."""
        for first, block in self._channel_blocks(counts, braked):
            self._pca.write_channels(first, block)
        self._record(counts, braked)

    def zero(self, braked: Axes) -> bool:
        """Write zero, then brake the bridges of `braked`. Return whether the chip acknowledged the writes."""
        try:
            self._pca.all_off()
            self._record(self._zero, NO_AXES)
            # A chip that has lost its configuration would misinterpret a block of counts.
            if braked and not self.failing:
                self.write(self._zero, braked)
        except NotResponding as error:
            self.count(error)
            return False
        return True

    def count(self, error: DeviceError) -> None:
        """Count a failed transaction and store the text of its error."""
        self.faults += 1
        self.error = str(error)

    def wait(self) -> None:
        """Wait until the next retry is due."""
        self._clock.sleep_until_ns(self._clock.now_ns() + self._retry_ns)

    def _retried(self, action: Callable[[], _Answer]) -> _Answer:
        """Call `action` with retries and return its result. Raises the DeviceError of the last attempt."""
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
        """Return whether the chip has kept its configuration, and whether it has also kept its outputs."""
        held = self._pca.is_configured()
        # Zero is not read back, because zero is written again in each period.
        driven = any(self.written) or bool(self.braked)
        return held, held and (not driven or self.keeps_written())

    def _postpone_check(self) -> None:
        self._check_ns = self._clock.now_ns() + _CHECK_PERIOD_NS

    def _channel_blocks(self, counts: Counts, braked: Axes) -> list[tuple[int, tuple[PwmCounts, ...]]]:
        """Return the first channel and the PWM counts of each block of consecutive channels."""
        if self._placed is None or self._placed[0] != (counts, braked):
            pins: list[PwmCounts] = []
            for axis, value in enumerate(counts):
                pins += BRAKED if axis in braked else inputs_for(value)
            blocks = [(first, tuple(pins[member] for member in members)) for first, members in self._blocks]
            self._placed = (counts, braked), blocks
        return self._placed[1]

    def _record(self, counts: Counts, braked: Axes) -> None:
        """Record acknowledged PWM counts and braked bridges; equal values do not change the recorded time."""
        with self._lock:
            if self.written_ns < 0 or (counts, braked) != (self.written, self.braked):
                self.written, self.braked = counts, braked
                self.written_ns = self._clock.now_ns()


SERVE_PERIOD_NS = 50_000_000
_OFF_PATIENCE = 0.3  # longest time (s) for which `off` waits for the lock


class PwmTorqueCoils:
    """Driver of the torque coils. All methods are thread-safe."""

    def __init__(self, pca: PwmOutputs, clock: Clock, settings: CoilSettings) -> None:
        self._clock, self._settings = clock, settings
        self._steps = tuple(current_step(coil.resistance, settings.supply_voltage) for coil in settings.coils)
        self._largest = tuple(
            largest_counts(step, min(settings.current_limit, coil.current_limit))
            for coil, step in zip(settings.coils, self._steps, strict=True)
        )
        self._signs = tuple(coil.sign for coil in settings.coils)
        # Mean current (A) of one count of each coil, multiplied by the sign of the coil.
        self._signed = tuple(sign * step for sign, step in zip(self._signs, self._steps, strict=True))
        self._mailbox = CommandMailbox(clock, round(settings.stale_after * 1e9), len(settings.coils))
        self._outputs = CoilOutputs(pca, clock, settings, self._mailbox.lock)
        self._running = False
        self._ticker: Ticker | None = None
        # The lock is re-entrant, because a signal handler may request zero while its thread holds the lock.
        self._wire = threading.RLock()
        self._serving = False
        self._served = -1  # number of the last written request
        # The newest command (A), its signed PWM counts, and whether any current was limited.
        self._converted: tuple[tuple[float, ...], Counts, bool] = ((), (), False)
        # Newest state of the driver, and the values from which this state was made.
        self._state: CoilState
        self._state_key: tuple[object, ...] = ()

    def start(self, patient: bool = False) -> None:
        """Configure the PWM chip; a `patient` driver reports a failure by `state` and keeps trying."""
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
        """Request the current of each coil (n,), A, as `hal.interfaces.devices.TorqueCoils` describes.

        Currents of a wrong shape are handled like values that are not finite. Raises Refused before `start`
        and after `close`.
        """
        values = np.asarray(currents, dtype=np.float64)
        problem = self._problem(values)
        ticker = self._ticker
        if problem is not None:
            self._mailbox.withdraw()
            if ticker is not None:
                ticker.kick()
            raise problem
        command: tuple[float, ...] = tuple(values.tolist())
        if command != self._converted[0]:
            self._converted = command, *self._counts(command)
        with self._mailbox.lock:
            if ticker is None or not self._running:
                raise Refused(DEVICE, "currents cannot be commanded before start() or after close()")
            self._mailbox.put(command, *self._converted[1:])
        ticker.kick()

    def brake(self, axes: Axes) -> None:
        """Brake the given bridges. Never waits. Raises Refused before `start` and after `close`."""
        with self._mailbox.lock:
            ticker = self._ticker
            if ticker is None or not self._running:
                raise Refused(DEVICE, "bridges cannot be braked before start() or after close()")
            self._mailbox.brake(axes)
        ticker.kick()

    def off(self) -> None:
        """Set all coils to zero now, and withdraw a pending command. Never raises."""
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
        """Return the newest command and the last acknowledged output; equal states share one object."""
        mailbox, outputs = self._mailbox, self._outputs
        with mailbox.lock:
            command, written = mailbox.command, outputs.written
            flags = outputs.written_ns, mailbox.saturated, mailbox.command_ns, mailbox.stale
            more = *flags, outputs.faults, outputs.error, outputs.braked
            if (command, written, more) != self._state_key:
                self._state_key = command, written, more
                current = [counts * step for counts, step in zip(written, self._signed, strict=True)]
                self._state = CoilState(np.array(command), np.array(current), *more)
            return self._state

    def close(self) -> None:
        """Stop the job and set the coils to zero; the shared bus stays open. A second call has no effect."""
        with self._mailbox.lock:
            was_running, self._running = self._running, False
            ticker, self._ticker = self._ticker, None
            self._mailbox.withdraw()
        if ticker is not None:
            ticker.stop()
        if was_running or self._outputs.failing or any(self._outputs.written):
            self.off()

    def _counts(self, command: tuple[float, ...]) -> tuple[Counts, bool]:
        """Return the signed PWM counts of currents (n,), A, and whether any current was limited."""
        counts, is_limited = [], False
        for current, step, largest, sign in zip(
            command, self._steps, self._largest, self._signs, strict=True
        ):
            count, limited = counts_for(current, step, largest)
            counts.append(sign * count)
            is_limited = is_limited or limited
        return tuple(counts), is_limited

    def _problem(self, values: FloatArray) -> OutOfRange | None:
        if values.shape != (number := len(self._steps),):
            return OutOfRange(DEVICE, "number of currents", values.size, number, number, "")
        for axis, value in enumerate(values.tolist()):
            if not math.isfinite(value):
                bound = self._largest[axis] * self._steps[axis]
                return OutOfRange(DEVICE, f"current of coil {COIL_NAMES[axis]}", value, -bound, bound, "A")
        return None

    def _try_zero(self) -> bool:
        return self._outputs.zero(self._mailbox.braked)

    def _serve(self) -> None:
        """Write the newest request to the chip. The clock calls this method periodically."""
        with self._wire:
            # The job may be called again while it waits, by a signal handler or by the simulated clock.
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
        # A failing chip is first set to zero, because this command works in any state of the chip.
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
            # The mailbox is read at each attempt, because a newer request may have arrived.
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


CONTROL, FAULT = 0x00, 0x01
CLEAR, OFF, BRAKE = 0x80, 0x00, 0b11
FORWARD, REVERSE = 0b01, 0b10
STEP_V = 4.0 * 1.285 / 64
FIRST_STEP, LAST_STEP = 0x06, 0x3F
_LARGEST_ERROR = 0.5 * FIRST_STEP * STEP_V
"""Largest difference (V) between a voltage and the nearest step."""
PERIOD_NS = 10_000_000


def control_of(volts: float) -> int:
    """Return the value of the register CONTROL whose signed output voltage is nearest to `volts` (V)."""
    steps = round(abs(volts) / STEP_V)
    if steps < FIRST_STEP:
        steps = FIRST_STEP if 2.0 * abs(volts) > FIRST_STEP * STEP_V else 0
    if steps == 0:
        return OFF
    return min(steps, LAST_STEP) << 2 | (FORWARD if volts > 0.0 else REVERSE)


def volts_of(control: int) -> float:
    """Return the output voltage (V) of a value of the register CONTROL."""
    direction = {FORWARD: 1.0, REVERSE: -1.0}.get(control & 0b11, 0.0)
    return direction * (control >> 2) * STEP_V


class Drv8830Bridges:
    """DRV8830 chips at consecutive addresses, with the interface of `hal.drivers.coils.PwmOutputs`."""

    def __init__(self, bus: I2cBus, address: int, clock: Clock, settings: CoilSettings) -> None:
        self.name = f"drv8830 at 0x{address:02x}"
        self._bus, self._address, self._clock = bus, address, clock
        self._pins = [coil.channels for coil in settings.coils]
        self._voltage = settings.supply_voltage
        self._duty: dict[int, PwmCounts] = {}
        self._error = [0.0] * len(self._pins)
        self._written = [OFF] * len(self._pins)
        self._ticker: Ticker | None = None
        # The lock is needed because the coil driver's thread sets duties while the modulation runs.
        self._lock = threading.RLock()

    def configure(self) -> None:
        """Switch all bridges off, and clear their faults. Raises NotResponding."""
        self.all_off()
        for index in range(len(self._pins)):
            self._write(index, FAULT, CLEAR)
        if self._ticker is None:
            self._ticker = self._clock.ticker("drv8830", PERIOD_NS, self._modulate)

    def is_configured(self) -> bool:
        """Return whether every chip has kept its output and reports no fault. Raises NotResponding."""
        intact = True
        with self._lock:
            for index, written in enumerate(self._written):
                with answering(self.name):
                    control, fault = self._bus.read_i2c_block_data(self._address + index, CONTROL, 2)
                intact = intact and control == written and not fault & 1
        return intact

    def holds(self, first: int, channels: Sequence[PwmCounts]) -> bool:
        """Return whether the outputs from channel `first` on were last set to `channels` and are intact.

        Raises NotResponding.
        """
        written = [self._duty.get(first + offset, FULL_OFF) for offset in range(len(channels))]
        return written == list(channels) and self.is_configured()

    def write_channels(self, first: int, channels: Sequence[PwmCounts]) -> None:
        """Set the duties of the bridge inputs from channel `first` on. Raises NotResponding."""
        with self._lock:
            self._duty |= {first + offset: counts for offset, counts in enumerate(channels)}
            self._modulate()

    def all_off(self) -> None:
        """Switch all bridges off. If a chip does not answer, try the others and then raise NotResponding."""
        failed: NotResponding | None = None
        with self._lock:
            self._duty.clear()
            self._error = [0.0] * len(self._pins)
            for index in range(len(self._pins)):
                try:
                    self._write(index, CONTROL, OFF)
                except NotResponding as error:
                    failed = error
        if failed is not None:
            raise failed

    def stop(self) -> None:
        """Stop the modulation."""
        if self._ticker is not None:
            self._ticker.stop()

    def _modulate(self) -> None:
        """Write the next voltage step of every coil. The clock calls this method periodically."""
        with self._lock:
            for index, pins in enumerate(self._pins):
                a, b = (_high(self._duty.get(pin, FULL_OFF)) for pin in pins)
                wanted = (a - b) / COUNTS * self._voltage + self._error[index]
                control = control_of(wanted)
                if a == b:
                    control, wanted = (BRAKE, 0.0) if a else (OFF, 0.0)
                # The limit acts only if rounding makes `wanted` larger than the highest voltage of a bridge.
                self._error[index] = min(max(wanted - volts_of(control), -_LARGEST_ERROR), _LARGEST_ERROR)
                if control != self._written[index]:
                    self._write(index, CONTROL, control)

    def _write(self, index: int, register: int, value: int) -> None:
        with answering(f"drv8830 at 0x{self._address + index:02x}"):
            self._bus.write_byte_data(self._address + index, register, value)
        if register == CONTROL:
            self._written[index] = value


class Drv8830Coils(PwmTorqueCoils):
    """Driver of torque coils on DRV8830 bridges."""

    def __init__(self, bridges: Drv8830Bridges, clock: Clock, settings: CoilSettings) -> None:
        super().__init__(bridges, clock, settings)
        self._bridges = bridges

    def close(self) -> None:
        """Stop the modulation and set the coils to zero."""
        self._bridges.stop()
        super().close()


def _high(counts: PwmCounts) -> int:
    """Return the number of counts per PWM period during which an output is high."""
    on, off = counts
    return 0 if off >= COUNTS else COUNTS if on >= COUNTS else off - on
