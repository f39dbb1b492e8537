"""Stars in a frame: points with honest errors, from a camera of any kind.

    found = detect(pixels, DetectionSettings()).stars()
    found.points, found.covariance, found.flux        # brightest first

`sky` measures the background and finds what stands above it, `areas` puts that together: that is the
`survey`, which distinguishes points from streaks (`frame_kind`); streaks are `knightcube.vision.streaks`'s.
`peaks` chooses the peaks to measure, `first_look` measures the frame's own point spread and noise
(`noise_model`), and `measurement` fits each star with them (`psf_fit`, `blending`) or takes the centre of
mass (`window_centroid`); `detect` composes. `nearby` measures about predicted places only.
"""

from knightcube.vision.startracker.detection.detect import detect, measure_areas
from knightcube.vision.startracker.detection.detections import Detections, FrameKind, FrameShape, Quality
from knightcube.vision.startracker.detection.nearby import measure_near
from knightcube.vision.startracker.detection.settings import DetectionSettings
from knightcube.vision.startracker.detection.survey import Survey, kind_of_frame, survey

__all__ = [
    "DetectionSettings",
    "Detections",
    "FrameKind",
    "FrameShape",
    "Quality",
    "Survey",
    "detect",
    "kind_of_frame",
    "measure_areas",
    "measure_near",
    "survey",
]
