"""When to ask again while the other end is silent: soon at first, then seldom, for it may be away."""

from __future__ import annotations

_SOON = 4
_LONGEST_NS = 60_000_000_000


class Timer:
    """Due after each silence of a period, which doubles after a few.

    Attributes:
        times: how often was asked since the other end was heard.
    """

    def __init__(self, period_ns: int, now_ns: int) -> None:
        self._period_ns = period_ns
        self._since_ns = now_ns
        self.times = 0

    def due(self, now_ns: int) -> bool:
        """Return whether it is time to ask again."""
        longer = self._period_ns << max(0, min(self.times - _SOON + 1, 16))
        return now_ns - self._since_ns >= min(max(self._period_ns, _LONGEST_NS), longer)

    def asked(self, now_ns: int) -> None:
        """Begin another silence."""
        self._since_ns = now_ns
        self.times += 1

    def heard(self, now_ns: int) -> None:
        """Take note that the other end is there."""
        self._since_ns = now_ns
        self.times = 0
