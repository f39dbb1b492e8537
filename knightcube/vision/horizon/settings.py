"""Settings of the search for the horizon."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from knightcube.errors import UsageError
from knightcube.vision.horizon.knowledge import LEAST_ALTITUDE
from knightcube.vision.horizon.response import LogarithmicResponse


@dataclass(frozen=True, slots=True, kw_only=True)
class EdgeSettings:
    """How edges are found along scan lines.

    Attributes:
        lines: number of columns, and of rows, that are read.
        more_lines: the same for a second look.
        run: px, odd: shorter fluctuations are filtered out (Meller 3.1).
        threshold: of bright pixels, as a share of the way from the low to the high average.
        contrast: of the weakest edge, as a share of the same way.
        most: edges kept for each of `lines`, those with the darkest dark side.
        psf_sigma: px, the blur of the optics.
        response: the detector's, if it is not linear.
    """

    lines: int = 32
    more_lines: int = 96
    run: int = 5
    threshold: float = 0.3
    contrast: float = 0.15
    most: int = 5
    psf_sigma: float = 0.6
    response: LogarithmicResponse | None = None

    def __post_init__(self) -> None:
        if self.lines < 2:
            raise UsageError(f"lines {self.lines}: at least 2 columns and rows are read")
        if self.run < 1 or self.run % 2 == 0:
            raise UsageError(f"run {self.run}: must be an odd number of pixels")
        for name in ("threshold", "contrast"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise UsageError(f"{name} {getattr(self, name)}: must lie between 0 and 1")


@dataclass(frozen=True, slots=True, kw_only=True)
class HorizonSettings:
    """How the horizon is chosen among edges, and its assumed errors.

    Attributes:
        edges: see `EdgeSettings`.
        limb_height_sigma: m, of the apparent limb's height: the default is for air of unknown scale height
            (6.5 to 9.5 km) and haze (a third more or less), 1,000 for known air.
        altitude_sigma: m, of a given position.
        altitudes: m, least and greatest of an unknown altitude. A disc of any size is the limb of some
            altitude: the default, of low orbits, refuses logos and ghosts of a lens.
        tolerance: px, within which edges agree with a circular cone; the Earth's flattening fits into it.
        least_edges: of a horizon.
        enough_edges: a horizon of fewer edges is searched again on more lines.
        some_edges: a picture of fewer edges is not searched again.
        candidates: number of horizons searched for in one picture.
        tries: pairs or triples of edges tried for each.
        sphere_sigma: rad an axis, added where the flattening's direction is unknown.
    """

    edges: EdgeSettings = field(default_factory=EdgeSettings)
    limb_height_sigma: float = 3000.0
    altitude_sigma: float = 50.0
    altitudes: tuple[float, float] = (100e3, 2_000e3)
    tolerance: float = 2.0
    least_edges: int = 8
    enough_edges: int = 20
    some_edges: int = 4
    candidates: int = 4
    tries: int = 400
    sphere_sigma: float = math.radians(0.1)

    def __post_init__(self) -> None:
        low, high = self.altitudes
        if not LEAST_ALTITUDE <= low < high < math.inf:
            raise UsageError(
                f"altitudes of {1e-3 * low:g} to {1e-3 * high:g} km: the limb is seen as one from"
                f" {1e-3 * LEAST_ALTITUDE:g} km up, and the least comes first"
            )
