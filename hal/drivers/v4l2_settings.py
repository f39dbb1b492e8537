"""What a configuration states about a camera of Video for Linux."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np

PIXEL_KINDS: dict[str, np.dtype[Any]] = {
    "GREY": np.dtype("u1"),
    "Y10": np.dtype("<u2"),
    "Y12": np.dtype("<u2"),
    "Y16": np.dtype("<u2"),
}
"""V4L2's grey pixel formats, "Luma-Only Formats": those of 10 and 12 bits use the low bits of 16."""


class Stamp(Enum):
    """The instant of the kernel's stamp: as the driver flags it, or start or end of exposure regardless."""

    TOLD = "told"
    START = "start"
    END = "end"


@dataclass(frozen=True, slots=True)
class V4l2Settings:
    """Settings of a V4L2 camera.

    Attributes:
        path: of its device, such as /dev/knightcube-camera.
        columns, rows: of the image.
        pixel_format: a key of PIXEL_KINDS.
        exposure_ns: the usual exposure; the interval between frames is set to it.
        gain: in the camera's own steps, None to leave it unchanged.
        stamp: the instant of the stamps.
        stamp_delay_ns: from that instant to the stamp.
        settling: frames that may still have the old exposure after it was changed.
        buffers: how many frames the kernel may hold.
    """

    path: str
    columns: int
    rows: int
    pixel_format: str
    exposure_ns: int
    gain: int | None
    stamp: Stamp
    stamp_delay_ns: int
    settling: int = 2
    buffers: int = 4

    @property
    def kind(self) -> np.dtype[Any]:
        """The type of a pixel."""
        return PIXEL_KINDS[self.pixel_format]
