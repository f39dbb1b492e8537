"""The shape of a flight configuration: the sections of every body, each value with unit and bounds.

A configuration says what the flight application believes and how its devices are wired. What the simulated
world really does stands in its `simulation` section, whose shape is sim_hal's own (`sim_hal.settings`).
SI units unless the name says otherwise.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

import msgspec
from msgspec import Meta

from flight.schema.aim import Aim, GoalName
from flight.schema.devices import Camera, Coils, InertialUnit, PowerMonitor
from flight.schema.orbit_devices import Gps, SolarStrings, WideCamera
from flight.schema.values import Q2, CommandedMode, HostPort, NotNegative, Peer, PlainMode, Positive, Section


class Executive(Section, frozen=True, kw_only=True):
    """Rates of the loop and bounds of its workers."""

    control_rate_hz: Annotated[float, Meta(ge=1.0, le=200.0)] = 40.0
    planner_timeout: Positive = 2.0
    vision_timeout: Positive = 10.0


class Estimation(Section, frozen=True, kw_only=True):
    """The multiplicative Kalman filter of attitude, rate, gyro bias and disturbance.

    `*_start` are initial standard deviations of the other states: the gyro's bias, rad/s; the coils' gain;
    and the age, s, that the inertial unit's samples have at their stamp, which may walk by `latency_walk`,
    s per sqrt(s). Zero: known.
    `coast` is for how long, s, the model carries the estimate on without a measurement; no coil is driven by
    what it carries (`inertial_unit.max_age`). Since an earlier boot learned a value it may have `changed` by
    this part of its standard deviation at the start.
    """

    current_noise: NotNegative = 2.0e-3
    disturbance_walk: Positive = 5.0e-5
    bias_start: Positive = 1.0e-3
    gain_start: NotNegative = 0.15
    latency_start: NotNegative = 0.03
    latency_walk: NotNegative = 3.0e-3
    gate_sigma: Annotated[float, Meta(ge=3.0)] = 15.0
    history: Positive = 6.0
    coast: Positive = 1.2
    changed: Annotated[float, Meta(gt=0.0, le=1.0)] = 0.3


class Modes(Section, frozen=True, kw_only=True):
    """Where the start leads, and what leads on from mode to mode (`flight.loop.modes`).

    After `crash_limit` unclean shutdowns within `crash_window` s of operation the start leads to safe instead
    of `initial`. A slew has arrived within `arrived_angle` rad and `arrived_rate` rad/s for `arrived_for` s;
    it is late after `slew_limit` s. A hold is impossible that is `hold_error` rad off for `hold_patience` s;
    a target of the demonstration is to be held from the end of the first path to it on. A body turns too fast
    to hold or slew beyond `tumble_rate` rad/s. Without an estimate for `blind_limit` s the mode is safe.
    A body that acquires its attitude goes on to `acquired` once the attitude has been known for `known_for`
    s, and acquires the attitude again after `lost_for` s without it.
    """

    initial: PlainMode = "testbed-demo"
    crash_limit: Annotated[int, Meta(ge=1, le=16)] = 3
    crash_window: Positive = 600.0
    boot_patience: Positive = 10.0
    arrived_angle: Positive = 0.01
    arrived_rate: Positive = 0.01
    arrived_for: Positive = 1.0
    slew_limit: Positive = 120.0
    hold_error: Positive = 0.5
    hold_patience: Positive = 15.0
    tumble_rate: Positive = 0.5
    blind_limit: Positive = 60.0
    acquired: Literal["point", "sun", "acquire"] = "point"
    known_for: Positive = 5.0
    lost_for: Positive = 10.0


class Detumble(Section, frozen=True, kw_only=True):
    """Detumbling by the magnetometer: windows with the coils off, and its end.

    Times in s: `settle` after the coils went off until the field is trusted, `measure` while it is averaged,
    `act` with the coils on. Detumbling is over when the rate has been below `low_rate` rad/s for `low_for` s.
    """

    settle: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.05
    measure: Annotated[float, Meta(ge=0.02, le=1.0)] = 0.05
    act: Annotated[float, Meta(ge=0.02, le=5.0)] = 0.15
    low_rate: Positive = 0.02
    low_for: Positive = 2.0


class Health(Section, frozen=True, kw_only=True):
    """Bounds of what the flight may take of its board (`flight.loop.health`); looked at in real time.

    `cpu_share` of one core, `memory` and `disk_free` in bytes, `memory_slope` in bytes an hour over at least
    `slope_window` s after `warm_up` s; temperatures in degree C; `clock_step` in s.
    """

    look_period: Annotated[float, Meta(ge=0.5, le=600.0)] = 5.0
    warm_up: NotNegative = 120.0
    slope_window: Positive = 1200.0
    cpu_share: Positive = 0.7
    memory: Positive = 1.0e9
    memory_slope: Positive = 1.0e7
    disk_free: Positive = 2.0e8
    temperature: float = 80.0
    hottest: float = 95.0
    clock_step: Positive = 0.5


class CommandStep(Aim, frozen=True, kw_only=True):
    """One command of a time line, at `at` s of mission time.

    A mode, a slew to q2, a goal to point to with its values, or an event to clear.
    """

    at: NotNegative
    mode: CommandedMode | None = None
    slew: Q2 | None = None
    point: GoalName | None = None
    clear: Annotated[str, Meta(min_length=1, max_length=32)] | None = None


class Commands(Section, frozen=True, kw_only=True):
    """Where commands come from: a UNIX datagram socket, UDP on a bench, and a time line.

    `udp` (HOST:PORT) must be a loopback address: beyond the machine commands come by the `link`, with keys.
    """

    socket: Annotated[str, Meta(min_length=1, max_length=100)] | None = None
    udp: HostPort | None = None
    timeline: tuple[CommandStep, ...] = ()


class LinkSerial(Section, frozen=True, kw_only=True):
    """A serial line to a radio: device file and bits per second."""

    device: Annotated[str, Meta(pattern=r"^/[A-Za-z0-9_./:+-]+$", description="a device file")]
    baud: Annotated[int, Meta(ge=1200, le=4_000_000)] = 115200


class Link(Section, frozen=True, kw_only=True):
    """The link process (`python -m flight link`): protected frames to and from the ground.

    `keys` is the folder of keys and counters (`python -m ground keys`), `spacecraft` the identifier in each
    frame. Lines: `udp` and `tcp` listen at HOST:PORT, open to `peers` only (without them the machine itself
    where the address is a loopback address, the 256 addresses around it where it is another); `serial` is a
    radio's. Telemetry goes to authentic senders, to `telemetry_to` (HOST:PORT, UDP), to all of `tcp` and to
    `serial`: frames of `frame_bytes`, at most `rate` bytes/s of each line.
    """

    keys: Annotated[str, Meta(min_length=1)]
    spacecraft: Annotated[int, Meta(ge=0, le=1023)] = 0x1A5
    udp: HostPort | None = None
    telemetry_to: HostPort | None = None
    tcp: HostPort | None = None
    serial: LinkSerial | None = None
    peers: Annotated[tuple[Peer, ...], Meta(min_length=1)] | None = None
    frame_bytes: Annotated[int, Meta(ge=128, le=2048)] = 1115
    rate: Annotated[float, Meta(ge=100.0, le=1.0e7)] = 50_000.0


class Telemetry(Section, frozen=True, kw_only=True):
    """Sizes of the flight log and of the performance log, of each; and of all the runs of an archive."""

    segment_bytes: Annotated[int, Meta(ge=4096)] = 16 * 1024 * 1024
    budget_bytes: Annotated[int, Meta(ge=16384)] = 1024 * 1024 * 1024
    archive_bytes: Annotated[int, Meta(ge=32768)] = 8 * 1024 * 1024 * 1024


class State(Section, frozen=True, kw_only=True):
    """What outlives the process (`flight.loop.state`): its folder, and the period of its writing, s.

    Without a folder it is kept in systemd's STATE_DIRECTORY where real devices are flown, else nowhere.
    """

    folder: Annotated[str, Meta(min_length=1)] | None = None
    period: Annotated[float, Meta(ge=1.0, le=3600.0)] = 10.0


class Config(Section, frozen=True, kw_only=True):
    """The sections of every body's configuration; each body has a shape of its own with more of them.

    `body` is the body that is flown, or a third party's as `module:object`.
    """

    name: Annotated[str, Meta(min_length=1, max_length=64)]
    body: Annotated[str, Meta(min_length=1, max_length=200)] = "testbed"
    inertial_unit: InertialUnit
    coils: Coils
    power_monitor: PowerMonitor | None = None
    camera: Camera | None
    gps: Gps | None = None
    solar_strings: SolarStrings | None = None
    wide_cameras: Annotated[tuple[WideCamera, ...], Meta(max_length=6)] = ()
    executive: Executive = Executive()
    estimation: Estimation = Estimation()
    modes: Modes = Modes()
    detumble: Detumble = Detumble()
    health: Health = Health()
    commands: Commands = Commands()
    link: Link | None = None
    duration: Positive
    telemetry: Telemetry = Telemetry()
    state: State = State()
    simulation: dict[str, Any] | None = None

    def field_range(self) -> tuple[float, float]:
        """Return the smallest and the largest strength of a valid magnetometer reading, T."""
        return 0.0, self.inertial_unit.field_range

    def replan_period(self) -> float | None:
        """Return how often a path is planned from the newest estimate, s; None for a body that plans none."""
        return None

    def hardware(self) -> tuple[Section, ...]:
        """Return the sections of body and devices for which learned parameters hold."""
        return (self.coils, self.inertial_unit)

    def shortened(self, duration: float) -> Self:
        """Return the configuration of a flight of `duration` s."""
        return msgspec.structs.replace(self, duration=duration)
