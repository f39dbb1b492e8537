"""The sections of the devices that a satellite has beside the testbed's: receiver, strings, wide cameras."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from flight.schema.devices import AravisDevice, CameraLens, V4l2Device
from flight.schema.values import Address, NotNegative, Positive, Quaternion, Section

Normal = tuple[float, float, float]


class Gps(Section, frozen=True, kw_only=True):
    """The u-blox receiver on a serial line of its own: a fix every `period` s, lost after `max_age` s."""

    device: Annotated[str, Meta(min_length=1)] = "/dev/knightcube-gps"
    baud_rate: Literal[9600, 19200, 38400, 57600, 115200, 230400, 460800, 921600] = 115200
    period: Annotated[float, Meta(ge=0.1, le=60.0)] = 1.0
    max_age: Positive = 60.0


class SolarString(Section, frozen=True, kw_only=True):
    """A string of solar cells and the input that measures its current.

    `normal` is its outward unit vector in body axes, `peak` A its current with the Sun straight upon it,
    `volt_per_ampere` that of its amplifier at `channel` of the ADS1115 at `address`.
    """

    normal: Normal
    address: Address = 0x48
    channel: Annotated[int, Meta(ge=0, le=3)]
    peak: Positive = 0.5
    volt_per_ampere: Positive = 2.0


class SolarStrings(Section, frozen=True, kw_only=True):
    """The solar strings, measured every `period` s; `max_age` s is how old a reading may be."""

    strings: Annotated[tuple[SolarString, ...], Meta(min_length=4, max_length=16)]
    period: Annotated[float, Meta(ge=0.04, le=60.0)] = 0.5
    max_age: Positive = 2.0


class WideCamera(Section, frozen=True, kw_only=True):
    """A wide camera for Sun and horizon.

    `response` is logarithmic over `decades` of light from `pedestal` counts on, or linear; all
    cameras respond alike. With 384 x 384 pixels over 67 deg a frame is
    simulated in 30 to 46 ms and the Sun is found as with 512 x 512, which take 52 to 72; with 256 x 256 it
    is missed in one of three. All are triggered together, as often as the shortest `period`, and
    `fine_period` while the attitude is known to 0.05 deg. `lens_error_deg` is what calibration leaves of lens
    and mounting.
    """

    device: V4l2Device | AravisDevice | None = None
    columns: Annotated[int, Meta(ge=64, le=2048)] = 384
    rows: Annotated[int, Meta(ge=64, le=2048)] = 384
    field_of_view_deg: Annotated[float, Meta(gt=10.0, lt=150.0)] = 67.0
    lens: CameraLens | None = None
    response: Literal["logarithmic", "linear"] = "logarithmic"
    decades: Annotated[float, Meta(ge=1.0, le=12.0)] = 6.0
    bits: Annotated[int, Meta(ge=8, le=16)] = 8
    pedestal: Annotated[float, Meta(ge=0.0, le=200.0)] = 8.0
    exposure: Annotated[float, Meta(gt=0.0, le=1.0)] = 0.005
    period: Annotated[float, Meta(ge=2.0)] = 5.0
    fine_period: Annotated[float, Meta(ge=2.0)] = 60.0
    max_age: Positive = 30.0
    lens_error_deg: NotNegative = 0.02
    mounting: Quaternion = (0.0, 0.0, 0.0, 1.0)

    def counts_per_decade(self) -> float:
        """Return how many counts ten times the light adds with a logarithmic response."""
        return float((1 << self.bits) - 1 - self.pedestal) / self.decades
