"""The steps of a bench session with the cameras: dark frames, first light, focus, lens, horizon cameras."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from flight.schema.devices import Camera, WideCamera
from ground.bringup.bench import Outcome, Session, StepSkipped
from ground.bringup.diagnosis import Finding
from hal.interfaces.devices import Frame
from knightcube.astro.arrays import BoolArray, FloatArray, Image
from knightcube.vision.frame import LEAST_SIDE
from knightcube.vision.lens_calibration import MIN_STARS, calibrate_lens
from knightcube.vision.startracker.detect import detect

_FRAMES = 3
_LENS_FRAMES = 6
_FEW_SOURCES = 5  # smallest number of point sources for which a frame is assumed to show stars or lamps
_SHARP = (0.6, 2.5)
"""Range (px) of the PSF width (standard deviation) in which star positions are measured accurately."""
_HOT = 1e-3  # largest fraction of hot pixels of a healthy sensor


def step_dark(session: Session) -> Outcome:
    """Take frames with the lens cap on, and measure level, noise and hot pixels."""
    session.device("camera")
    session.ask("Put the cap on the lens of the camera.")
    if session.hand is not None:
        session.hand.cover(True)
    findings: list[Finding] = []
    taken = session.frames(_FRAMES, findings)
    frames = [frame.pixels for frame in taken]
    if session.hand is not None:
        session.hand.cover(False)
    if len(taken) < 2:  # findings[0] states how many triggers gave no frame
        raise StepSkipped("camera delivers only one frame, and its noise needs two", findings[0])
    camera = session.config.camera
    assert camera is not None, "the device is open"
    first, second = (pixels.astype(float) for pixels in frames[-2:])
    level, noise = float(np.median(second)), _noise(second - first)
    bright_pixels = second > level + 10.0 * max(noise, 1.0)
    hot = float(np.mean(bright_pixels))
    sources = len(detect(frames[-1]).stars())
    single = hot > _HOT and _alone(bright_pixels) > 0.5
    electrons = noise * camera.gain
    findings += _frozen("camera", taken) or _format_faults("camera", camera, taken)
    if findings:
        pass
    elif np.array_equal(first, second):
        if level > 0.0:  # a camera with a low black level may deliver only zeros with the cap on
            text = f"all frames are equal ({level:.0f} counts)"
            cure = "check sensor, cable, gain and `pixel_format`"
            findings.append(Finding("camera", "no signal", text, cure))
    elif lines := _dead_lines(first, second):
        cure = "check cable and sensor; replace the camera if the lines stay"
        findings.append(Finding("camera", "dead lines", lines, cure))
    elif single:
        text = f"{100.0 * hot:.2g} % of the pixels are hot"
        findings.append(Finding("camera", "hot pixels", text, "cool the camera, or shorten `exposure`"))
    elif sources >= _FEW_SOURCES or level >= 0.9 * _saturation(camera):
        text = f"{sources} point sources and {level:.0f} counts although the cap should be on"
        findings.append(Finding("camera", "lens cap off", text, "put the cap on, and repeat the step"))
    elif electrons > 3.0 * camera.read_noise + 5.0:
        text = f"read noise {electrons:.1f} e-, configured {camera.read_noise:g}"
        cure = "check `gain` and `read_noise`, and cool the camera"
        findings.append(Finding("camera", "noisy", text, cure))
    elif 0.0 < electrons < 0.3 * camera.read_noise:
        text = f"read noise {electrons:.2g} e-, configured {camera.read_noise:g}"
        cure = "check `gain` (e-/count), `read_noise`, and whether the pixel format loses bits"
        findings.append(Finding("camera", "wrong gain", text, cure))
    values = {"level": level, "noise_counts": noise, "read_noise": electrons, "hot_pixels": hot}
    changes = {"camera": {"read_noise": round(electrons, 2)}} if noise and not findings else {}
    return Outcome(findings, values | {"sources": sources}, changes, {}, {"dark": frames[-1]})


def _noise(difference: FloatArray) -> float:
    """Return the standard deviation (counts) of a frame's noise from the difference of two dark frames.

    The median makes the result independent of hot pixels. If the noise is below one count, most differences
    are zero and the root mean square is returned instead.
    """
    deviations = np.abs(difference - np.median(difference))
    robust = 1.4826 * float(np.median(deviations))
    return (robust or float(np.sqrt(np.mean(np.minimum(deviations, 2.0) ** 2)))) / math.sqrt(2.0)


def _alone(bright: BoolArray) -> float:
    """Return the fraction of the bright pixels that have no bright neighbour in their row."""
    beside = np.zeros_like(bright)
    beside[:, 1:] |= bright[:, :-1]
    beside[:, :-1] |= bright[:, 1:]
    return float(np.mean(~beside[bright])) if bright.any() else 0.0


def _saturation(camera: Camera | WideCamera) -> float:
    return getattr(camera, "saturation", None) or float(2**camera.bits - 1)


def _frozen(part: str, frames: Sequence[Frame]) -> list[Finding]:
    if len(frames) < 2 or frames[-1].sequence > frames[-2].sequence:
        return []
    text = f"frame {frames[-1].sequence} arrives again"
    return [Finding(part, "frozen", text, "switch the camera off and on")]


def _format_faults(part: str, camera: Camera | WideCamera, frames: Sequence[Frame]) -> list[Finding]:
    """Return a finding if the pixel values exceed the configured bits or are multiples of one number."""
    pixels = frames[-1].pixels
    top, most = 2**camera.bits - 1, int(pixels.max())
    cure = "correct `bits` and `pixel_format`, and the order of the bytes"
    if most > top:
        text = f"pixels have up to {most} counts, but {camera.bits} bits permit {top}"
        return [Finding(part, "wrong pixel format", text, cure)]
    unused = math.gcd(*np.unique(pixels).tolist(), 0)
    if unused > 1 and most > pixels.min():
        text = f"all pixels are multiples of {unused} counts"
        return [Finding(part, "wrong pixel format", text, cure)]
    return []


def _dead_lines(first: FloatArray, second: FloatArray) -> str:
    """Return a text about rows and columns that are identical in two frames, or an empty text."""
    same = first == second
    rows, columns = int(same.all(axis=1).sum()), int(same.all(axis=0).sum())
    return f"{rows} rows and {columns} columns do not change" if rows or columns else ""


def step_light(session: Session) -> Outcome:
    """Take the first frame without the lens cap, which must differ from a dark frame."""
    session.device("camera")
    session.ask("Take the cap off, and point the camera at stars or at small lamps in the dark.")
    findings: list[Finding] = []
    frames = session.frames(2, findings)
    camera, pixels = session.config.camera, frames[-1].pixels
    assert camera is not None, "the device is open"
    sources, level = len(detect(pixels).stars()), float(np.median(pixels))
    saturated = float(np.mean(pixels >= _saturation(camera)))
    findings += _frozen("camera", frames) + _wrong_size("camera", camera, pixels)
    if wrong := _format_faults("camera", camera, frames):
        findings += wrong
    elif saturated > 0.2:
        text = f"{100.0 * saturated:.0f} % of the pixels are saturated"
        findings.append(Finding("camera", "too bright", text, "shorten `exposure`, or darken the room"))
    elif sources < _FEW_SOURCES:
        findings.append(_no_light(session.known.get("dark"), pixels, level, sources))
    values = {"level": level, "sources": sources, "saturated": saturated, "sequence": frames[-1].sequence}
    return Outcome(findings, values, _size_changes(camera, pixels), {}, {"light": pixels})


def _size_changes(camera: Camera, pixels: Image) -> dict[str, Any]:
    """Return the changes of the configured columns and rows that a frame's size requires, if any."""
    if pixels.shape == (camera.rows, camera.columns):
        return {}
    return {"camera": {"columns": pixels.shape[1], "rows": pixels.shape[0]}}


def _wrong_size(part: str, camera: Camera | WideCamera, pixels: Image) -> list[Finding]:
    if pixels.shape == (camera.rows, camera.columns):
        return []
    size = f"{pixels.shape[1]} x {pixels.shape[0]} pixels instead of {camera.columns} x {camera.rows}"
    return [Finding(part, "wrong size", size, "correct `columns` and `rows`")]


def _no_light(dark: Outcome | None, pixels: Image, level: float, sources: int) -> Finding:
    """Return the finding about a frame with too few point sources: no signal, cap on, or unknown cause."""
    before = {} if dark is None else dark.values
    same = abs(level - before.get("level", math.inf)) <= 3.0 * max(before.get("noise_counts", 0.0), 1.0)
    if pixels.max() == pixels.min() > 0:
        text = f"every pixel has {level:.0f} counts"
        return Finding("camera", "no signal", text, "check sensor, cable, gain and `pixel_format`")
    if same or dark is None:
        text = f"{sources} point sources; the level is that of a dark frame ({level:.0f} counts)"
        return Finding("camera", "lens cap on", text, "take the cap off, or point the camera at stars")
    text = f"{sources} point sources at a level of {level:.0f} counts, cause unknown"
    return Finding("camera", "no sources", text, "focus the lens, and point the camera at stars or lamps")


def psf_width(pixels: Image) -> tuple[float, int]:
    """Return the PSF width (standard deviation, px; NaN for fewer than 5 stars) and the number of stars.

    Stars that are many pixels wide are measured in binned frames.
    """
    for factor in (16, 8, 4, 2, 1):
        if factor > 1 and min(pixels.shape) < factor * LEAST_SIDE:
            continue  # the binned frame would be too small for the detection
        rows, columns = (size // factor * factor for size in pixels.shape)
        squares = pixels[:rows, :columns].reshape(rows // factor, factor, columns // factor, factor)
        summed = squares.sum(axis=(1, 3), dtype=np.uint32)
        found = detect(np.minimum(summed, 65535).astype(np.uint16))
        if len(found) >= _FEW_SOURCES and (factor == 1 or found.psf_sigma > 1.0):
            return factor * float(found.psf_sigma), len(found)
    return math.nan, len(found)


def step_focus(session: Session) -> Outcome:
    """Measure the width of the stars' images, repeatedly while the user adjusts the focus ring."""
    session.device("camera")
    session.ask("Turn the focus ring until the PSF width is smallest.")
    widths: list[float] = []
    best: tuple[float, Image] | None = None
    while len(widths) < _FRAMES or session.live is not None:
        pixels = session.frames(1, [])[0].pixels
        width, count = psf_width(pixels)
        widths.append(width)
        if math.isfinite(width) and (best is None or width <= best[0]):
            best = width, pixels
        if session.live is not None and not session.live(f"PSF width {width:.2f} px, {count} sources"):
            break
    if best is None:
        raise StepSkipped(f"fewer than {_FEW_SOURCES} stars in each frame")
    last = next(width for width in reversed(widths) if math.isfinite(width))
    findings = []
    if not _SHARP[0] <= last <= _SHARP[1]:
        text = f"PSF width {last:.2f} px, outside {_SHARP[0]} to {_SHARP[1]} px"
        findings.append(Finding("camera", "out of focus", text, "turn the focus ring, and lock it"))
    values = {"psf_sigma": last, "widths": [None if math.isnan(width) else width for width in widths]}
    changes = {} if findings else {"camera": {"psf_sigma": round(last, 3)}}
    return Outcome(findings, values, changes, {"widths": np.array(widths)}, {"focus": best[1]})


def step_lens(session: Session) -> Outcome:
    """Calibrate the lens from frames of the sky in different directions."""
    camera = session.config.camera
    frames = []
    for number in range(_LENS_FRAMES):
        if session.hand is not None:
            session.hand.turn(np.array([0.6, 0.8, 0.0]), 0.15 * number, 0.001)
        session.ask(f"Point the camera at another part of the sky (frame {number + 1} of {_LENS_FRAMES}).")
        session.wait(0.1)
        frames.append(session.frames(1, [])[0].pixels)
    assert camera is not None, "the device is open"
    found = calibrate_lens(frames, fov_deg=camera.field_of_view_deg)
    lens = found.determined
    if lens is None:
        raise StepSkipped(f"no frame could be solved: {found.images[0].reason}")
    calibration = lens.calibration
    findings = []
    # If the size of the frames differs from the configuration, the measured size is written too.
    field_deg = 2.0 * math.degrees(math.atan(0.5 * frames[0].shape[1] / calibration.lens.focal_length))
    if abs(field_deg / camera.field_of_view_deg - 1.0) > 0.02:
        text = f"{field_deg:.3f} deg across the columns, configured {camera.field_of_view_deg:g}"
        findings.append(Finding("camera", "wrong field of view", text, "use the fragment's `camera`"))
    if found.mirrored:
        cure = "correct the order of the rows, or remove the mirror"
        findings.append(Finding("camera", "mirrored", "the frames are mirrored", cure))
    values = {"stars": calibration.stars, "rms_px": calibration.rms_after, "field_of_view_deg": field_deg}
    changes = _size_changes(camera, frames[0])
    if calibration.stars >= MIN_STARS and "focal_length" not in calibration.undetermined:
        kept = {
            name: round(value, 8) if isinstance(value, float) else value
            for name, value in calibration.lens.to_mapping().items()
            if name in {"focal_length", "centre", "k1", "k2", "aspect", "shear", "p1", "p2"}
        }
        accuracy = {name: float(f"{value:.3g}") for name, value in lens.accuracy.items()}
        fitted = {"field_of_view_deg": round(field_deg, 6), "lens": kept, "accuracy": accuracy}
        changes = {"camera": changes.get("camera", {}) | fitted}
    return Outcome(findings, values, changes)


# Horizon cameras, which measure the directions to Sun and horizon.


def step_wide(session: Session) -> Outcome:
    """Cover one horizon camera after the other, and check that only the covered camera's frame changes."""
    cameras = session.config.wide_cameras
    if not cameras:
        raise StepSkipped("the configuration has no section `wide_cameras`")
    keys = [f"wide_cameras[{number}]" for number in range(len(cameras))]
    findings: list[Finding] = []
    session.ask("Point all horizon cameras at lit surfaces.")
    open_frames: dict[str, Image] = {}
    for key, camera in zip(keys, cameras, strict=True):
        try:
            frames = session.frames(2, findings, key)
        except StepSkipped as reason:
            findings += [reason.finding] if reason.finding else []
            continue
        pixels = open_frames[key] = frames[-1].pixels
        wrong = _frozen(key, frames) + _wrong_size(key, camera, pixels)
        wrong = wrong or _format_faults(key, camera, frames)
        saturated = float(np.mean(pixels >= _saturation(camera)))
        if not wrong and saturated > 0.5:
            text = f"{100.0 * saturated:.0f} % of the pixels are saturated"
            wrong = [Finding(key, "too bright", text, "shorten `exposure`, or darken the room")]
        if wrong:
            del open_frames[key]
        findings += wrong
    covered: dict[str, dict[str, Image]] = {}
    for number, key in enumerate(keys):
        session.ask(f"Cover the lens of {key} only.")
        if session.hand is not None:
            session.hand.cover(True, 1 + number)
        covered[key] = {}
        for name in list(open_frames):
            try:
                covered[key][name] = session.frames(1, [], name)[0].pixels
            except StepSkipped as reason:
                findings += [reason.finding] if reason.finding else []
                del open_frames[name]
        if session.hand is not None:
            session.hand.cover(False, 1 + number)
    darkened = {
        name: _darkened(pixels, {key: frames[name] for key, frames in covered.items()})
        for name, pixels in open_frames.items()
    }
    for key in open_frames:
        own = [name for name in open_frames if key in darkened[name]]
        findings += _cover_faults(key, own, covered[key][key])
    levels = {key: float(np.mean(pixels)) for key, pixels in open_frames.items()}
    listed = {name: sorted(one) for name, one in darkened.items()}
    return Outcome(findings, {"levels": levels, "darkened": listed})


def _darkened(pixels: Image, covered: Mapping[str, Image]) -> set[str]:
    """Return the cameras whose cover darkens the frame of a given camera.

    The frame is `pixels` if no camera is covered, and `covered[key]` if camera `key` is covered.
    """
    level = float(np.mean(pixels))
    levels = {key: float(np.mean(frame)) for key, frame in covered.items()}
    darkest = min(levels.values())
    if level - darkest < max(1.0, 0.1 * darkest):
        return set()
    return {key for key, one in levels.items() if level - one > 0.5 * (level - darkest)}


def _cover_faults(key: str, darkened: Sequence[str], covered: Image) -> list[Finding]:
    """Return the fault of camera `key`, from its covered frame and the cameras that its cover darkened."""
    others = [name for name in darkened if name != key]
    if key not in darkened and others:
        text = f"its cover darkens {others[0]}"
        return [Finding(key, "exchanged", text, "swap the plugs, or `device` of the two cameras")]
    spread = float(np.std(covered)) / max(float(np.iinfo(covered.dtype).max), 1.0)
    if spread > 0.15:
        return [Finding(key, "noisy", "its covered frame is not dark", "check its cable and `pixel_format`")]
    if key not in darkened:
        text = f"its frame does not change when its lens is covered ({float(np.median(covered)):.0f} counts)"
        cure = "take the cap off, point it at light, check its `exposure`"
        return [Finding(key, "lens cap on", text, cure)]
    return []
