"""When a row of the detector is exposed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True, slots=True)
class Shutter:
    """Row r is exposed from `(r - middle) delay_per_row` - 1/2 on, for one exposure; global when that is 0.

    Attributes:
        delay_per_row: exposures from one row's start to the next's.
        middle: row whose mid-exposure is the frame's.
    """

    delay_per_row: float = 0.0
    middle: float = 0.0

    def delay(self, rows: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.floating[Any]]:
        """Return how much later than the middle row `rows` are exposed, exposures."""
        # Scalars of the rows' own type, so that float32 stays float32.
        return np.asarray((rows - rows.dtype.type(self.middle)) * rows.dtype.type(self.delay_per_row))
