"""Foregrounds and defects for star frames, like those in photographs or of a worn sensor.

Each function takes pixels (rows, columns) as floats, the brightness range of the stars in counts, and a
random generator.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from knightcube.astro.arrays import FloatArray, Image

Spoiler = Callable[[FloatArray, float, np.random.Generator], FloatArray]

# Texture of a foreground from pixel to pixel, relative to its brightness.
_TEXTURE = 0.02


def spoilt(pixels: Image, kind: str, rng: np.random.Generator) -> Image:
    """Return integer `pixels` (rows, columns) with the foreground or defect SPOILERS[kind] added."""
    top = float(np.iinfo(pixels.dtype).max)
    frame = pixels.astype(float)
    span = max(float(np.percentile(frame, 99.9) - np.median(frame)), 20.0)
    return np.rint(np.clip(SPOILERS[kind](frame, span, rng), 0.0, top)).astype(pixels.dtype)


def _grid(frame: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return coordinates y (rows, 1) and x (1, columns) of pixels, from 0 to 1 downwards and rightwards."""
    rows, columns = frame.shape
    return np.linspace(0.0, 1.0, rows)[:, None], np.linspace(0.0, 1.0, columns)[None]


def _lit(frame: FloatArray, light: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return the frame with a foreground of brightness `light` and its texture."""
    return frame + light * (1.0 + _TEXTURE * rng.standard_normal(frame.shape))


def _bright_third(frame: FloatArray, span: float, rng: np.random.Generator) -> FloatArray:
    y, x = _grid(frame)
    return _lit(frame, 2.0 * span * (y > 2.0 / 3.0) * np.ones_like(x), rng)


def _dark_third(frame: FloatArray, span: float, rng: np.random.Generator) -> FloatArray:
    y, x = _grid(frame)
    low = float(np.percentile(frame, 0.1))
    return np.where((y > 2.0 / 3.0) & (x >= 0.0), np.minimum(frame, low), frame)


def _stripes(frame: FloatArray, span: float, rng: np.random.Generator) -> FloatArray:
    row = np.arange(frame.shape[0])[:, None]
    lit = (row > 0.6 * frame.shape[0]) & (row % 24 < 10)
    light = np.asarray(1.5 * span * lit * np.ones((1, frame.shape[1])), dtype=np.float64)
    return _lit(frame, light, rng)


def _bars(frame: FloatArray, span: float, rng: np.random.Generator) -> FloatArray:
    y, _ = _grid(frame)
    column = np.arange(frame.shape[1])[None]
    light = np.asarray(1.5 * span * ((y > 0.5) & (column % 40 < 14)), dtype=np.float64)
    return _lit(frame, light, rng)


def _roof(frame: FloatArray, span: float, rng: np.random.Generator) -> FloatArray:
    y, x = _grid(frame)
    under = y > 0.55 + 0.5 * np.abs(x - 0.4)
    rows, columns = (np.arange(n) for n in frame.shape)
    tiles = 0.4 + 0.6 * ((rows[:, None] % 9 > 1) & ((columns[None] + rows[:, None] // 9 % 2 * 7) % 14 > 1))
    return _lit(np.where(under, np.median(frame), frame), span * under * tiles, rng)


def _leaves(frame: FloatArray, span: float, rng: np.random.Generator) -> FloatArray:
    rows, columns = frame.shape
    light: FloatArray = np.zeros(frame.shape)
    for _ in range(rows * columns // 900):
        x, y = rng.uniform(0.55 * columns, columns), rng.uniform(0.0, 0.55 * rows)
        width, height, turn = rng.uniform(2.0, 7.0), rng.uniform(1.5, 3.5), rng.uniform(0.0, np.pi)
        top, left = max(0, int(y) - 14), max(0, int(x) - 14)
        row, column = np.mgrid[top : min(rows, int(y) + 15), left : min(columns, int(x) + 15)]
        along = (column - x) * np.cos(turn) + (row - y) * np.sin(turn)
        across = (row - y) * np.cos(turn) - (column - x) * np.sin(turn)
        leaf = np.exp(-((along / width) ** 4) - (across / height) ** 4)
        light[row, column] = np.maximum(light[row, column], leaf * rng.uniform(0.3, 2.0))
    return _lit(frame, span * light, rng)


def _discs(frame: FloatArray, span: float, rng: np.random.Generator) -> FloatArray:
    rows, columns = frame.shape
    light: FloatArray = np.zeros(frame.shape)
    for _ in range(4):
        x, y, radius = rng.uniform(0, columns), rng.uniform(0, rows), rng.uniform(8.0, 25.0)
        apart = np.hypot(np.arange(columns)[None] - x, np.arange(rows)[:, None] - y)
        light += 50.0 * span / (1.0 + (np.maximum(apart / radius, 0.1) ** 4))
    return _lit(frame, light, rng)


def _blob(frame: FloatArray, span: float, rng: np.random.Generator) -> FloatArray:
    rows, columns = frame.shape
    x, y = rng.uniform(0.2, 0.8, 2) * (columns, rows)
    square = (np.arange(columns)[None] - x) ** 2 + (np.arange(rows)[:, None] - y) ** 2
    return _lit(frame, 3.0 * span * np.exp(-0.5 * square / 30.0**2), rng)


def _limb(frame: FloatArray, span: float, rng: np.random.Generator) -> FloatArray:
    rows, columns = frame.shape
    radius = 2.0 * columns
    turn = rng.uniform(0.0, 2.0 * np.pi)
    middle = 0.5 * np.array([columns, rows]) + (radius + 0.3 * columns) * np.array(
        [np.cos(turn), np.sin(turn)]
    )
    apart = np.hypot(np.arange(columns)[None] - middle[0], np.arange(rows)[:, None] - middle[1])
    return _lit(frame, 10.0 * span / (1.0 + np.exp(np.clip((apart - radius) / 2.0, -50.0, 50.0))), rng)


def _gradient(frame: FloatArray, span: float, rng: np.random.Generator) -> FloatArray:
    y, x = _grid(frame)
    light = np.asarray(3.0 * span * (0.6 * x + 0.4 * y) ** 2, dtype=np.float64)
    return _lit(frame, light, rng)


def _hot(share: float) -> Spoiler:
    def spoil(frame: FloatArray, span: float, rng: np.random.Generator) -> FloatArray:
        hot = rng.random(frame.shape) < share
        return np.where(hot, frame + span * rng.uniform(0.5, 8.0, frame.shape), frame)

    return spoil


def _columns(frame: FloatArray, span: float, rng: np.random.Generator) -> FloatArray:
    bad = np.asarray(rng.random(frame.shape[1]) < 0.01)
    return np.where(bad[None], frame + 2.0 * span, frame)


def _column_pattern(frame: FloatArray, span: float, rng: np.random.Generator) -> FloatArray:
    noise = 1.4826 * float(np.median(np.abs(frame - np.median(frame)))) + 0.3
    return np.asarray(frame + 2.0 * noise * rng.standard_normal((1, frame.shape[1])))


def _cosmic(frame: FloatArray, span: float, rng: np.random.Generator) -> FloatArray:
    out = frame.copy()
    rows, columns = frame.shape
    for _ in range(200):
        x, y, turn = rng.uniform(0, columns), rng.uniform(0, rows), rng.uniform(0.0, np.pi)
        steps = np.arange(0.0, min(rng.exponential(4.0), 40.0) + 1.0)
        row = np.clip(np.rint(y + steps * np.sin(turn)), 0, rows - 1).astype(int)
        column = np.clip(np.rint(x + steps * np.cos(turn)), 0, columns - 1).astype(int)
        out[row, column] += span * rng.uniform(0.5, 5.0)
    return out


def _as_it_is(frame: FloatArray, span: float, rng: np.random.Generator) -> FloatArray:
    return frame


SPOILERS: dict[str, Spoiler] = {
    "as it is": _as_it_is,
    "bright third": _bright_third,
    "dark third": _dark_third,
    "stripes": _stripes,
    "bars": _bars,
    "roof": _roof,
    "leaves": _leaves,
    "lamps": _discs,
    "stray blob": _blob,
    "bright limb": _limb,
    "gradient": _gradient,
    "hot 0.1 %": _hot(0.001),
    "hot 1 %": _hot(0.01),
    "bad columns": _columns,
    "column pattern": _column_pattern,
    "cosmic rays": _cosmic,
}
"""Foregrounds and defects that can be added to a frame, by name."""
