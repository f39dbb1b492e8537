"""Camera imperfections of the campaign `mismatch`, each a change of optics, signal or counts.

The estimator assumes the ideal camera with a global shutter, except for imperfections whose name contains
`described`. For `rolling, unknown line time` the estimator treats the line time as unknown.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy import ndimage

from knightcube.astro.arrays import FloatArray, Image
from knightcube.vision.camera.lens import UNSTATED, CameraKnowledge
from tests.support.supersampled import Optics, coma, disc, gaussian, halo, moffat, ring

Stage = Callable[[FloatArray, np.random.Generator], FloatArray]
"""Function that changes electrons or counts (rows, columns), with a random generator for effects that
differ by frame.
"""

Encoder = Callable[[FloatArray], Image]
"""Function that converts counts (rows, columns) to integers of an unsigned type."""

TOP = 4095.0


def _twelve_bits(counts: FloatArray) -> Image:
    return np.asarray(np.clip(np.rint(counts), 0.0, TOP).astype(np.uint16))


def _eight_bits(counts: FloatArray) -> Image:
    return np.asarray(np.clip(np.rint(counts / 16.0), 0.0, 255.0).astype(np.uint8))


def _jpeg(quality: int) -> Encoder:
    def encode(counts: FloatArray) -> Image:
        from PIL import Image as pillow  # noqa: PLC0415 - an extra

        buffer = io.BytesIO()
        pillow.fromarray(_eight_bits(counts)).save(buffer, format="JPEG", quality=quality)
        return np.asarray(pillow.open(buffer))

    return encode


@dataclass(frozen=True, slots=True, eq=False)
class Imperfection:
    """A difference between a camera and the estimator's model.

    Attributes:
        optics: lens, point spread, scintillation.
        electrons: change of the electrons before photon noise; collected: change after photon noise.
        gain: electrons per count; counts: change of the counts before `encode` rounds them.
        line_time: time (s) between rows.
        known: settings of the estimator that differ from those of the ideal camera.
        top: saturation level (counts) that the camera reports, or None.
    """

    optics: Optics = field(default_factory=Optics)
    electrons: Stage | None = None
    collected: Stage | None = None
    gain: float = 1.0
    counts: Stage | None = None
    encode: Encoder = _twelve_bits
    line_time: float = 0.0
    known: dict[str, Any] = field(default_factory=dict)
    top: float | None = TOP


def _grid(image: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return x and y of the pixels, from -1 to 1 across the frame."""
    rows, columns = image.shape
    return np.linspace(-1.0, 1.0, columns)[None, :], np.linspace(-1.0, 1.0, rows)[:, None]


def _vignetting(image: FloatArray, rng: np.random.Generator) -> FloatArray:
    x, y = _grid(image)
    return np.asarray(image * (1.0 - 0.25 * (x * x + y * y)))


def _response(rms: float) -> Stage:
    return lambda image, rng: np.asarray(image * rng.normal(1.0, rms, image.shape).clip(0.0))


def _gradient(electrons: float) -> Stage:
    def add(image: FloatArray, rng: np.random.Generator) -> FloatArray:
        x, y = _grid(image)
        angle = rng.uniform(0.0, 2.0 * np.pi)
        across = np.cos(angle) * x + np.sin(angle) * y
        return np.asarray(image + electrons * (across - across.min()) / np.ptp(across))

    return add


def _wide_light(electrons: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return the frame with stray light: 5,000 e- at a random position, decreasing with a sigma of 250 px."""
    row, column = np.indices(electrons.shape)
    place = rng.uniform(0.0, electrons.shape)
    away = np.square(row - place[0]) + np.square(column - place[1])
    return np.asarray(electrons + 5000.0 * np.exp(-0.5 * away / 250.0**2))


def _blob(image: FloatArray, rng: np.random.Generator) -> FloatArray:
    y, x = np.indices(image.shape)
    column, row = rng.uniform(100.0, 900.0, 2)
    return np.asarray(image + 3000.0 * np.exp(-0.5 * ((x - column) ** 2 + (y - row) ** 2) / 30.0**2))


def _limb(image: FloatArray, rng: np.random.Generator) -> FloatArray:
    y, x = np.indices(image.shape)
    angle = rng.uniform(0.0, 2.0 * np.pi)
    middle = np.array([512.0, 512.0]) + 2900.0 * np.array([np.cos(angle), np.sin(angle)])
    depth = 2600.0 - np.hypot(x - middle[0], y - middle[1])
    return np.asarray(image + 3000.0 / (1.0 + np.exp(-np.clip(depth / 4.0, -50.0, 50.0))))


def _bayer(image: FloatArray, rng: np.random.Generator) -> FloatArray:
    out = image.copy()
    out[::2, 1::2] *= 0.6
    out[1::2, ::2] *= 0.5
    return out


def _hot(share: float) -> Stage:
    def add(image: FloatArray, rng: np.random.Generator) -> FloatArray:
        hot = rng.random(image.shape) < share
        return np.asarray(image + hot * rng.exponential(600.0, image.shape))

    return add


def _cosmic(count: int) -> Stage:
    def add(image: FloatArray, rng: np.random.Generator) -> FloatArray:
        out = image.copy()
        for _ in range(count):
            length, angle = 2.0 + rng.exponential(8.0), rng.uniform(0.0, np.pi)
            steps = np.linspace(0.0, length, int(4 * length) + 2)
            x = (rng.uniform(0, image.shape[1]) + steps * np.cos(angle)).astype(int)
            y = (rng.uniform(0, image.shape[0]) + steps * np.sin(angle)).astype(int)
            good = (x >= 0) & (x < image.shape[1]) & (y >= 0) & (y < image.shape[0])
            out[y[good], x[good]] += rng.uniform(200.0, 2000.0)
        return out

    return add


def _blooming(image: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Move the charge above 900 e- to the neighbours in the column, half in each direction."""
    out = image.copy()
    for _ in range(12):
        excess = np.maximum(out - 900.0, 0.0)
        out -= excess
        out[1:] += 0.5 * excess[:-1]
        out[:-1] += 0.5 * excess[1:]
    return out


def _gamma(image: FloatArray, rng: np.random.Generator) -> FloatArray:
    return np.asarray(TOP * (np.clip(image, 0.0, TOP) / TOP) ** (1.0 / 2.2))


def _nonlinear(image: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return a nonlinear response: 10 % lower at full scale."""
    return image * (1.0 - 0.1 * np.clip(image, 0.0, TOP) / TOP)


def _columns(image: FloatArray, rng: np.random.Generator) -> FloatArray:
    return np.asarray(image + np.asarray(rng.normal(0.0, 6.0, image.shape[1]))[None, :])


def _bad_columns(image: FloatArray, rng: np.random.Generator) -> FloatArray:
    out = image.copy()
    for column in rng.integers(0, image.shape[1], 6):
        out[:, column] = rng.choice([0.0, 1500.0])
    return out


IMPERFECTIONS: dict[str, Imperfection] = {
    "none": Imperfection(),
    "Moffat beta 3.5": Imperfection(Optics((moffat(1.0, 3.5),), radius=20.0)),
    "Moffat beta 2.5": Imperfection(Optics((moffat(1.0, 2.5),), radius=30.0)),
    "halo 15 %": Imperfection(Optics((halo(1.0, 0.15, 4.0),), radius=16.0)),
    "coma": Imperfection(Optics((coma(0.9, 4.0, 0.6),), radius=14.0)),
    "ellipse 1:1.3": Imperfection(Optics((gaussian(1.0, 1.3, 0.6),))),
    "ellipse 1:2 turned": Imperfection(Optics((gaussian(1.0, 2.0, 0.9),), radius=9.0)),
    "disc 2 px": Imperfection(Optics((disc(2.0),))),
    "disc 4 px": Imperfection(Optics((disc(4.0),))),
    "width over field": Imperfection(Optics((gaussian(0.8), gaussian(1.1), gaussian(1.7)), radius=10.0)),
    "sigma 0.5 px": Imperfection(Optics((gaussian(0.5),))),
    "sigma 2 px": Imperfection(Optics((gaussian(2.0),), radius=12.0)),
    "sigma 3 px": Imperfection(Optics((gaussian(3.0),), radius=18.0)),
    "gain x 4": Imperfection(gain=4.0),
    "gain / 4": Imperfection(gain=0.25),
    "8 bits": Imperfection(encode=_eight_bits, known={"gain": 16.0}, top=255.0),
    "12 bits of gain 5": Imperfection(gain=5.0, known={"gain": 5.0}),
    "counts x 257": Imperfection(
        encode=lambda c: _eight_bits(c).astype(np.uint16) * np.uint16(257), top=None
    ),
    "JPEG 95": Imperfection(encode=_jpeg(95), known={"gain": 16.0}, top=255.0),
    "JPEG 75": Imperfection(encode=_jpeg(75), known={"gain": 16.0}, top=255.0),
    "gamma 2.2": Imperfection(counts=_gamma),
    "median 3 x 3": Imperfection(counts=lambda image, rng: ndimage.median_filter(np.rint(image), 3)),
    "clipped at 600": Imperfection(counts=lambda image, rng: np.minimum(image, 600.0)),
    "blooming": Imperfection(collected=_blooming),
    "hot 0.1 %": Imperfection(collected=_hot(0.001)),
    "hot 1 %": Imperfection(collected=_hot(0.01)),
    "30 cosmic rays": Imperfection(collected=_cosmic(30)),
    "200 cosmic rays": Imperfection(collected=_cosmic(200)),
    "vignetting": Imperfection(electrons=_vignetting),
    "response 2 %": Imperfection(electrons=_response(0.02)),
    "response 5 %": Imperfection(electrons=_response(0.05)),
    "column pattern": Imperfection(counts=_columns),
    "bad columns": Imperfection(counts=_bad_columns),
    "nonlinearity 10 %": Imperfection(counts=_nonlinear),
    "gradient 500 e-": Imperfection(electrons=_gradient(500.0)),
    "gradient 5000 e-": Imperfection(electrons=_gradient(5000.0), gain=5.0, known={"gain": 5.0}),
    "stray blob": Imperfection(electrons=_blob),
    "bright limb": Imperfection(electrons=_limb),
    "Bayer mosaic": Imperfection(electrons=_bayer),
    "scintillation 10 %": Imperfection(Optics(scintillation=0.1)),
    "distortion 0.2 %": Imperfection(Optics(distortion=0.002)),
    "distortion 1 %": Imperfection(Optics(distortion=0.01)),
    "axis 5 px off": Imperfection(Optics(offset=(4.0, -3.0))),
    "rolling, unknown line time": Imperfection(
        line_time=20e-6, known={"knowledge": CameraKnowledge(line_time=UNSTATED)}
    ),
    "rolling, described": Imperfection(line_time=20e-6, known={"line_time": 20e-6}),
    "sigma 3 px, described": Imperfection(Optics((gaussian(3.0),), radius=18.0), known={"psf_sigma": 3.0}),
    "ring 8 px, hole 4 px": Imperfection(Optics((ring(8.0, 4.0),), radius=9.0)),
    "ring 8 px, hole 6 px": Imperfection(Optics((ring(8.0, 6.0),), radius=9.0)),
    "stray light, wide": Imperfection(electrons=_wide_light, gain=5.0, known={"gain": 5.0}),
    "ring 4 px, hole 2 px": Imperfection(Optics((ring(4.0, 2.0),), radius=6.0)),
}
