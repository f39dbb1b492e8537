"""The true motion of the body: attitude, rate, field and specific force at one time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import about_axis_y

STANDARD_GRAVITY = 9.80665


@dataclass(frozen=True, slots=True)
class Motion:
    """The measurements of an ideal inertial unit at one time.

    Attributes:
        time_ns: simulation time.
        quaternion: (4,) reference frame (the testbed's T) into body, scalar last.
        rate: (3,) rad/s, body axes.
        field_body: (3,) T, body axes.
        specific_force_body: (3,) m/s^2, body axes; at rest it points up.
    """

    time_ns: int
    quaternion: FloatArray
    rate: FloatArray
    field_body: FloatArray
    specific_force_body: FloatArray


def about_thread(time_ns: int, angle: float, rate: float, field: float) -> Motion:
    """Return the motion of a body turned on the thread by `angle` rad, at `rate` rad/s, `field` T on -z_T."""
    return Motion(
        time_ns=time_ns,
        quaternion=about_axis_y(angle),
        rate=np.array([0.0, rate, 0.0]),
        # (0, 0, -field) and the specific force of the thread (0, -g, 0), turned into body axes.
        field_body=np.array([field * math.sin(angle), 0.0, -field * math.cos(angle)]),
        specific_force_body=np.array([0.0, -STANDARD_GRAVITY, 0.0]),
    )
