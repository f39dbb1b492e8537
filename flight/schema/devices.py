"""The devices' sections of a configuration: how they are wired, and what the flight believes of them."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from flight.schema.values import (
    Address,
    Bus,
    Channel,
    Estimator,
    NotNegative,
    Positive,
    Quaternion,
    Section,
    Sign,
)
from knightcube.vision.camera.lens import CameraKnowledge


class InertialUnit(Section, frozen=True, kw_only=True):
    """The VN-100 and its line.

    No coil is driven by a reading that would be older than `max_age` s before the next one is used.
    """

    device: str = "/dev/knightcube-imu"
    baud_rate: Literal[9600, 19200, 38400, 57600, 115200, 230400, 460800, 921600] = 115200
    output: Literal["binary", "ascii"] = "binary"
    rate_hz: Literal[1, 2, 4, 5, 10, 20, 25, 40, 50, 100, 200] = 40
    mounting: Quaternion = (0.0, 0.0, 0.0, 1.0)
    field_range: Positive = 6.0e-4
    max_age: Positive = 0.1
    angle_noise: Positive = 2.02e-3
    rate_noise: Positive = 1.01e-4


class Coils(Section, frozen=True, kw_only=True):
    """The PWM chip, the H-bridges and the coils behind them; `bus` is its number or its device file."""

    bus: Bus = 1
    address: Address = 0x40
    channels: tuple[tuple[Channel, Channel], tuple[Channel, Channel], tuple[Channel, Channel]] = (
        (0, 1),
        (2, 3),
        (4, 5),
    )
    enable_channels: tuple[Channel, Channel, Channel] | None = None
    signs: tuple[Sign, Sign, Sign] = (1, 1, 1)
    resistance: tuple[Positive, Positive, Positive]
    supply_voltage: Positive
    current_limit: Positive
    stale_after: Annotated[float, Meta(gt=0.0, le=0.4)] = 0.25


class PowerMonitor(Section, frozen=True, kw_only=True):
    """The INA219 in the coils' supply."""

    address: Address = 0x45
    shunt: Positive = 0.1


class CameraLens(Section, frozen=True, kw_only=True):
    """What `python -m flight calibrate` found: px, the pixel (x, y) on the axis, and radial distortion."""

    focal_length: Positive
    centre: tuple[float, float]
    k1: float = 0.0
    k2: float = 0.0


_KNOWN = CameraKnowledge()


class CameraAccuracy(Section, frozen=True, kw_only=True):
    """How well the camera is known, standard deviations: what streaks may claim of a rate depends on it.

    `focal_length` as a share of itself, `centre` of the axis along x and y in px, `distortion` as the share
    of its radius by which a corner may be displaced, `line_time` in s. Zero is exact, as an
    emulated camera; without a `line_time` that of the camera is exact where it is stated.
    """

    focal_length: NotNegative = _KNOWN.focal_length
    centre: NotNegative = _KNOWN.centre
    distortion: NotNegative = _KNOWN.distortion
    line_time: NotNegative | None = _KNOWN.line_time


class StarTracker(Section, frozen=True, kw_only=True):
    """The star tracker: its sky index (default: the one in the cache folder), and its trust in the lens.

    `scale_error` is the part by which the focal length may be wrong; 0 for a calibrated camera. `velocity`,
    m/s with respect to the Sun in the axes of the attitude, is that of stellar aberration; none on a testbed.
    """

    index: str | None = None
    scale_error: Annotated[float, Meta(ge=0.0, lt=0.5)] = 0.0
    velocity: tuple[float, float, float] | None = None


class ObjectTracking(Section, frozen=True, kw_only=True):
    """Search for objects among the stars of each frame, and their tracks.

    Nothing fainter than `faintest` (V) is one. A track begins after `needed` sightings in `within` frames and
    ends after `coast` s without one.
    """

    faintest: Annotated[float, Meta(ge=-5.0, le=8.0)] = 7.0
    needed: Annotated[int, Meta(ge=3, le=16)] = 4
    within: Annotated[int, Meta(ge=3, le=32)] = 6
    coast: Positive = 15.0


class V4l2Device(Section, frozen=True, kw_only=True, tag_field="kind", tag="v4l2"):
    """A camera of Video for Linux (`hal.drivers.v4l2_camera`); gain in its own steps, `stamp_delay` in s."""

    path: Annotated[str, Meta(min_length=1)] = "/dev/knightcube-camera"
    pixel_format: Literal["GREY", "Y10", "Y12", "Y16"] = "GREY"
    gain: int | None = None
    stamp: Literal["told", "start", "end"] = "told"
    stamp_delay: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0


class AravisDevice(Section, frozen=True, kw_only=True, tag_field="kind", tag="aravis"):
    """A GenICam camera by the name that `arv-tool-0.8` lists (`hal.drivers.aravis_camera`)."""

    name: Annotated[str, Meta(min_length=1)]
    pixel_format: Literal["Mono8", "Mono10", "Mono12", "Mono16"] = "Mono12"
    gain: float | None = None


ExposureTime = Annotated[float, Meta(gt=0.0, le=10.0)]
"""s."""


class Camera(Section, frozen=True, kw_only=True):
    """The star camera: what flight must know to read its frames; `device` is the real one.

    A frame is late `late_after` s after the exposure that it may have waited for; vision is slow after
    `vision_slow_after` s. Beyond `max_rate` rad/s of the body, where it is given, no exposure is begun. While
    the attitude is fine a frame is taken every `fine_period` s, without it every `period`, too. The newest
    `keep_frames` frames are kept in `frames` of the run's folder. Stars that streak are exposed for a time
    within `streak_exposure` s that follows the rate; without it for `exposure` s as points are.
    """

    device: V4l2Device | AravisDevice | None = None

    columns: Annotated[int, Meta(ge=64, le=8192)] = 1024
    rows: Annotated[int, Meta(ge=64, le=8192)] = 1024
    field_of_view_deg: Annotated[float, Meta(gt=1.0, lt=120.0)] = 20.0
    lens: CameraLens | None = None
    accuracy: CameraAccuracy = CameraAccuracy()
    exposure: ExposureTime = 1.0
    streak_exposure: tuple[ExposureTime, ExposureTime] | None = None
    period: Positive = 5.0
    fine_period: Positive | None = None
    bits: Annotated[int, Meta(ge=8, le=16)] = 16
    gain: Positive = 1.0
    read_noise: Positive = 10.0
    saturation: Positive | None = None
    psf_sigma: Positive = 1.0
    line_time: NotNegative | None = None
    estimator: Estimator = "likelihood"
    star_tracker: StarTracker | None = None
    objects: ObjectTracking | None = None
    endpoint_bias: float | None = None
    mounting: Quaternion = (0.0, 0.0, 0.0, 1.0)
    max_rate: Positive | None = None
    max_age: Positive = 12.0
    late_after: Positive = 1.0
    vision_slow_after: Positive = 1.0
    keep_frames: Annotated[int, Meta(ge=0, le=1000)] = 0
