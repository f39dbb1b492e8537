"""How much work a frame may take: counted in pixels, not in time, so results depend on no machine."""

from __future__ import annotations

# Beyond this no rival motion is begun. A fit in hand is finished: the whole frame may take twice as much.
_MOST = 1_600_000
# What an evaluation of the model costs whatever its pixels, and a pass over the frame, a part of its pixels.
_EVALUATION = 15_000
_PASS = 0.15


class Work:
    """The work that was done on one frame."""

    def __init__(self) -> None:
        self._spent = 0.0

    def evaluated(self, pixels: int) -> None:
        """Count an evaluation of the model on `pixels`."""
        self._spent += pixels + _EVALUATION

    def passed(self, pixels: int) -> None:
        """Count a pass over a frame of `pixels`."""
        self._spent += _PASS * pixels

    @property
    def exhausted(self) -> bool:
        """Whether nothing more may be begun."""
        return self._spent > _MOST
