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
from knightcube.errors import InputError, UsageError
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
        density: limit of the number of brighter stars around the corners of triangles with a longest side of
            2.5 deg. A star is a corner of triangles of this size only if fewer than `density` brighter stars
            are within 2.5 deg of it. For larger triangles, the limit is higher, so that every octave of size
            has about the same number of triangles.
        few: number of brightest stars per circle on the sky, whose triangles are always in the index.
    """

    faintest: float = 8.5
    epoch: float = 2026.5
    resolution: float = float(np.deg2rad(40.0 / 3600.0))
    smallest: float = float(np.deg2rad(1.5))
    largest: float = float(np.deg2rad(25.0))
    density: float = 7.5
    few: int = 5

    @classmethod
    def of_field(cls, fov: float, pixel: float | None = None) -> IndexSettings:
        """Return the settings for a camera with the field of view `fov`, rad, and pixels of `pixel` rad.

        Raises UsageError if the field of view is below 2 deg or above 120 deg.
        """
        if not _NARROWEST <= fov <= _WIDEST:
            raise UsageError(f"a field of {np.rad2deg(fov):g} deg: an index can serve 2 to 120 deg")
        longest = min(fov, DEFAULT.largest)
        resolution = DEFAULT.resolution if pixel is None else _RESOLVED_PIXELS * pixel
        return cls(smallest=_SMALLEST_SHARE * longest, largest=longest, resolution=resolution)


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
    """Return the sky index of the star catalogue.

    Raises UsageError if the index would contain too many or too few stars.
    """
    stars = catalogue.load()
    guide_stars = choose_guide_stars(stars, settings.faintest, settings.epoch, settings.resolution)
    if not 3 <= len(guide_stars) <= _MOST_STARS:
        raise UsageError(
            f"{len(guide_stars)} stars to V {settings.faintest:g}: an index can hold 3 to {_MOST_STARS}"
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
    """Return the default sky index, which is built and stored if it is missing, and read once per process."""
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
        sys.stderr.write(f"{path}: the sky index cannot be stored: {error.strerror or error}\n")
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
        sys.stderr.write(f"{options.output}: cannot be written: {error.strerror or error}\n")
        return 2
    megabytes = options.output.stat().st_size / 1e6
    sys.stdout.write(
        f"{options.output}: {len(sky.stars)} stars, {len(sky.triangles)} triangles, {megabytes:.1f} MB,"
        f" {time.monotonic() - begin:.1f} s\n"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
