"""Solve pictures of the sky, such as photographs, whose field of view need not be known.

python own_pictures.py [--fov DEG] IMAGE... takes PNG, TIFF, JPEG, BMP and FITS files.
"""

from __future__ import annotations

import sys

from knightcube import StarTracker, read_image
from knightcube.errors import UsageError

paths, fov_deg = sys.argv[1:], None
if paths[:1] == ["--fov"]:
    fov_deg, paths = float(paths[1]), paths[2:]
tracker = StarTracker(fov_deg)  # without a field of view, 4 to 60 deg are searched
for path in paths:
    try:
        solution = tracker.solve(read_image(path))
    except (UsageError, ValueError) as error:  # not a picture, damaged, or too small
        print(error)
        continue
    if not solution:
        print(f"{path}: {solution.status}: {solution.reason}")
        continue
    print(
        f"{path}: {solution.right_ascension_deg:.4f} {solution.declination_deg:+.4f} deg, "
        f"roll {solution.roll_deg:.2f} deg, field {solution.field_of_view_deg:.2f} deg, "
        f"{len(solution.stars)} stars{', mirrored' if solution.mirrored else ''}"
    )
