"""Errors of the described (configured) properties of a satellite, drawn from a seed.

The flight software knows moments of inertia, coils and sensors to the accuracies that its configuration
states. The simulated satellite differs from its configuration: each error is drawn uniformly and
independently within a multiple of the configured accuracy. Moments of inertia that violate the triangle
inequality are drawn again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flight.schema.bodies import OrbitConfig
from flight.schema.sections import Config
from knightcube.astro.arrays import FloatArray
from knightcube.astro.inertia import principal_axes
from sim_hal.settings import Simulation

_STREAM = 0xD1FF


@dataclass(frozen=True, slots=True, eq=False)
class DescriptionErrors:
    """True properties of a satellite relative to the properties in its configuration.

    Attributes:
        moments: ratios (3,) of the true to the configured principal moments of inertia.
        axes: rotation vector (3,) from the configured to the true principal axes, rad, body axes.
        coils: matrix (3, 3 g) for g groups of three coils. Each column is the true dipole of a coil divided
            by the magnitude of its configured dipole, in the coil axes of
            `sim_hal.worlds.free_body.coil_frames`.
        gyro: matrix (3, 3) from the true rate to the rate that the gyro measures, without the gyro's bias.
        field: matrix (3, 3) from the true to the measured magnetic field, without the magnetometer's bias.
        field_bias: bias (3,) of the magnetometer, T.
        camera: rotation vector (3,) from the configured to the true mounting of the star camera, rad, body
            axes.
        horizon: rotation vectors (n, 3) from the configured to the true mountings of n horizon cameras, rad,
            body axes.
    """

    moments: FloatArray
    axes: FloatArray
    coils: FloatArray
    gyro: FloatArray
    field: FloatArray
    field_bias: FloatArray
    camera: FloatArray
    horizon: FloatArray


NO_ERRORS = DescriptionErrors(
    np.ones(3), np.zeros(3), np.eye(3), np.eye(3), np.eye(3), np.zeros(3), np.zeros(3), np.zeros((0, 3))
)


def description_errors(config: Config, section: Simulation) -> DescriptionErrors:
    """Return the errors of a satellite's configured properties, drawn from the seed of `section`.

    The errors are zero for a testbed, because only the configuration of a satellite in orbit has accuracies.
    """
    body = section.free_body
    if body is None or body.errors == 0.0 or not isinstance(config, OrbitConfig):
        return NO_ERRORS
    generator = np.random.default_rng([section.seed, _STREAM])
    craft, unit = config.craft.accuracy, config.inertial_unit.accuracy

    def drawn(bound: float, *shape: int) -> FloatArray:
        return body.errors * bound * generator.uniform(-1.0, 1.0, shape)

    def matrix(scale: float, alignment: float) -> FloatArray:
        errors = drawn(alignment, 3, 3)
        np.fill_diagonal(errors, drawn(scale, 3))
        return np.eye(3) + errors

    inertia, _ = principal_axes(config.craft.inertia_matrix())
    while True:
        moments = 1.0 + drawn(craft.moments, 3)
        if 2.0 * float((moments * inertia).max()) < float((moments * inertia).sum()):
            break
    groups = math.ceil(len(config.coils.slots) / 3)
    camera = 0.0 if config.camera is None else math.radians(config.camera.accuracy.mounting_deg)
    return DescriptionErrors(
        moments=moments,
        axes=drawn(math.radians(craft.axes_deg), 3),
        coils=np.hstack([matrix(craft.coil_gain, math.radians(craft.coil_axes_deg)) for _ in range(groups)]),
        gyro=matrix(unit.gyro_scale, unit.gyro_alignment),
        field=matrix(unit.field_matrix, unit.field_matrix),
        field_bias=drawn(unit.field_bias, 3),
        camera=drawn(camera, 3),
        horizon=np.array([drawn(math.radians(one.mounting_deg), 3) for one in config.wide_cameras]),
    )
