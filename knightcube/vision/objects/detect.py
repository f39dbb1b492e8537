"""Resident space objects among the streaks of one frame (Sease chapter 4), by the three classical indicators.

A streak that an indicator singles out is not yet an object: two stars whose streaks overlap, or a piece of a
faint one, deviate as well (Table 4.4: "overlapping streak"). So `judge` asks whether stars explain the
pixels. Regions with more than two corners, which the thesis discards, may be stars or an object that crosses
a star; bright points in a frame whose stars are streaks are tracked objects (Figure 4.5): `short_regions`.
Regions where objects and stars are merged, or saturated, or otherwise strange are searched once their stars
are removed (`merged`). All of this needs only the rotation of the camera; the maximum-likelihood
estimate serves in more frames than the corners' and is closer.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from knightcube.astro.arrays import FloatArray, Image, IntArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.objects.judge import Judge
from knightcube.vision.objects.report import ObjectReport, SpaceObject, Verdict
from knightcube.vision.objects.rso_indicators import INDICATORS, Indicators, evaluate
from knightcube.vision.objects.settings import ObjectSettings
from knightcube.vision.objects.short_regions import short_regions
from knightcube.vision.streaks.corners.endpoints import chord_outward, extend
from knightcube.vision.streaks.corners.settings import StreakSettings
from knightcube.vision.streaks.corners.streaks import Segmented, Streaks, measure_streaks, segment_frame

# A streak with an indicator beyond this many standard deviations is judged by its pixels, though none fired.
_STRANGE = 5.0


def detect(
    pixels: Image,
    pinhole: Pinhole,
    rotation: FloatArray,
    exposure: float,
    settings: StreakSettings,
    objects: ObjectSettings,
) -> ObjectReport | None:
    """Return the objects of a frame (rows, columns), None when it has too few streaks.

    The camera turns by `rotation` (3,) rad in `exposure` s. Where the sign of the rotation is unknown, all
    directions of motion are known up to one common reversal.
    """
    segmented = segment_frame(pixels, replace(settings, most_streaks=objects.most_streaks))
    streaks = measure_streaks(segmented, settings)
    if len(streaks) < settings.least_streaks:
        return None
    return examine(segmented, streaks, rotation, pinhole, exposure, settings, objects)


def examine(
    segmented: Segmented,
    streaks: Streaks,
    rotation: FloatArray,
    pinhole: Pinhole,
    exposure: float,
    settings: StreakSettings,
    objects: ObjectSettings,
) -> ObjectReport:
    """Return the objects among segmented regions; the camera turns by `rotation` (3,) rad in `exposure` s."""
    judge = Judge(segmented, rotation, pinhole, exposure, settings, objects)
    ends = extend(streaks.endpoints, chord_outward(streaks.endpoints), settings.endpoint_bias)
    short, short_sigma, short_label = short_regions(segmented, rotation, pinhole, settings, objects)
    indicators = evaluate(
        np.concatenate([ends, short]),
        np.concatenate([streaks.sigma, short_sigma]),
        rotation,
        pinhole,
        objects.bounds,
        objects.strict,
    )
    labels = np.concatenate([segmented.candidates.label[streaks.candidate], short_label])
    return _judged(judge, indicators, labels, streaks)


def _judged(judge: Judge, indicators: Indicators, labels: IntArray, streaks: Streaks) -> ObjectReport:
    """Return the verdict on each streak of `indicators`, of regions `labels`, and on the crowded regions."""
    found: list[SpaceObject] = []
    settled: list[int] = []
    strange: list[int] = []
    verdicts, crowded = [], []
    each = zip(labels, indicators.endpoints, indicators.deviations, indicators.fired, strict=True)
    for label, streak, deviation, fired in each:
        names = tuple(name for name, fires in zip(INDICATORS, fired, strict=True) if fires)
        verdict, candidate = judge.streak(streak, names)
        verdicts.append(verdict)
        found += [candidate] if candidate is not None else []
        calm = verdict is Verdict.OBJECT or np.abs(deviation).max() <= _STRANGE
        (settled if calm else strange).append(int(label))
    for index, corners in streaks.crowded:
        verdict, candidate = judge.crowd(corners)
        crowded.append(verdict)
        found += [candidate] if candidate is not None else []
        settled += [int(judge.segmented.candidates.label[index])] if verdict is Verdict.OBJECT else []
    found += judge.merged(np.array(settled, dtype=np.int64), np.array(strange, dtype=np.int64))
    found.sort(key=lambda candidate: -candidate.flux)
    return ObjectReport(indicators, tuple(verdicts), tuple(crowded), tuple(found), judge.rotation)
