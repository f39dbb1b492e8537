"""Builds the sky index: python -m knightcube.vision.startracker.index.build [--output FILE].

The default index is built at its first use, which takes some seconds, and is stored in the cache folder
$XDG_CACHE_HOME/knightcube or ~/.cache/knightcube. On board, the installer builds the index, and the
configuration contains its path. `knightcube index --camera CONFIG` builds the index for a mission's camera.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from knightcube.astro import catalogue
from knightcube.errors import ArgumentError, InputError, UsageError, reason_of
from knightcube.vision.startracker.index import (
    PATH,
    GuideStars,
    SkyIndex,
    build_triangles,
    choose_guide_stars,
    load,
    save,
)


@dataclass(frozen=True, slots=True)
class IndexSettings:
    """Settings that determine the contents of a sky index.

    Attributes:
        faintest: V magnitude of the faintest guide star.
        epoch: Julian year of the directions; the method `SkyIndex.at` changes the epoch.
        resolution: angle below which two stars are merged, rad.
        smallest, largest: limits of the longest side of a triangle, rad.
        density: limit for the corners of triangles with a longest side of 2.5 deg. A star is a corner of such
            a triangle only if fewer than `density` brighter stars are within 2.5 deg of it. For larger
            triangles, the limit is higher, so that every octave of size has about the same number of
            triangles.
        few: number of brightest stars in each circle on the sky whose triangles are always in the index.
    """

    faintest: float = 8.5
    epoch: float = 2026.5
    resolution: float = float(np.deg2rad(40.0 / 3600.0))
    smallest: float = float(np.deg2rad(1.5))
    largest: float = float(np.deg2rad(25.0))
    density: float = 7.5
    few: int = 5

    def __post_init__(self) -> None:
        """Raise ArgumentError for a value that is out of range."""
        if not self.faintest <= _FAINTEST:
            raise ArgumentError(
                "faintest",
                f"{self.faintest:g}: give a V magnitude up to {_FAINTEST:g}, the catalogue's limit",
            )
        if not _EPOCHS[0] <= self.epoch <= _EPOCHS[1]:
            raise ArgumentError(
                "epoch", f"{self.epoch:g}: give a Julian year from {_EPOCHS[0]:g} to {_EPOCHS[1]:g}"
            )
        if not 0.0 < self.smallest < self.largest < np.pi:
            raise ArgumentError(
                "smallest", f"{self.smallest:g} rad, largest {self.largest:g} rad: give increasing angles"
            )
        if not 0.0 <= self.resolution < self.smallest:
            raise ArgumentError(
                "resolution",
                f"{self.resolution:g} rad: give 0 to {self.smallest:g} rad, the smallest triangle",
            )

    @classmethod
    def of_field(cls, fov: float, pixel: float | None = None) -> IndexSettings:
        """Return the settings for a camera with the field of view `fov`, rad, and pixels of `pixel` rad.

        Raises UsageError if the field of view is below 2 deg or above 120 deg, or if a pixel is not smaller
        than a sixteenth of the field of view.
        """
        if not _NARROWEST <= fov <= _WIDEST:
            raise UsageError(f"a field of view of {np.rad2deg(fov):g} deg: a sky index needs 2 to 120 deg")
        if pixel is not None and not 0.0 < pixel < _WIDEST_PIXEL * fov:
            raise ArgumentError(
                "pixel", f"{pixel:g} rad: give more than 0 and less than a sixteenth of `fov`"
            )
        longest = min(fov, DEFAULT.largest)
        resolution = DEFAULT.resolution if pixel is None else _RESOLVED_PIXELS * pixel
        return cls(smallest=_SMALLEST_SHARE * longest, largest=longest, resolution=resolution)


# Limit of the catalogue (V), and range of epochs (Julian years) in which the proper motions are valid.
_FAINTEST, _EPOCHS = 8.5, (1900.0, 2200.0)
# Largest size of a pixel, relative to the field of view.
_WIDEST_PIXEL = 1.0 / 16.0
# Minimum mean number of guide stars in a square with the size of the largest triangle.
# In a field with a mean of two stars, one image in seven shows the four stars that a fix needs.
_LEAST_PER_FIELD = 2.0
_NARROWEST, _WIDEST = float(np.deg2rad(2.0)), float(np.deg2rad(120.0))
# Ratio of the smallest to the largest triangle in the index for a given field of view.
_SMALLEST_SHARE = 0.2
# Minimum distance (px) of two stars that are resolved in an image.
_RESOLVED_PIXELS = 2.5
_MOST_STARS = 1 << 16
DEFAULT = IndexSettings()
_BANDS_PER_OCTAVE = 2.5
_REFERENCE_SIZE = float(np.deg2rad(2.5))


def build(settings: IndexSettings = DEFAULT) -> SkyIndex:
    """Return the sky index of the star catalogue, which is computed in some seconds.

        sky = build(replace(IndexSettings.of_field(fov), faintest=6.5))

    Raises UsageError if the index would contain too many stars, or so few stars that an image rarely shows
    the four stars that a fix needs.
    """
    stars = catalogue.load()
    guide_stars = choose_guide_stars(stars, settings.faintest, settings.epoch, settings.resolution)
    if not 3 <= len(guide_stars) <= _MOST_STARS:
        raise UsageError(
            f"{len(guide_stars)} stars to V {settings.faintest:g}: an index can hold 3 to {_MOST_STARS}"
        )
    per_field = len(guide_stars) * settings.largest**2 / (4.0 * np.pi)
    if per_field < _LEAST_PER_FIELD:
        raise UsageError(
            f"{len(guide_stars)} stars to V {settings.faintest:g}, a mean of {per_field:.1f} in a field of "
            f"{np.rad2deg(settings.largest):.3g} deg, but a fix needs 4: give fainter stars by `faintest`"
        )
    count = round(_BANDS_PER_OCTAVE * np.log2(settings.largest / settings.smallest))
    sizes = np.geomspace(settings.smallest, settings.largest, count + 1)
    middle = np.sqrt(sizes[1:] * sizes[:-1])
    ranks = np.round(settings.density * (middle / _REFERENCE_SIZE) ** (2.0 / 3.0)).astype(np.int64)
    triangles = build_triangles(guide_stars.direction, 2.0 * np.sin(0.5 * sizes), ranks, settings.few)
    return SkyIndex(guide_stars, proper_motion(guide_stars), triangles)


def proper_motion(stars: GuideStars) -> npt.NDArray[np.float32]:
    """Return the proper motion (n, 3), rad/yr, float32, of guide stars, found by their Hipparcos numbers."""
    source = catalogue.load()
    order = np.argsort(source.hip)
    place = order[np.searchsorted(source.hip, stars.hip, sorter=order)]
    moved = source.directions_at(stars.epoch + 1.0)[place] - source.directions_at(stars.epoch)[place]
    return np.asarray(moved, dtype=np.float32)


def ensure_default_index() -> None:
    """Build the default sky index if it is missing, so that its later use causes no delay."""
    if not PATH.exists():
        default_index()


@cache
def default_index() -> SkyIndex:
    """Return the default sky index, which is built and stored if no usable file exists."""
    path = PATH
    try:
        return load(path)
    except InputError:
        sys.stderr.write(f"building the sky index, once, for {path} ...\n")
    sky = build()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        save(sky, path)
    except OSError as error:
        sys.stderr.write(f"{path}: the sky index cannot be stored: {reason_of(error)}\n")
        return sky
    return load(path)


def main(arguments: Sequence[str] | None = None) -> int:
    """Build and store the sky index. Return 0 if the index was stored, or 2 after an error."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=PATH, help="file (default %(default)s)")
    parser.add_argument(
        "--epoch", type=float, default=DEFAULT.epoch, help="Julian year (default %(default)s)"
    )
    parser.add_argument("--faintest", type=float, default=DEFAULT.faintest, help="V (default %(default)s)")
    parser.add_argument(
        "--fov", type=float, metavar="DEG", help="field of view of a mission's camera (default: 4 to 60)"
    )
    options = parser.parse_args(arguments)
    begin = time.monotonic()
    try:
        settings = DEFAULT if options.fov is None else IndexSettings.of_field(np.deg2rad(options.fov))
        sky = build(replace(settings, faintest=options.faintest, epoch=options.epoch))
        options.output.parent.mkdir(parents=True, exist_ok=True)
        save(sky, options.output)
    except (UsageError, ValueError) as error:
        sys.stderr.write(f"{error}\n")
        return 2
    except OSError as error:
        sys.stderr.write(f"{options.output}: cannot be written: {reason_of(error)}\n")
        return 2
    megabytes = options.output.stat().st_size / 1e6
    sys.stdout.write(
        f"{options.output}: {len(sky.stars)} stars, {len(sky.triangles)} triangles, {megabytes:.1f} MB,"
        f" {time.monotonic() - begin:.1f} s\n"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
