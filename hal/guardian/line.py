"""The messages between flight process and guardian: single bytes on a socket pair."""

BEAT = b"."
"""Flight: a control cycle succeeded."""

BYE = b"q"
"""Flight: the coils are off and the flight is over."""

READY = b"r"
"""Guardian: the bus is open and the coils are zeroed."""

ACTED = b"z"
"""Guardian: the heartbeat stopped, the coils are zeroed."""

FAILED = b"x"
"""Guardian: the coils could not be zeroed; it keeps trying."""
