"""Tests of `knightcube camera` and of the section `camera` of a configuration."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from flight.app.cli import main
from flight.schema import reader as configuration
from flight.schema.devices import AravisDevice, V4l2Device
from flight.schema.document import ConfigError
from knightcube.vision.camera.images import read_image, stated_exposure
from tests.hal.cameras.ioctl_camera import IoctlCamera
from tests.hal.cameras.rig import kernel_in
from tests.manual_clock import ManualClock

ROOT = Path(__file__).parents[3]
TESTBED = (ROOT / "config" / "testbed.yaml").read_text(encoding="utf-8")
SMALL = "{%s, columns: 64, rows: 64, bits: %d, exposure: 0.04}"


def with_camera(folder: Path, device: str, bits: int = 8) -> Path:
    """Return a configuration of real devices with the given camera section."""
    path = folder / "flight.yaml"
    camera = SMALL % (f"device: {device}" if device else "period: 5.0", bits)
    path.write_text(TESTBED.replace("camera: none", f"camera: {camera}"), encoding="utf-8")
    return path


@pytest.fixture
def camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> IoctlCamera:
    """Install an emulated V4L2 camera of 64 x 64 pixels, and a clock that jumps to the end of each wait."""
    clock = ManualClock()
    kernel = kernel_in(tmp_path, clock, monkeypatch)
    kernel.sizes = {"GREY": (64, 64), "Y10": (64, 64)}
    monkeypatch.setattr("flight.app.devices.SystemClock", lambda: clock)
    return kernel


def test_frames_of_a_real_camera_are_listed_and_kept(
    tmp_path: Path, camera: IoctlCamera, capsys: pytest.CaptureFixture[str]
) -> None:
    config = with_camera(tmp_path, f"{{driver: v4l2, path: {camera.path}, pixel_format: Y10, gain: 7}}", 10)
    out = tmp_path / "frame.png"
    assert main(["camera", "--config", str(config), "--out", str(out), "--count", "3", "--json"]) == 0
    output = json.loads(capsys.readouterr().out)
    assert not output["frozen"]
    numbers = [frame["sequence"] for frame in output["frames"]]
    assert numbers == sorted(set(numbers))
    for number, frame in zip(numbers, output["frames"], strict=True):
        pixels = read_image(tmp_path / f"frame-{number}.png")
        y, x = np.mgrid[:64, :64]
        assert np.array_equal(pixels, (int(pixels[0, 0]) + x + 100 * y) % 1024)
        assert (frame["minimum"], frame["maximum"]) == (pixels.min(), pixels.max())
        assert frame["saturated"] == pytest.approx(np.mean(pixels == 1023))
        assert frame["exposure_s"] == pytest.approx(0.04)
        assert frame["age_s"] == pytest.approx(frame["exposure_s"] + frame["latency_s"])
        assert camera.readout_ns * 1e-9 <= frame["latency_s"] < 0.03


def test_a_frozen_camera_ends_with_status_1(
    tmp_path: Path, camera: IoctlCamera, capsys: pytest.CaptureFixture[str]
) -> None:
    camera.frozen = True
    config = with_camera(tmp_path, f"{{driver: v4l2, path: {camera.path}}}")
    assert main(["camera", "--config", str(config), "--count", "2"]) == 1
    assert "it is frozen" in capsys.readouterr().err


def test_a_missing_camera_is_one_line_and_status_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = with_camera(tmp_path, f"{{driver: v4l2, path: {tmp_path}/none}}")
    assert main(["camera", "--config", str(config)]) == 1
    output = capsys.readouterr().err
    assert "no such camera" in output
    assert output.count("\n") == 1


def test_frames_of_a_simulated_camera_are_taken_alike(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (ROOT / "config" / "step_demo.yaml").read_text(encoding="utf-8")
    config = tmp_path / "small.yaml"
    config.write_text(text.replace("columns: 1024", "columns: 64").replace("rows: 1024", "rows: 64"), "utf-8")
    assert main(["camera", "--config", str(config), "--count", "2", "--exposure", "0.1"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in lines] == ["frame 1", "frame 2"]
    path = tmp_path / "frame.png"
    assert main(["camera", "--config", str(config), "--exposure", "0.1", "--out", str(path)]) == 0
    assert stated_exposure(path) == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("fault", "medians", "status"),
    [
        ("camera: black @ 0.25", (331.5, 0.0, 0.0), 0),
        ("camera: saturated", (65535.0, 65535.0, 65535.0), 0),
        ("camera: off", (), 1),
    ],
)
def test_a_simulated_camera_has_the_configured_faults(
    fault: str, medians: tuple[float, ...], status: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (ROOT / "config" / "step_demo.yaml").read_text(encoding="utf-8")
    config = tmp_path / "small.yaml"
    small = text.replace("columns: 1024", "columns: 64").replace("rows: 1024", "rows: 64")
    config.write_text(
        f"{small}  faults: [{{fault: '{fault}'}}]\n".replace(" @ 0.25'", "', at: 0.25"), "utf-8"
    )
    words = ["camera", "--config", str(config), "--count", "3", "--exposure", "0.1", "--json"]
    assert main(words) == status
    output = capsys.readouterr()
    if status:
        assert "does not answer the trigger" in output.err
        return
    found = [frame["median"] for frame in json.loads(output.out)["frames"]]
    assert found == pytest.approx(medians, rel=0.2)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--count", "0"], "--count 0"),
        (["--exposure", "nan"], "--exposure nan: give seconds"),
        (["--exposure", "1e-10"], "--exposure 1e-10: give seconds, from 1e-6 to 10"),
        (
            ["--out", "frame.fits"],
            "ends in .png",
        ),
        ([], "`camera` is missing"),
    ],
)
def test_a_mistake_is_one_line_and_status_2(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["camera", "--config", str(ROOT / "config" / "testbed.yaml"), *words]) == 2
    output = capsys.readouterr().err
    assert message in output
    assert output.count("\n") == 1


def test_real_devices_need_a_camera_that_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["camera", "--config", str(with_camera(tmp_path, ""))]) == 2
    assert "camera.device: the flight uses real devices: give" in capsys.readouterr().err


def test_each_kind_of_camera_has_its_own_keys(tmp_path: Path) -> None:
    output = configuration.load(with_camera(tmp_path, "{driver: aravis, name: Fake_1, pixel_format: Mono8}"))
    assert output.camera is not None
    assert output.camera.device == AravisDevice(name="Fake_1", pixel_format="Mono8")
    output = configuration.load(with_camera(tmp_path, "{driver: v4l2, stamp: end, stamp_delay: 0.01}"))
    assert output.camera is not None
    assert output.camera.device == V4l2Device(stamp="end", stamp_delay=0.01)


@pytest.mark.parametrize(
    ("device", "bits", "message"),
    [
        ("{driver: v4l2, gian: 3}", 8, "unknown key, did you mean `gain`"),
        ("{driver: aravis, name: x, nane: 3}", 12, "unknown key, did you mean `name`"),
        ("{driver: aravis, name: x, path: /dev/video0}", 12, "known keys: name, pixel_format, gain"),
        ("{driver: webcam}", 8, "webcam"),
        ("{driver: v4l2, pixel_format: GREY}", 12, "pixels of GREY have 8"),
        ("{driver: v4l2, pixel_format: Y16}", 8, "pixels of Y16 have 9 to 16"),
        ("{driver: aravis}", 8, "`camera.device.name` is missing"),
    ],
)
def test_an_impossible_camera_section_is_refused(
    tmp_path: Path, device: str, bits: int, message: str
) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        configuration.load(with_camera(tmp_path, device, bits))
    assert "flight.yaml:" in caught.value.where


def test_the_commented_example_of_the_testbed_is_right(tmp_path: Path) -> None:
    lines = TESTBED.splitlines()
    begin = lines.index("# camera:")
    section = []
    for line in lines[begin:]:
        if not line.startswith("#"):
            break
        section.append(line.removeprefix("# "))
    path = tmp_path / "flight.yaml"
    path.write_text(TESTBED.replace("camera: none", "\n".join(section)), encoding="utf-8")
    camera = configuration.load(path).camera
    assert camera is not None
    assert isinstance(camera.device, V4l2Device)
    other = next(line for line in section if "driver: aravis" in line)
    configuration.load(with_camera(tmp_path, other[other.index("{") :], 12))


def test_no_module_of_aravis_is_imported_before_an_aravis_camera_is_opened() -> None:
    source = (ROOT / "hal" / "drivers" / "aravis_camera.py").read_text(encoding="utf-8")
    top = [line for line in source.splitlines() if line.startswith(("import ", "from "))]
    assert not [line for line in top if "gi" in line.split() or "aravis" in line]
