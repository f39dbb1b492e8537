"""The pixels that are fitted: strips about long streaks, patches about spots."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flight.arrays import IntArray
from flight.pinhole import Pinhole
from flight.vision.likelihood.scene import Scene, path_lengths, window_times
from flight.vision.likelihood.shutter import Shutter
from flight.vision.likelihood.spot_model import Patches, cut_patches
from flight.vision.likelihood.strips import Strips, cut_strips

# Paths shorter than this many widths are summed instant by instant.
_SPOT_WIDTHS = 8.0


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """The pixels that are fitted: strips about long streaks, patches about spots.

    Attributes:
        long, spot: stars (a,), (b,) of each kind, indices into the scene.
        strips, patches: their pixels; star i of the strips is `long[i]`.
    """

    long: IntArray
    spot: IntArray
    strips: Strips
    patches: Patches


def cut_windows(pinhole: Pinhole, shutter: Shutter, scene: Scene, reach: float) -> Windows:
    """Return the pixels within `reach` widths of the stars' paths."""
    length = path_lengths(pinhole, scene.motion, scene.stars)
    limit = _SPOT_WIDTHS * scene.width
    long, spot = np.flatnonzero(length >= limit), np.flatnonzero(length < limit)
    room = reach * scene.width
    times = window_times(pinhole, scene.motion, shutter, scene.stars[long])
    strips = cut_strips(pinhole, scene.motion, scene.stars[long], times, room)
    longest = float(length[spot].max(initial=0.0))
    patches = cut_patches(pinhole, scene.stars[spot], int(np.ceil(room + 0.5 * longest)))
    return Windows(long, spot, strips, patches)
