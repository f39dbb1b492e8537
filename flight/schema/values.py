"""The values that sections of a configuration are made of, with their bounds."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from knightcube.gnc.guidance.one_axis.plant import Q2_LIMIT

Positive = Annotated[float, Meta(gt=0.0)]
NotNegative = Annotated[float, Meta(ge=0.0)]
Q2 = Annotated[float, Meta(ge=-Q2_LIMIT, le=Q2_LIMIT)]
Address = Annotated[int, Meta(ge=0x08, le=0x77)]
Bus = (
    Annotated[int, Meta(ge=0, le=0xFFFFF)]
    | Annotated[
        str, Meta(pattern=r"^/[A-Za-z0-9_./:+-]+$", description="the number of a bus, or its device file")
    ]
)
Peer = Annotated[
    str,
    Meta(
        pattern=r"^[0-9]{1,3}(\.[0-9]{1,3}){3}(/[0-9]{1,2})?$",
        description="an IPv4 address or subnet, such as 192.168.7.0/24",
    ),
]
HostPort = Annotated[
    str,
    Meta(
        # Ports above 65535 are none, and waiting would not make them so.
        pattern=r"^[^:\s]+:([0-5]?[0-9]{1,4}|6[0-4][0-9]{3}|65[0-4][0-9]{2}|655[0-2][0-9]|6553[0-5])$",
        description="HOST:PORT, such as 127.0.0.1:5005, PORT 65535 at most",
    ),
]
Sign = Literal[-1, 1]
Channel = Annotated[int, Meta(ge=0, le=15)]
Estimator = Literal["likelihood", "harris", "minimum-eigenvalue", "trajkovic-4", "trajkovic-8"]
Quaternion = tuple[float, float, float, float]
PlainMode = Literal["testbed-demo", "hold", "detumble", "safe"]
CommandedMode = Literal[PlainMode, "sun", "point"]


class Section(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """One section of the configuration; unknown keys are refused."""
