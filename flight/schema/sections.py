"""The configuration sections that all bodies share, with the bounds of each value.

A configuration contains the assumptions of the flight application and the wiring of its devices. The
simulated world is described by the section `simulation`, whose type is defined in `sim_hal.settings`. Values
are in SI units, unless their name contains another unit.
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
    MagnetometerSection,
    Power,
    PowerMonitorSection,
    SolarStringsSection,
    WideCamera,
)
from flight.schema.document import (
    Q2,
    Aim,
    CallSign,
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
    """Time limits (s) for the jobs of the workers."""

    planner_timeout: Positive = 2.0
    vision_timeout: Positive = 10.0


class Estimation(Section, frozen=True, kw_only=True):
    """The multiplicative Kalman filter of attitude, rate, gyro bias and disturbance.

    The initial standard deviations are `bias_start` (gyro bias, rad/s), `gain_start` (coil gains) and
    `latency_start` (age of an inertial unit's sample at its time stamp, s). A state whose initial standard
    deviation is zero stays fixed. The latency has the random walk `latency_walk`, s per sqrt(s). While there
    are no measurements, the estimate is propagated by the model for `coast` s, but the coils are off
    (`inertial_unit.max_age`). From one boot to the next, a learned value may change by the fraction `changed`
    of its initial standard deviation.
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
    """The initial mode, and the conditions of mode changes (`flight.loop.modes`).

    After `crash_limit` recent unclean shutdowns, the flight starts in the mode safe instead of `initial`. A
    slew has arrived when its error stays within `arrived_angle` rad and `arrived_rate` rad/s for
    `arrived_for` s, and is late after `slew_limit` s. Holding fails when the error exceeds `hold_error` rad
    for `hold_patience` s. In the demonstration, the error is checked only after the end of the first path to
    a target. A body faster than `tumble_rate` rad/s is too fast to hold an attitude or to slew. After
    `blind_limit` s without an estimate, the mode changes to safe. A body that acquires its attitude changes
    to the mode `acquired` when the attitude has been known for `known_for` s, and returns to acquisition when
    the attitude has been unknown for `lost_for` s.
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
    """Detumbling with the magnetometer, which is read while the coils are off.

    In each cycle, the coils are off for `settle` s until their field has decayed, the field is averaged for
    `measure` s, and the coils act for `act` s. Detumbling ends when the rate has been below `low_rate` rad/s
    for `low_for` s.
    """

    settle: Annotated[float, Meta(ge=0.0, le=1.0, description="s")] = 0.05
    measure: Annotated[float, Meta(ge=0.02, le=1.0, description="s")] = 0.05
    act: Annotated[float, Meta(ge=0.02, le=5.0, description="s")] = 0.15
    low_rate: Positive = 0.02
    low_for: Positive = 2.0


class Health(Section, frozen=True, kw_only=True):
    """Limits of the flight computer's resources (`flight.loop.health`), checked every `look_period` s.

    The processor load `cpu_share` is relative to one core. The limits `memory` and `disk_free` are in bytes.
    The growth limit `memory_slope`, in bytes per hour, applies after `warm_up` s and over at least
    `slope_window` s. Temperatures are in degrees Celsius: exceeding `temperature` causes a warning, exceeding
    `hottest` a reaction.
    """

    look_period: Annotated[float, Meta(ge=0.5, le=600.0, description="s")] = 5.0
    warm_up: NotNegative = 120.0
    slope_window: Positive = 1200.0
    cpu_share: Positive = 0.7
    memory: Positive = 1.0e9
    memory_slope: Positive = 1.0e7
    disk_free: Positive = 2.0e8
    temperature: float = 80.0
    hottest: float = 95.0


class CommandStep(Aim, frozen=True, kw_only=True):
    """A command of the time line, executed at mission time `at` (s).

    The command is one of: a mode, a slew to a quaternion component q2, a pointing goal with its values, or
    the clearing of an event.
    """

    at: Annotated[NotNegative, Meta(description="mission time, s")]
    mode: CommandedMode | None = None
    slew: Q2 | None = None
    point: GoalName | None = None
    clear: Annotated[str, Meta(min_length=1, max_length=32)] | None = None


class Commands(Section, frozen=True, kw_only=True):
    """Sources of commands: a UNIX datagram socket, UDP on a test bench, and a time line.

    The address `udp` (HOST:PORT) must be a loopback address; other machines send protected commands through
    the `link`.
    """

    socket: Annotated[str, Meta(min_length=1, max_length=100)] | None = None
    udp: HostPort | None = None
    timeline: tuple[CommandStep, ...] = ()


class LinkSerial(Section, frozen=True, kw_only=True):
    """A serial line to a radio: its device file and bit rate (bit/s), with KISS framing if `kiss` is true."""

    device: Annotated[str, Meta(pattern=r"^/[A-Za-z0-9_./:+-]+$", description="a device file")]
    baud: Annotated[int, Meta(ge=1200, le=4_000_000, description="baud")] = 115200
    kiss: bool = False


class LinkCoding(Section, frozen=True, kw_only=True):
    """Channel coding for a radio that has no coding modem (`flight.link.coding`).

    Satellite and ground station must have equal settings.

    Telemetry is randomised by the `short` or `long` sequence of CCSDS 131.0-B, and protected by the
    Reed-Solomon code (255,223) with interleaving depth `reed_solomon`. Telecommands are sent in CLTUs of
    CCSDS 231.0-B, `plain` or `randomised`.
    """

    randomiser: Literal["short", "long"] | None = None
    reed_solomon: Annotated[int, Meta(ge=1, le=5)] | None = None
    cltu: Literal["plain", "randomised"] | None = None


class Link(Section, frozen=True, kw_only=True):
    """The link process (`knightcube link`), which exchanges protected frames with the ground.

    The folder `keys` contains keys and counters (`knightcube keys`), and `spacecraft` is the identifier in
    each frame. The addresses `udp` and `tcp` (HOST:PORT) accept frames only from the networks `peers`. By
    default, a loopback address accepts frames only from this machine, and any other address accepts frames
    only from its own /24 network (256 addresses). The value `serial` describes the serial line of a radio.
    Telemetry is sent to authenticated senders, to `telemetry_to` (HOST:PORT, UDP), to `serial` and to the TNC
    at `kiss` (HOST:PORT, TCP). With the two `call_signs` (to, from), KISS frames contain AX.25 frames.
    Telemetry frames have `frame_bytes` bytes, and telecommand frames have at most `command_frame_bytes`
    bytes. Each communication line carries at most `rate` bytes/s of telemetry frames. Idle frames raise the
    rate to `idle_rate` bytes/s. Telemetry is always authenticated, and readable without a key if
    `encrypt_telemetry` is false. The section `coding` describes the channel coding. A flight computer returns
    to its previous release if it has power and receives no authentic frame for `command_loss` s. If another
    `command_loss` s pass without a frame, the computer returns to its previous configuration, and after a
    third such period to the configuration accepted on the ground. A `command_loss` of 0 disables these
    returns.
    """

    keys: Annotated[
        str, Meta(min_length=1), Meta(description="folder of the keys of this end, made by `knightcube keys`")
    ]
    spacecraft: Annotated[int, Meta(ge=0, le=1023)] = 0x1A5
    udp: HostPort | None = None
    telemetry_to: HostPort | None = None
    tcp: HostPort | None = None
    serial: LinkSerial | None = None
    peers: Annotated[tuple[Peer, ...], Meta(min_length=1)] | None = None
    kiss: HostPort | None = None
    call_signs: tuple[CallSign, CallSign] | None = None
    frame_bytes: Annotated[int, Meta(ge=128, le=2048, description="bytes")] = 1115
    command_frame_bytes: Annotated[int, Meta(ge=128, le=1024, description="bytes")] = 1024
    rate: Annotated[float, Meta(ge=100.0, le=1.0e7, description="bytes/s")] = 50_000.0
    command_loss: Annotated[float, Meta(ge=0.0, le=3.2e7, description="s")] = 0.0
    idle_rate: Annotated[float, Meta(ge=0.0, le=1.0e7, description="bytes/s")] = 0.0
    encrypt_telemetry: bool = True
    coding: LinkCoding = LinkCoding()


class Telemetry(Section, frozen=True, kw_only=True):
    """Maximum sizes (bytes) of a log segment, of all segments of a log, and of all runs in an archive."""

    segment_bytes: Annotated[int, Meta(ge=4096, description="bytes")] = 16 * 1024 * 1024
    budget_bytes: Annotated[int, Meta(ge=16384, description="bytes")] = 1024 * 1024 * 1024
    archive_bytes: Annotated[int, Meta(ge=32768, description="bytes")] = 8 * 1024 * 1024 * 1024


class State(Section, frozen=True, kw_only=True):
    """Storage of the state that survives a restart (`flight.loop.state`), written every `period` s.

    By default, a flight with real devices stores the state in systemd's STATE_DIRECTORY, and any other flight
    stores nothing.
    """

    folder: Annotated[str, Meta(min_length=1)] | None = None
    period: Annotated[float, Meta(ge=1.0, le=3600.0, description="s")] = 10.0


class Separation(Section, frozen=True, kw_only=True):
    """Coils and transmitter stay off until the satellite has had power for `inhibit` s."""

    inhibit: Annotated[float, Meta(ge=0.0, le=86_400.0, description="s")] = 0.0


class Config(Section, frozen=True, kw_only=True):
    """The configuration sections that all bodies share; the configuration of a body adds more sections.

    The value `body` names the body; a body outside this repository is named as `module:object`. If
    `inertial_unit` is none, the `magnetometer` becomes an inertial unit without a gyro.
    """

    name: Annotated[
        str,
        Meta(
            pattern=r"^[^\x00-\x1f\x7f-\x9f]+$", max_length=64, description="a name of printable characters"
        ),
    ]
    body: Annotated[str, Meta(min_length=1, max_length=200)] = "testbed"
    inertial_unit: InertialUnitSection
    magnetometer: MagnetometerSection | None = None
    coils: Coils
    power_monitor: PowerMonitorSection | None = None
    power: Power | None = None
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
    duration: Annotated[Positive, Meta(description="duration of the flight, s")]
    telemetry: Telemetry = Telemetry()
    state: State = State()
    separation: Separation = Separation()
    simulation: dict[str, Any] | None = None

    def field_range(self) -> tuple[float, float]:
        """Return the minimum and the maximum strength (T) of a valid magnetometer reading."""
        return 0.0, self.inertial_unit.field_range

    def replan_period(self) -> float | None:
        """Return the planning period (s), or None for a body without periodic plans."""
        return None

    def hardware(self) -> tuple[Section, ...]:
        """Return the hardware sections on which the validity of learned parameters depends."""
        spare = () if self.magnetometer is None else (self.magnetometer,)
        return (self.coils, self.inertial_unit, *spare)

    def shortened(self, duration: float) -> Self:
        """Return the configuration with another flight duration, s."""
        return msgspec.structs.replace(self, duration=duration)
