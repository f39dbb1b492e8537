"""Command `knightcube camera`, which takes frames from a configured camera without opening other devices."""

from __future__ import annotations

import argparse
import sys
import textwrap
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flight.app.devices import open_camera, real_rig, simulated_camera
from flight.app.run import RunRequest
from flight.app.service import requested_config
from flight.schema.devices import Camera, camera_model
from flight.schema.document import ConfigError, config_path
from ground.commands.options import CONFIG_HELP, finite, print_result
from hal.interfaces.devices import Frame, FrameSource
from hal.interfaces.errors import NotResponding
from hal.interfaces.wires import Clock
from knightcube.astro.arrays import FloatArray
from knightcube.errors import UsageError
from knightcube.vision.camera.images import write_picture

_POLL_NS = 5_000_000
_PATIENCE_NS = 10_000_000_000
_MAX_ROTATION = 0.5  # largest rotation (rad) in one exposure; longer streaks would leave any field of view
_MAX_EXPOSURES = 8
"""Maximum time to wait for a frame, in exposure times (a free-running camera finishes other frames first)."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `knightcube camera` to the parser."""
    parser.description = (
        "Take frames from the camera of a configuration, real or simulated, one per trigger. Print the "
        "number of each frame, its delay after the end of the exposure, and its counts. --out writes the "
        "counts as PNG, for the commands `solve` and `rate`. Coils and inertial unit are not opened. A "
        "simulated camera can be rotated: --rate makes streaks, and the truth of each picture is written "
        "beside it as JSON."
    )
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.description = textwrap.fill(parser.description, 100)
    parser.epilog = (
        "examples:\n"
        "  knightcube camera --config /etc/knightcube/flight.yaml --out frame.png --count 5\n"
        "  knightcube camera --config step_demo --exposure 0.3 --rate 0.05 -0.02 0.01 --out turn.png\n"
        "  knightcube rate turn.png --camera step_demo --exposure 0.3 --prior 0.05 -0.02 0.01\n"
    )
    parser.add_argument("--config", type=config_path, required=True, metavar="CONFIG", help=CONFIG_HELP)
    parser.add_argument("--out", type=Path, metavar="PNG", help="write the frame; several as name-NUMBER.png")
    parser.add_argument("--count", type=int, default=1, metavar="N", help="frames to take (default 1)")
    text = "exposure time, 1e-6 to 10 s, instead of that of the configuration"
    parser.add_argument("--exposure", type=float, metavar="S", help=text)
    text = "rotate a simulated camera, rad/s in its axes: boresight +z, x right, y down"
    parser.add_argument("--rate", type=finite, nargs=3, metavar=("X", "Y", "Z"), help=text)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Take and write the frames, and print a line for each. The exit status is 1 if the camera is frozen."""
    if options.count < 1:
        raise UsageError(f"--count {options.count}: give a number of frames, 1 or more")
    if options.exposure is not None and not 1e-6 <= options.exposure <= 10.0:
        raise UsageError(f"--exposure {options.exposure}: give seconds, from 1e-6 to 10")
    if options.out is not None and options.out.suffix.lower() != ".png":
        raise UsageError(f"--out {options.out}: frames are written as PNG: give a name that ends in .png")
    facts = []
    rate = None if options.rate is None else np.array(options.rate)
    with opened_camera(options.config, rate) as lone:
        exposure = options.exposure or lone.section.exposure
        if rate is not None and np.linalg.norm(rate) * exposure > _MAX_ROTATION:
            raise UsageError(
                f"--rate: {np.linalg.norm(rate) * exposure:.3g} rad in the exposure: give at most 0.5 rad"
            )
        for frame in _frames(lone.clock, lone.frames, round(exposure * 1e9), options.count):
            facts.append(_facts(frame, lone.section))
            if not options.json:
                sys.stdout.write(_line(facts[-1]))
            if options.out is not None:
                path = _keep(options.out, frame, options.count)
                if rate is not None:
                    from ground.samples import write_truth  # noqa: PLC0415 - loads the simulator

                    write_truth(path.with_suffix(".json"), _truth(frame, lone, rate))
    numbers = [fact["sequence"] for fact in facts]
    frozen = numbers != sorted(set(numbers))
    print_result(options, {"frames": facts, "frozen": frozen}, "")
    if frozen:
        sys.stderr.write("knightcube: the camera's frame numbers do not increase: it is frozen\n")
    return 1 if frozen else 0


def _frames(clock: Clock, source: FrameSource, exposure_ns: int, count: int) -> Iterator[Frame]:
    """Yield frames, each after its own trigger. Raises DeviceError."""
    for _ in range(count):
        source.trigger(exposure_ns)
        deadline_ns = clock.now_ns() + _MAX_EXPOSURES * exposure_ns + _PATIENCE_NS
        while (frame := source.poll()) is None:
            if clock.now_ns() > deadline_ns:
                raise NotResponding("camera", "no frame came after the trigger")
            clock.sleep_until_ns(clock.now_ns() + _POLL_NS)
        yield frame


def _facts(frame: Frame, camera: Camera) -> dict[str, Any]:
    pixels = frame.pixels
    saturation = camera.saturation or float(2**camera.bits - 1)
    end_ns = frame.exposure_start_ns + frame.exposure_ns
    return {
        "sequence": frame.sequence,
        "age_s": (frame.arrival_ns - frame.exposure_start_ns) * 1e-9,
        "latency_s": (frame.arrival_ns - end_ns) * 1e-9,
        "exposure_s": frame.exposure_ns * 1e-9,
        "columns": pixels.shape[1],
        "rows": pixels.shape[0],
        "minimum": int(pixels.min()),
        "median": float(np.median(pixels)),
        "maximum": int(pixels.max()),
        "saturated": float(np.mean(pixels >= saturation)),
    }


def _line(fact: dict[str, Any]) -> str:
    return (
        f"frame {fact['sequence']}: {fact['columns']} x {fact['rows']}, exposed {fact['exposure_s']:.4f} s, "
        f"{fact['latency_s'] * 1e3:.1f} ms after its end, age {fact['age_s']:.3f} s, "
        f"counts {fact['minimum']} / {fact['median']:.0f} / {fact['maximum']} (minimum, median, maximum), "
        f"saturated {fact['saturated']:.2%}\n"
    )


def _keep(out: Path, frame: Frame, count: int) -> Path:
    path = out if count == 1 else out.with_name(f"{out.stem}-{frame.sequence}{out.suffix}")
    write_picture(path, frame.pixels, frame.exposure_ns * 1e-9)
    return path


def _truth(frame: Frame, lone: OpenCamera, rate: FloatArray) -> dict[str, Any]:
    from ground.samples import sky_truth  # noqa: PLC0415 - loads the simulator

    assert lone.attitude is not None, "only a simulated camera can be rotated"
    middle_ns = frame.exposure_start_ns + frame.exposure_ns // 2
    focal_length = camera_model(lone.section).focal_length
    return sky_truth(rate, frame.exposure_ns * 1e-9, lone.attitude(middle_ns), focal_length)


@dataclass(frozen=True, slots=True)
class OpenCamera:
    """An open camera with clock and configuration.

    For a simulated camera, `attitude` returns the attitude (4,) at a time (ns).
    """

    clock: Clock
    frames: FrameSource
    section: Camera
    attitude: Callable[[int], FloatArray] | None = None


@contextmanager
def opened_camera(config_path: Path, rate: FloatArray | None = None) -> Iterator[OpenCamera]:
    """Open only the camera of a configuration, which is simulated if the section `simulation` exists.

    A simulated camera rotates at `rate` (3,), rad/s, in camera axes. Raises ConfigError if the configuration
    has no camera, UsageError if a rate is given for a real camera, and DeviceError.
    """
    text, config = requested_config(RunRequest(config_path, Path()))
    if config.camera is None:
        raise ConfigError(str(config_path), "`camera` is missing: give a configuration with a camera")
    if config.simulation is not None:
        turning = np.zeros(3) if rate is None else rate
        posed = simulated_camera(config_path, text, config, turning)
        yield OpenCamera(posed.clock, posed.frames, config.camera, posed.attitude)
        return
    if rate is not None:
        raise UsageError("--rate: this configuration has a real camera, only a simulated one can be rotated")
    with ExitStack() as stack:
        rig = real_rig(config, stack)
        yield OpenCamera(rig.clock, open_camera(config.camera, rig, stack), config.camera)
