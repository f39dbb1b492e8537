"""Tests of the commands `calibrate`, `samples` and `index`, and of frames from `knightcube camera --rate`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from knightcube.astro.quaternion import angle_between
from knightcube.vision.startracker.attitude_fit import MatchStatus
from knightcube.vision.startracker.index import load
from knightcube.vision.startracker.lost_in_space import identify
from tests.ground.commands.in_process import command
from tests.support.places import DEMO
from tests.support.star_lists import ListKind, draw

pillow = pytest.importorskip("PIL.Image", reason="needs the extra `images`")

from flight.schema.reader import load_camera  # noqa: E402
from tests.knightcube.vision.startracker.frames import NARROW, sky_frame  # noqa: E402


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("night")
    paths = [folder / f"{number}.png" for number in range(3)]
    for number, path in enumerate(paths):
        frame = sky_frame(np.random.default_rng([41, number]), 0.0, 0.5)
        pillow.fromarray(frame.pixels).save(path, compress_level=1)
    return paths


@pytest.fixture(scope="module")
def calibrated(pictures: list[Path]) -> tuple[dict[str, Any], Path]:
    """Return the JSON object of a calibration with an inaccurate field of view, and its camera file."""
    out = pictures[0].with_name("camera.yaml")
    done = command("calibrate", *pictures, "--fov", "12.3", "--out", out, "--json")
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout), out


def test_the_calibration_finds_the_lens_of_the_simulated_camera(
    pictures: list[Path], calibrated: tuple[dict[str, Any], Path]
) -> None:
    """The calibration finds the lens of the simulated camera, which has no distortion and a centred axis.

    All fitted values must lie within five standard deviations of the truth.
    """
    facts, out = calibrated
    truth = {"focal_length": NARROW.pinhole.focal_length, "k1": 0.0, "k2": 0.0}
    for name, value in truth.items():
        assert abs(facts[name] - value) < 5.0 * facts["sigma"][name], name
    assert facts["rms_px_after"] < 0.3
    solved = command("solve", pictures[0], "--camera", out, "--json")
    solution = json.loads(solved.stdout)
    assert solution["field_of_view_deg"] == pytest.approx(12.0, abs=0.005)
    # The attitude refers to the calibrated axis, whose uncertainty is stated separately.
    assert solution["optical_axis_sigma_px"] == pytest.approx(facts["accuracy"]["centre"], rel=0.01)
    lines = command("solve", pictures[0], "--camera", out).stdout.splitlines()
    assert sum(line.startswith("optical axis:") for line in lines) == 1


def test_undetermined_parameters_of_the_lens_are_named_and_not_written(
    pictures: list[Path], tmp_path: Path
) -> None:
    """Parameters that the stars do not determine are named and not written.

    The image covers only the central 7 deg, where a distortion is not measurable.
    """
    middle, out = tmp_path / "middle.png", tmp_path / "camera.yaml"
    pillow.open(pictures[0]).crop((212, 212, 812, 812)).save(middle, compress_level=1)
    done = command("calibrate", middle, "--fov", "7.05", "--out", out)
    assert done.returncode == 0, done.stderr
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("k2:")]
    assert "left out, not determined by the stars" in line
    text = out.read_text()
    assert "k2:" not in text
    assert "# The stars do not determine k2" in text
    assert load_camera(out).lens.k2 == 0.0  # type: ignore[union-attr]  # it has just been written


def test_a_camera_file_states_the_uncertainty_of_the_lens(calibrated: tuple[dict[str, Any], Path]) -> None:
    """`knightcube rate` uses the uncertainty of the focal length in the camera file."""
    facts, out = calibrated
    accuracy = load_camera(out).accuracy
    assert accuracy.focal_length == pytest.approx(facts["accuracy"]["focal_length"], rel=1e-2)
    least = facts["sigma"]["focal_length"] / facts["focal_length"]
    assert 0.99 * least <= accuracy.focal_length < 1e-3
    assert abs(facts["focal_length"] / NARROW.pinhole.focal_length - 1.0) < 5.0 * accuracy.focal_length
    assert 0.0 < accuracy.distortion < 2e-3
    assert accuracy.line_time is None, "no picture of stars that stand still shows that"


def test_a_picture_of_another_focus_is_left_out_and_named(pictures: list[Path], tmp_path: Path) -> None:
    other = tmp_path / "other.png"
    picture = pillow.open(pictures[0])
    picture.resize((1055, 1055)).crop((15, 15, 1039, 1039)).save(other, compress_level=1)
    done = command("calibrate", *pictures, other, "--fov", "12", "--json")
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert [picture["left_out"] is None for picture in facts["pictures"]] == [True, True, True, False]
    assert facts["focal_length"] == pytest.approx(NARROW.pinhole.focal_length, rel=2e-4)


def test_few_stars_make_no_camera_file(pictures: list[Path], tmp_path: Path) -> None:
    corner, out = tmp_path / "corner.png", tmp_path / "camera.yaml"
    pixels = np.asarray(pillow.open(pictures[0])).copy()
    shown = json.loads(command("solve", pictures[0], "--fov", "12", "--json").stdout)["stars"][:8]
    mask = np.zeros(pixels.shape, dtype=bool)
    for star in shown:
        x, y = np.rint(star["point_px"]).astype(int)
        mask[max(0, y - 8) : y + 9, max(0, x - 8) : x + 9] = True
    dark = np.random.default_rng(3).normal(np.median(pixels), 11.0, pixels.shape)
    kept = np.where(mask, pixels, np.clip(dark, 0, 4000)).astype(np.uint16)
    pillow.fromarray(kept).save(corner, compress_level=1)
    done = command("calibrate", corner, "--fov", "12", "--out", out)
    assert done.returncode == 1
    assert "too few for a camera" in done.stderr
    assert not out.exists()


def test_pictures_without_stars_are_named_with_the_reason_and_exit_status_1(tmp_path: Path) -> None:
    path = tmp_path / "cloud.png"
    pillow.fromarray(np.random.default_rng(1).normal(90.0, 9.0, (256, 256)).astype(np.uint8)).save(path)
    done = command("calibrate", path)
    assert done.returncode == 1
    assert "cloud.png" in done.stderr
    assert "without --fov" not in done.stderr
    assert (
        "--fov 9: without --fov, fields from 4 to 60 deg are"
        in command("calibrate", path, "--fov", "9").stderr
    )


def test_a_picture_that_is_given_twice_counts_once(pictures: list[Path], tmp_path: Path) -> None:
    """The copy is recognised by its pixels, even if its metadata rotate the image."""
    exif = pillow.Exif()
    exif[0x0112] = 6
    pillow.open(pictures[1]).save(tmp_path / "copy.png", exif=exif)
    once = json.loads(command("calibrate", *pictures[:2], "--fov", "12", "--json").stdout)
    copies = (pictures[0], tmp_path / "copy.png")
    twice = json.loads(command("calibrate", *pictures[:2], *copies, "--fov", "12", "--json").stdout)
    assert twice["sigma"] == once["sigma"]
    assert twice["focal_length"] == once["focal_length"]
    text = command("calibrate", *pictures[:2], *copies, "--fov", "12").stdout
    assert "pictures:     2 of 4 used" in text
    assert "copy.png: excluded: it has the pixels of picture 2: give different pictures" in text


def test_a_file_that_is_there_is_not_overwritten(pictures: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "camera.yaml"
    out.write_text("camera: mine\n")
    done = command("calibrate", *pictures, "--out", out)
    assert done.returncode == 2
    assert "exists already" in done.stderr
    assert out.read_text() == "camera: mine\n"


def test_mirrored_pictures_give_the_lens_of_the_pictures_as_they_are(
    pictures: list[Path], tmp_path: Path
) -> None:
    """If two of three images are mirrored, the third image is excluded and named."""
    paths = [tmp_path / path.name for path in pictures]
    for number, (path, source) in enumerate(zip(paths, pictures, strict=True)):
        pixels = np.asarray(pillow.open(source))
        seen = pixels if number == 1 else np.ascontiguousarray(pixels[:, ::-1])
        pillow.fromarray(seen).save(path, compress_level=1)
    done = command("calibrate", *paths, "--fov", "12.3", "--json")
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert facts["mirrored"]
    assert [bool(each["left_out"]) for each in facts["pictures"]] == [False, True, False]
    assert "mirrored" in facts["pictures"][1]["left_out"]
    assert abs(facts["focal_length"] - NARROW.pinhole.focal_length) < 5.0 * facts["sigma"]["focal_length"]


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Return the JSON object that `samples --json` prints."""
    done = command("samples", "--out", tmp_path_factory.mktemp("samples"), "--json")
    assert done.returncode == 0, done.stderr
    facts: dict[str, Any] = json.loads(done.stdout)
    return {**facts, "truth": json.loads(Path(facts["truth"]).read_text())}


def _tried(samples: dict[str, Any], name: str) -> dict[str, Any]:
    """Run the command that is printed for a sample image, and return its JSON output."""
    (line,) = [line for line in samples["try"] if line.startswith(f"{name} ")]
    done = command(*line.split(), "--json")
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def _within(error: np.ndarray[Any, Any], covariance: list[list[float]]) -> bool:
    return bool(error @ np.linalg.solve(np.array(covariance), error) < 25.0)


def test_the_sample_of_stars_is_solved_to_a_hundredth_of_a_degree(samples: dict[str, Any]) -> None:
    found, truth = _tried(samples, "solve"), samples["truth"]["stars.png"]
    assert found["right_ascension_deg"] == pytest.approx(truth["right_ascension_deg"], abs=0.01)
    assert found["declination_deg"] == pytest.approx(truth["declination_deg"], abs=0.01)


def test_the_streaks_give_the_rate_and_the_satellite_among_them(samples: dict[str, Any]) -> None:
    found, truth = _tried(samples, "rate"), samples["truth"]["streaks.png"]
    assert _within(np.array(found["rate_rad_s"]) - truth["rate_rad_s"], found["covariance_rad2_s2"])
    assert found["streak_length_px"] == pytest.approx(truth["streak_px"], rel=0.1)
    (satellite,) = found["objects"]
    assert satellite["rate_among_stars_rad_s"] == pytest.approx(0.025, rel=0.05)


def test_the_limb_gives_the_nadir(samples: dict[str, Any]) -> None:
    found, truth = _tried(samples, "horizon"), samples["truth"]["limb.png"]
    off = np.degrees(np.arccos(np.dot(found["nadir_camera"], truth["nadir_camera"])))
    assert off < 3.0 * found["sigma_deg"]


def test_the_night_skies_calibrate_the_camera(samples: dict[str, Any]) -> None:
    found = _tried(samples, "calibrate")
    assert all(picture["left_out"] is None for picture in found["pictures"])
    focal_length = 0.5 * 768 / np.tan(np.radians(7.5))
    assert found["focal_length"] == pytest.approx(focal_length, rel=1e-4)


def test_every_sample_has_its_truth_and_a_folder_that_cannot_be_made_is_refused(
    samples: dict[str, Any], tmp_path: Path
) -> None:
    assert {Path(path).name for path in samples["files"]} == set(samples["truth"])
    (tmp_path / "file").touch()
    done = command("samples", "--out", tmp_path / "file")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("camera") / "camera.yaml"
    text = DEMO.read_text(encoding="utf-8").replace("mounting:", "# mounting:")
    small = text.replace("columns: 1024", "columns: 480").replace("rows: 1024", "rows: 480")
    mounted = small.replace("  endpoint_bias", "  mounting: [0.5, 0.5, 0.5, 0.5]\n  endpoint_bias")
    path.write_text(mounted.replace("field_of_view_deg: 20.0", "field_of_view_deg: 10.0"), encoding="utf-8")
    return path


def test_frames_of_a_turning_camera_have_their_truth_beside_them(config: Path, tmp_path: Path) -> None:
    """The true rate of a frame is stated in camera axes, so it is independent of the camera's mounting."""
    rate = ["0.03", "0.02", "-0.01"]
    words = ["--exposure", "0.3", "--rate", *rate, "--count", "2", "--out", str(tmp_path / "turn.png")]
    done = command("camera", "--config", config, *words)
    assert done.returncode == 0, done.stderr
    truths = [json.loads((tmp_path / f"turn-{number}.json").read_text()) for number in (1, 2)]
    between = angle_between(np.array(truths[0]["attitude"]), np.array(truths[1]["attitude"]))
    # The second frame is triggered after the readout of the first frame (0.05 s). The readout is polled every
    # 5 ms.
    assert float(between) == pytest.approx(np.linalg.norm([0.03, 0.02, 0.01]) * 0.3525, rel=0.01)
    found = command(
        "rate", tmp_path / "turn-2.png", "--camera", config, "--exposure", "0.3", "--prior", *rate, "--json"
    )
    facts = json.loads(found.stdout)
    assert found.returncode == 0, facts
    assert _within(np.array(facts["rate_rad_s"]) - truths[1]["rate_rad_s"], facts["covariance_rad2_s2"])


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--rate", "3", "0", "0"], "--rate: 3 rad in the exposure: give at most 0.5"),
        (["--rate", "nan", "0", "0"], "nan is not a finite number"),
        (["--rate", "1", "0"], "expected 3 arguments"),
    ],
)
def test_a_rate_that_no_picture_shows_is_refused(words: list[str], complaint: str, config: Path) -> None:
    done = command("camera", "--config", config, *words)
    assert done.returncode == 2
    assert complaint in done.stderr


def test_a_real_camera_does_not_turn_by_itself(tmp_path: Path) -> None:
    text = (DEMO.parent / "testbed.yaml").read_text(encoding="utf-8")
    path = tmp_path / "real.yaml"
    path.write_text(
        text.replace("camera: none", "camera: {device: {driver: v4l2}, bits: 8}"), encoding="utf-8"
    )
    done = command("camera", "--config", path, "--rate", "0", "0", "0.01")
    assert done.returncode == 2
    assert "has a real camera" in done.stderr


def test_the_index_of_a_camera_serves_its_field_and_is_smaller(tmp_path: Path) -> None:
    path = tmp_path / "mission.index"
    done = command("index", "--fov", "20", "--faintest", "6.0", "--out", path, "--json")
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    sky = load(path)
    assert facts["stars"] == len(sky.stars) < 6000
    assert facts["triangles"] == len(sky.triangles)
    for seed in range(5):
        drawn = draw(
            ListKind(field_deg=20.0, noise_px=0.3, false_stars=2), sky.stars, np.random.default_rng(seed)
        )
        found = identify(drawn.field(), sky)
        assert found.status is MatchStatus.IDENTIFIED
        matched = found.star >= 0
        assert np.mean(found.star[matched] == drawn.star[matched]) > 0.8


def test_a_camera_of_a_configuration_gives_field_and_resolution(tmp_path: Path) -> None:
    path = tmp_path / "mission.index"
    done = command("index", "--camera", "step_demo", "--faintest", "4.0", "--out", path)
    assert done.returncode == 0, done.stderr
    assert "triangles" in done.stdout
    assert 300 < len(load(path).stars) < 700


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("--fov", "1"), "2 to 120 deg"),
        (("--fov", "20", "--faintest", "nan"), "finite"),
        (("--fov", "20", "--faintest", "-9"), "stars to V -9"),
        (("--fov", "20", "--faintest", "2"), "48 stars to V 2, a mean of 0.5 in a field of 20 deg"),
        (("--fov", "20", "--faintest", "12"), "faintest: 12: give a V magnitude up to 8.5"),
        (("--fov", "20", "--epoch", "1e6"), "epoch: 1e+06: give a Julian year from 1900 to 2200"),
        (("--fov", "20", "--faintest", "4", "--out", "/proc/nowhere/x.index"), "cannot be written"),
    ],
)
def test_wrong_use_is_explained(arguments: tuple[str, ...], complaint: str, tmp_path: Path) -> None:
    out = () if "--out" in arguments else ("--out", str(tmp_path / "x.index"))
    done = command("index", *arguments, *out)
    assert done.returncode == 2
    assert complaint in done.stderr
