"""The sections of every body's configuration, each value with its bounds.

A configuration holds what the flight application assumes and how its devices are wired. The simulated world
is described by the `simulation` section, whose shape belongs to sim_hal (`sim_hal.settings`). SI units unless
the name says otherwise.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

import msgspec
from msgspec import Meta

from flight.schema.devices import (
    Camera,
    Coils,
    Gps,
    InertialUnitSection,
    PowerMonitorSection,
    SolarStringsSection,
    WideCamera,
)
from flight.schema.values import (
    Q2,
    Aim,
    CommandedMode,
    GoalName,
    HostPort,
    NotNegative,
    Peer,
    PlainMode,
    Positive,
    Section,
    Share,
)

CONTROL_RATE_HZ = 40.0
"""Rate of the control loop, Hz."""


class Executive(Section, frozen=True, kw_only=True):
    """Time limits of the workers, s."""

    planner_timeout: Positive = 2.0
    vision_timeout: Positive = 10.0


class Estimation(Section, frozen=True, kw_only=True):
    """The multiplicative Kalman filter of attitude, rate, gyro bias and disturbance.

    `bias_start` (rad/s, gyro bias), `gain_start` (coils) and `latency_start` (s, age of the inertial unit's
    samples at their stamp) are initial standard deviations; zero fixes the state. The latency walks by
    `latency_walk` s per sqrt(s). For `coast` s without a measurement the model propagates the estimate, but
    drives no coil (`inertial_unit.max_age`). A value that an earlier boot learned may have changed by the
    part `changed` of its initial standard deviation.
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
    changed: Share = 0.3


class Modes(Section, frozen=True, kw_only=True):
    """The first mode, and the conditions for mode changes (`flight.loop.modes`).

    After `crash_limit` recent unclean shutdowns the first mode is safe instead of `initial`. A slew has
    arrived when it stays within `arrived_angle` rad and `arrived_rate` rad/s for `arrived_for` s; it is late
    after `slew_limit` s. Holding fails when the error exceeds `hold_error` rad for `hold_patience` s; in the
    demonstration this is checked from the end of the first path to a target. Above `tumble_rate` rad/s the
    body rotates too fast to hold or slew. After `blind_limit` s without an estimate the mode is safe. A body
    that acquires its attitude changes to the mode `acquired` when the attitude has been known for `known_for`
    s, and acquires the attitude again after `lost_for` s without it.
    """

    initial: PlainMode = "testbed-demo"
    crash_limit: Annotated[int, Meta(ge=1, le=16)] = 3
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
    """Detumbling by the magnetometer, which measures while the coils are off.

    Each cycle waits `settle` s for the coils' field to decay, averages the field for `measure` s and drives
    the coils for `act` s. Detumbling ends when the rate has been below `low_rate` rad/s for `low_for` s.
    """

    settle: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.05
    measure: Annotated[float, Meta(ge=0.02, le=1.0)] = 0.05
    act: Annotated[float, Meta(ge=0.02, le=5.0)] = 0.15
    low_rate: Positive = 0.02
    low_for: Positive = 2.0


class Health(Section, frozen=True, kw_only=True):
    """Limits of the board's resources (`flight.loop.health`), checked every `look_period` s.

    `cpu_share` is relative to one core. `memory` and `disk_free` are in bytes. `memory_slope` is in bytes per
    hour over at least `slope_window` s, from `warm_up` s on. Temperatures are in degree C: `temperature`
    causes a warning, `hottest` is too hot.
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


class CommandStep(Aim, frozen=True, kw_only=True):
    """One command of a time line, sent at `at` s of mission time.

    The command is a mode, a slew to q2, a goal to point to with its values, or an event to clear.
    """

    at: NotNegative
    mode: CommandedMode | None = None
    slew: Q2 | None = None
    point: GoalName | None = None
    clear: Annotated[str, Meta(min_length=1, max_length=32)] | None = None


class Commands(Section, frozen=True, kw_only=True):
    """Sources of commands: a UNIX datagram socket, UDP on a bench, and a time line.

    `udp` (HOST:PORT) must be a loopback address; other machines send commands through the `link`, with keys.
    """

    socket: Annotated[str, Meta(min_length=1, max_length=100)] | None = None
    udp: HostPort | None = None
    timeline: tuple[CommandStep, ...] = ()


class LinkSerial(Section, frozen=True, kw_only=True):
    """A serial line to a radio: device file and bits per second."""

    device: Annotated[str, Meta(pattern=r"^/[A-Za-z0-9_./:+-]+$", description="a device file")]
    baud: Annotated[int, Meta(ge=1200, le=4_000_000)] = 115200


class Link(Section, frozen=True, kw_only=True):
    """The link process (`python -m flight link`), which exchanges protected frames with the ground.

    `keys` is the folder of keys and counters (`python -m ground keys`), `spacecraft` the identifier in each
    frame. `udp` and `tcp` listen at HOST:PORT and accept frames from `peers` only. Without `peers`, a
    loopback address accepts this machine, any other address its network of 256 addresses. `serial` is the
    line of a radio. Telemetry goes to authenticated senders, to `telemetry_to` (HOST:PORT, UDP), to all
    clients of `tcp` and to `serial`, in frames of `frame_bytes` bytes and at most `rate` bytes/s per line.
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
    """Largest sizes of a log segment, of all segments of a log, and of all runs of an archive."""

    segment_bytes: Annotated[int, Meta(ge=4096)] = 16 * 1024 * 1024
    budget_bytes: Annotated[int, Meta(ge=16384)] = 1024 * 1024 * 1024
    archive_bytes: Annotated[int, Meta(ge=32768)] = 8 * 1024 * 1024 * 1024


class State(Section, frozen=True, kw_only=True):
    """Storage of the state that outlives the process (`flight.loop.state`), written every `period` s.

    Without a `folder`, a flight of real devices uses systemd's STATE_DIRECTORY and any other stores nothing.
    """

    folder: Annotated[str, Meta(min_length=1)] | None = None
    period: Annotated[float, Meta(ge=1.0, le=3600.0)] = 10.0


class Config(Section, frozen=True, kw_only=True):
    """The sections of every body's configuration; the configuration of a body adds its own.

    `body` names the body; a body outside this repository is named as `module:object`.
    """

    name: Annotated[str, Meta(min_length=1, max_length=64)]
    body: Annotated[str, Meta(min_length=1, max_length=200)] = "testbed"
    inertial_unit: InertialUnitSection
    coils: Coils
    power_monitor: PowerMonitorSection | None = None
    camera: Camera | None
    gps: Gps | None = None
    solar_strings: SolarStringsSection | None = None
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
        """Return the smallest and the largest magnitude of a valid magnetometer reading, T."""
        return 0.0, self.inertial_unit.field_range

    def replan_period(self) -> float | None:
        """Return the period of planning from the newest estimate, s; None for a body that plans nothing."""
        return None

    def hardware(self) -> tuple[Section, ...]:
        """Return the sections of the hardware to which learned parameters apply."""
        return (self.coils, self.inertial_unit)

    def shortened(self, duration: float) -> Self:
        """Return the configuration of a flight of `duration` s."""
        return msgspec.structs.replace(self, duration=duration)
