"""What the detector makes of the light: its response, noise, the pattern of its pixels, counts."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import Image, IntArray
from sim_hal.earth_camera.model import EarthCameraModel

Float32Array = npt.NDArray[np.float32]


def counts(model: EarthCameraModel, radiance: Float32Array, generator: np.random.Generator) -> Image:
    """Return the frame (rows, columns) that `radiance` (rows, columns) gives."""
    offsets, spread, dead, hot, hot_counts = _pattern(model)
    if model.response == "logarithmic":
        signal = np.log10(1.0 + radiance * np.float32(1.0 / model.darkest))
        signal *= np.float32(model.counts_per_decade)
        signal += _normal(model, model.noise, generator)
    else:
        charge = radiance * np.float32(model.sensitivity) * (1.0 + spread)
        if model.blooming:
            spill(charge, model.full_well)
        charge += np.sqrt(charge) * _normal(model, 1.0, generator)
        np.clip(charge, 0.0, model.full_well, out=charge)
        charge += _normal(model, model.read_noise, generator)
        signal = charge / np.float32(model.gain)
    signal += offsets + np.float32(model.pedestal)
    # A pixel that works no more has no noise of the light's.
    flat = signal.reshape(-1)
    flat[dead] = 0.0
    flat[hot] = hot_counts
    signal += np.float32(0.5)  # truncation below then rounds to the nearest count
    np.clip(signal, 0.0, model.highest_count, out=signal)
    return np.asarray(signal.astype(model.count_type))


def spill(charge: Float32Array, full_well: float) -> None:
    """Spread charge beyond the full well along each column of `charge` (rows, columns), half up, half down.

    Each pixel on the way fills to the brim before the next one gets any; what reaches an edge is lost.
    """
    for column in np.flatnonzero(np.any(charge > full_well, axis=0)):
        line = charge[:, column]
        over = np.maximum(line - full_well, 0.0)
        np.minimum(line, full_well, out=line)
        for way in (slice(None), slice(None, None, -1)):
            _pour(line[way], 0.5 * over[way], full_well)


def _pour(line: Float32Array, over: Float32Array, full_well: float) -> None:
    carried = 0.0
    for row, excess in enumerate(over.tolist()):
        carried += excess
        if carried > 0.0:
            taken = min(carried, full_well - float(line[row]))
            line[row] += taken
            carried -= taken


def _normal(model: EarthCameraModel, sigma: float, generator: np.random.Generator) -> Float32Array:
    return generator.standard_normal((model.rows, model.columns), dtype=np.float32) * np.float32(sigma)


@lru_cache(maxsize=8)
def _pattern(
    model: EarthCameraModel,
) -> tuple[Float32Array, Float32Array, IntArray, IntArray, Float32Array]:
    """Return offsets in counts, departures of sensitivity, dead and hot pixels, the hot ones' counts."""
    rng = np.random.default_rng(model.seed)
    size = model.rows * model.columns
    offsets = _normal(model, model.fixed_pattern, rng)
    spread = _normal(model, model.response_spread, rng)
    blemished = rng.choice(size, size=model.dead_pixels + model.hot_pixels, replace=False)
    bright = rng.uniform(0.3, 1.0, size=model.hot_pixels) * model.highest_count
    dead, hot = blemished[: model.dead_pixels], blemished[model.dead_pixels :]
    return offsets, spread, dead, hot, bright.astype(np.float32)
