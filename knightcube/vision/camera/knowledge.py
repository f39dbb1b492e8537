"""How well a camera is known."""

from __future__ import annotations

from dataclasses import dataclass

UNSTATED = 30e-6
"""s from row to row, by which a shutter may roll that nobody described: 1,000 rows in 30 ms, as many do."""


@dataclass(frozen=True, slots=True)
class CameraKnowledge:
    """By how much a camera may differ from its description: standard deviations, 0 where it is exact.

    The defaults are those of a camera that nobody calibrated, its field of view believed.

    Attributes:
        focal_length: share of itself.
        centre: px, of the optical axis along x and along y.
        distortion: share of its radius by which a corner may be displaced.
        line_time: s from one row's exposure to the next's; None: exact where it is stated, else `UNSTATED`.
    """

    focal_length: float = 0.0
    centre: float = 2.0
    distortion: float = 0.005
    line_time: float | None = None


EXACT = CameraKnowledge(centre=0.0, distortion=0.0, line_time=0.0)
"""A camera that is as it is described, as an emulated one."""
