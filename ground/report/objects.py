"""The objects that a flight tracked: how often each was seen, how fast and how bright it is."""

from __future__ import annotations

from typing import Any

import numpy as np

from ground.telemetry.reader import Run
from knightcube.astro.arrays import FloatArray

Object = dict[str, Any]


def objects(run: Run) -> list[Object]:
    """Return the figures of each tracked object, in the order in which they were found."""
    return [_figures(packets) for packets in tracks_of(run)]


def tracks_of(run: Run) -> list[Any]:
    """Return the packets of each track, by its number."""
    packets = run["track"]
    return [packets[packets["number"] == number] for number in np.unique(packets["number"])]


def _figures(packets: Any) -> Object:
    seen = packets["seen"] > 0
    speed = speeds_of(packets)
    return {
        "number": int(packets["number"][0]),
        "first_s": float(packets["middle_ns"][0]) * 1e-9,
        "last_s": float(packets["middle_ns"][-1]) * 1e-9,
        "frames": len(packets),
        "seen": int(seen.sum()),
        "rate_least_rad_s": float(speed.min()),
        "rate_most_rad_s": float(speed.max()),
        "magnitude": float(np.median(packets["magnitude"])),
        "sighting_sigma_rad": float(np.median(packets["measured_sigma"][seen])) if seen.any() else None,
    }


def speeds_of(packets: Any) -> FloatArray:
    """Return the angular rates (n,), rad/s."""
    return np.asarray(np.linalg.norm(packets["rate"].astype(float), axis=1))
