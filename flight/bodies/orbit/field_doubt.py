"""Whether the magnetometer is believed: not while it repeats its value or contradicts the estimate."""

from __future__ import annotations

from knightcube.astro.arrays import FloatArray

STUCK, CONTRADICTED = 20, 4
"""Readings in a row with the same field, whose noise never repeats; fields that contradict the estimate."""


class FieldDoubt:
    """Counts readings with the same field."""

    def __init__(self) -> None:
        self._last: list[float] = []
        self._same = 0

    @property
    def stuck(self) -> bool:
        """Whether the field has been the same for `STUCK` readings."""
        return self._same >= STUCK

    def sees(self, field: FloatArray) -> bool:
        """Take the field (3,) of a reading; return whether it may be used: it is not stuck."""
        values = field.tolist()
        self._same, self._last = (self._same + 1 if values == self._last else 0), values
        return not self.stuck

    def text(self, refused: int) -> str:
        """Return why the magnetometer is not believed, empty while it is; `refused` fields in a row were."""
        if self.stuck:
            return "the magnetometer gives the same field in every reading"
        return f"{refused} fields in a row contradict the estimate" if refused >= CONTRADICTED else ""
