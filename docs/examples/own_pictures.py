"""Solve pictures of the sky, such as photographs, whose field of view need not be known."""

from __future__ import annotations

import argparse

from knightcube import StarTracker, UsageError, read_image

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--fov", type=float, help="field of view across the columns, deg; 4 to 60 if omitted")
parser.add_argument("pictures", nargs="+", help="PNG, TIFF, JPEG, BMP or FITS")
options = parser.parse_args()
tracker = StarTracker(options.fov)
for path in options.pictures:
    try:
        solution = tracker.solve(read_image(path))
    except (UsageError, ValueError) as error:  # the file is not a picture, or it is damaged or too small
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
