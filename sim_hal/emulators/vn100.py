"""An emulated VN-100 on the device end of a serial line.

It executes commands through `vn100_commands` and sends the measurements of `vn100_sensors` in the formats of
`vn100_outputs`, on the 800 Hz grid of its own clock. Registers that tune its estimation (21 to 26, 32 to 51,
74, 82 to 84) are stored and echoed without effect, except the heading mode of 35; of register 85 the windows
of magnetometer, accelerometer and gyro have an effect. Not emulated: SYNC lines, the second serial port. The
500 ms of a flash write are VectorNav's; the second of start-up is assumed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.frames import NED_TO_TESTBED
from knightcube.astro.quaternion import IDENTITY
from sim_hal.emulators.device import NEVER, SerialEnd
from sim_hal.emulators.vn100_attitude import AttitudeCommands
from sim_hal.emulators.vn100_commands import CommandInterface, UnitActions
from sim_hal.emulators.vn100_outputs import REPORT_BY_TYPE, Instant, report_length
from sim_hal.emulators.vn100_registers import ASYNC_RATES_HZ, RegisterFile, UnitError
from sim_hal.emulators.vn100_sensors import IMU_RATE_HZ, PROFILES, Measured, NoiseProfile, Sensors
from sim_hal.emulators.vn100_streams import OutputStreams
from sim_hal.worlds.motion import Motion

TICK_NS = 1_000_000_000 // IMU_RATE_HZ
_BILLION = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Vn100EmulatorSettings:
    """The properties of this unit.

    Attributes:
        noise: its noise profile.
        mounting: (4,) sensor axes into body axes.
        reference: (4,) NED into the world's reference frame.
        gyro_bias: (3,) rad/s, sensor axes.
        clock_ppm: how much faster than true its clock runs.
        uptime_ns: its own time when the simulation begins; the remainder of 25 ms is its phase.
        boot_ns: from reset to the first message. flash_ns: to write the flash.
        temperature: degrees C. pressure: kPa.
        free_fall: there is no gravity for its own attitude to stand on.
    """

    noise: NoiseProfile = PROFILES["thesis"]
    mounting: FloatArray = field(default_factory=IDENTITY.copy)
    reference: FloatArray = field(default_factory=NED_TO_TESTBED.copy)
    gyro_bias: FloatArray = field(default_factory=lambda: np.zeros(3))
    clock_ppm: float = 0.0
    uptime_ns: int = 10_000_000_000
    boot_ns: int = 1_000_000_000
    flash_ns: int = 500_000_000
    temperature: float = 20.0
    pressure: float = 101.325
    free_fall: bool = False


class Vn100Emulator:
    """The unit; a `sim_hal.emulators.device.EmulatedDevice`.

    Attributes:
        alter: changes each measurement before it is sent, for faults.
    """

    def __init__(
        self,
        sense: Callable[[int], Motion],
        line: SerialEnd,
        rng: np.random.Generator,
        settings: Vn100EmulatorSettings,
        now_ns: int = 0,
    ) -> None:
        """Start at `now_ns`, the unit on for `settings.uptime_ns`; `sense` returns the motion at a time."""
        self.registers = RegisterFile()
        self.alter: Callable[[Measured], Measured] | None = None
        self._sense = sense
        self._line = line
        self._settings = settings
        bias = settings.gyro_bias
        self._sensors = Sensors(
            rng, settings.noise, settings.mounting, settings.reference, bias, settings.free_fall
        )
        self._clock_rate = _BILLION + round(settings.clock_ppm * 1000)
        self._then: tuple[int, Callable[[int], None]] | None = None
        self._streams = OutputStreams(self.registers)
        actions = UnitActions(self._instant_now, self._build_streams, self._write_flash, self._restart)
        self._attitude = AttitudeCommands(self.registers, bias)
        self._commands = CommandInterface(line, self.registers, self._streams, actions, self._attitude)
        self._origin_ns = now_ns
        self._uptime_ns = settings.uptime_ns
        self._tick = -1
        self._tick_due = 0
        self._due_ns = NEVER
        self._start(now_ns, settings.uptime_ns)

    def next_event_ns(self) -> int:
        """Return when the unit next receives or sends something."""
        return min(self._line.next_arrival_ns(), self._due_ns)

    def advance(self, now_ns: int) -> None:
        """Receive and send all that is due at or before `now_ns`."""
        while (event_ns := self.next_event_ns()) <= now_ns:
            if self._due_ns <= event_ns:
                self._act(event_ns)
            else:
                data = self._line.read(event_ns)
                if self._then is None:  # A unit that starts, or writes its flash, receives nothing.
                    self._commands.receive(data, event_ns)
            self._schedule(event_ns)

    def set_baud_rate(self, baud_rate: int) -> None:
        """Save this speed in the flash, with the fastest output rate that fits. Raises UnitError."""
        self.registers.write(5, (str(baud_rate),))
        length = report_length(REPORT_BY_TYPE[14])
        fitting = [rate for rate in ASYNC_RATES_HZ if rate <= 40 and 10 * length * rate <= baud_rate]
        self.registers.write(7, (str(fitting[-1]),))
        self._build_streams(self._origin_ns)
        self.registers.save()
        self._line.baud_rate = baud_rate

    def switch_off(self) -> None:
        """Remove the power."""
        self._then = NEVER, lambda _: None
        self._due_ns = NEVER

    def switch_on(self, now_ns: int) -> None:
        """Apply power, or reset: the unit restarts from its flash."""
        self._restart(now_ns)
        self._schedule(now_ns)

    def change_baud_rate(self, baud_rate: int, now_ns: int) -> None:
        """Change the line's speed, as a write of register 5 does."""
        self.registers.write(5, (str(baud_rate),))
        self._line.baud_rate = baud_rate
        self._build_streams(now_ns)

    def upset(self, register: int, bit: int, now_ns: int) -> None:
        """Flip a bit of a register that configures the outputs, as radiation does.

        Assumed: an output whose register is invalid, or asks for more than the line carries, is silent until
        that register is written.
        """
        try:
            self.registers.flip(register, bit)
            self._build_streams(now_ns)
        except UnitError:
            self._streams.muted.add(register)
            self._build_streams(now_ns)
        self._schedule(now_ns)

    # Time: ticks of 1/800 s of the unit's own clock.

    def _device_ns(self, now_ns: int) -> int:
        return self._uptime_ns + (now_ns - self._origin_ns) * self._clock_rate // _BILLION

    def _tick_ns(self, tick: int) -> int:
        return self._origin_ns - (self._uptime_ns - tick * TICK_NS) * _BILLION // self._clock_rate

    def _schedule(self, now_ns: int) -> None:
        if self._then is not None:
            self._due_ns = self._then[0]
            return
        tick = self._streams.next_tick(max(self._tick, self._device_ns(now_ns) // TICK_NS))
        if self._commands.paused or tick is None:
            self._due_ns = NEVER
        else:
            self._tick_due = tick
            self._due_ns = self._tick_ns(tick)

    def _act(self, now_ns: int) -> None:
        if self._then is not None:
            _, action = self._then
            self._then = None
            action(now_ns)
            return
        self._tick = self._tick_due
        device_ns = self._tick * TICK_NS
        measured = self._measure(now_ns)
        for stream in self._streams.due(self._tick):
            self._line.write(stream.message(self._instant(device_ns, measured, stream.sent_ns)), now_ns)
            stream.sent_ns = device_ns

    # Output.

    def _measure(self, now_ns: int) -> Measured:
        windows = tuple(self.registers.integer(85, index) for index in range(3))
        measured = self._attitude.turned(self._sensors.measure(self._sense(now_ns), windows))
        return measured if self.alter is None else self.alter(measured)

    def _instant(self, device_ns: int, measured: Measured, since_ns: int) -> Instant:
        interval = (device_ns - since_ns) * 1e-9
        settings = self._settings
        return Instant(
            device_ns, measured, self._attitude.status, interval, settings.temperature, settings.pressure
        )

    def _instant_now(self, now_ns: int) -> Instant:
        device_ns = self._device_ns(now_ns)
        return self._instant(device_ns, self._measure(now_ns), device_ns - TICK_NS)

    def _build_streams(self, now_ns: int) -> None:
        self._streams.build(self._device_ns(now_ns))

    # Power.

    def _write_flash(self, now_ns: int, done: Callable[[int], None]) -> None:
        self.registers.save()
        self._then = now_ns + self._settings.flash_ns, done

    def _restart(self, now_ns: int) -> None:
        self._then = now_ns + self._settings.boot_ns, lambda end_ns: self._start(end_ns, 0)

    def _start(self, now_ns: int, uptime_ns: int) -> None:
        """Start from the flash, with the unit's clock at `uptime_ns`."""
        self.registers.load()
        self._line.baud_rate = self.registers.integer(5)
        self._sensors.restart()
        self._commands.reset()
        self._streams.reset()
        self._origin_ns = now_ns
        self._uptime_ns = uptime_ns
        self._tick = uptime_ns // TICK_NS
        self._build_streams(now_ns)
        self._schedule(now_ns)
