"""Estimators of the rate from streaks, other than maximum likelihood, that a configuration may select."""

from __future__ import annotations

from flight.schema.devices import Camera
from knightcube.vision.frame_job import StreakEstimator


def corner_estimator(camera: Camera) -> StreakEstimator:
    """Return the streak estimator with the corner detector that the configuration of a camera names.

    Args:
        camera: configuration of a camera whose `estimator` is the name of a corner detector.
    """
    from knightcube.reference.corner_streaks.estimator import CornerEstimator  # noqa: PLC0415 - seldom needed
    from knightcube.reference.corner_streaks.settings import StreakSettings  # noqa: PLC0415

    assert camera.estimator != "likelihood"
    saturation = camera.saturation or float(2**camera.bits - 1)
    bias = {} if camera.endpoint_bias is None else {"endpoint_bias": camera.endpoint_bias}
    settings = StreakSettings.of(camera.estimator, saturation=saturation, gain=camera.gain, **bias)
    return CornerEstimator(settings)
