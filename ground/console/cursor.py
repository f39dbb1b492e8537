"""The time that one reader of the page looks at: the newest, or a moment of the past that may move on."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass

FASTEST = 1000.0


@dataclass(slots=True)
class Cursor:
    """Follows the newest packet until told another time.

    Attributes:
        live: whether the newest packet is shown.
        speed: s of mission time in a second of the reader's; 0 while paused.
    """

    live: bool = True
    speed: float = 1.0
    _time: float = 0.0
    _since: float = 0.0

    def obey(self, text: str, now: float) -> bool:
        """Take a message {"live": true} or {"at": s, "speed": x}; return whether the time jumped.

        `now` is the reader's clock, s. A message that says neither changes nothing.
        """
        try:
            said = json.loads(text)
            if said.get("live"):
                jumped = not self.live
                self.live, self.speed = True, 1.0
                return jumped
            at, speed = float(said["at"]), float(said["speed"])
        except (ValueError, KeyError, TypeError, AttributeError):
            return False
        if not (math.isfinite(at) and 0.0 <= speed <= FASTEST):
            return False
        self.live, self.speed, self._time, self._since = False, speed, at, now
        return True

    def at_ns(self, span_ns: tuple[int, int], now: float) -> int:
        """Return the time to show, ns, within what has come; a replay that reaches the end stays there."""
        if self.live:
            return span_ns[1]
        moved = self._time + self.speed * (now - self._since)
        return min(max(round(moved * 1e9), span_ns[0]), span_ns[1])
