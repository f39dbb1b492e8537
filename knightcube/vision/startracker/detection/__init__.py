"""Detection of stars in a frame from any camera, with the covariances of their positions.

    found = detect(pixels, DetectionSettings()).stars()
    found.points, found.covariance, found.flux        # brightest first

`survey` measures background and noise, finds connected areas above the noise and decides whether the frame
shows points or streaks (`knightcube.vision.streaks` measures streaks). `psf_fit` fits the point spread
function (PSF) to the pixels of stars. `measurement` measures positions and fluxes of stars with the PSF and
the noise of the frame. `detect` searches a whole frame, or only areas near predicted positions, for stars.
"""

from knightcube.vision.startracker.detection.detect import (
    Detections,
    Quality,
    detect,
    measure_areas,
    measure_near,
)
from knightcube.vision.startracker.detection.survey import (
    DetectionSettings,
    FrameKind,
    FrameShape,
    Survey,
    survey,
)

__all__ = [
    "DetectionSettings",
    "Detections",
    "FrameKind",
    "FrameShape",
    "Quality",
    "Survey",
    "detect",
    "measure_areas",
    "measure_near",
    "survey",
]
