"""What flight process and guardian say to each other: single bytes on a socket pair."""

BEAT = b"."
"""Flight: a control cycle ran well."""

BYE = b"q"
"""Flight: the coils are off and the flight is over."""

READY = b"r"
"""Guardian: the bus is open and the coils have been told zero."""

ACTED = b"z"
"""Guardian: the heart fell silent, the coils are at zero."""

FAILED = b"x"
"""Guardian: the coils could not be told zero; it goes on trying."""
