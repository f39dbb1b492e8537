"""Tests of `knightcube solve`, which gives the attitude of an image, its stars, and a plot."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pillow = pytest.importorskip("PIL.Image", reason="needs the extra `images`")

from ground.commands.solve import _text  # noqa: E402
from knightcube.astro.attitude.solvers import SOLVERS  # noqa: E402
from knightcube.astro.quaternion import (  # noqa: E402
    angle_between,
    conjugate,
    multiply,
    to_rotation_vector,
)
from knightcube.vision.star_tracker import StarTracker  # noqa: E402
from knightcube.vision.startracker.sky_map import Pointing  # noqa: E402
from knightcube.vision.startracker.survey import CENTROIDS  # noqa: E402
from tests.ground.commands.in_process import command  # noqa: E402
from tests.knightcube.vision.startracker.frames import SkyFrame, sky_frame  # noqa: E402


def _written(frame: SkyFrame, path: Path) -> Path:
    pillow.fromarray(frame.pixels).save(path, compress_level=1)
    return path


@pytest.fixture(scope="module")
def resting() -> SkyFrame:
    return sky_frame(np.random.default_rng(31), 0.0, 0.2)


@pytest.fixture(scope="module")
def picture(resting: SkyFrame, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _written(resting, tmp_path_factory.mktemp("pictures") / "frame.png")


def test_a_picture_of_an_unknown_field_is_solved(resting: SkyFrame, picture: Path) -> None:
    done = command("solve", picture, "--json")
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    place = Pointing(
        *(math.radians(facts[f"{name}_deg"]) for name in ("right_ascension", "declination", "roll"))
    )
    assert angle_between(place.quaternion(), resting.attitude) < np.radians(30.0 / 3600.0)
    assert angle_between(np.array(facts["quaternion"]), resting.attitude) < np.radians(30.0 / 3600.0)
    assert facts["field_of_view_deg"] == pytest.approx(12.0, abs=0.002)
    assert np.all(np.linalg.eigvalsh(np.array(facts["covariance_rad2"])) > 0.0)
    residuals = np.array([star["residual_px"] for star in facts["stars"]])
    assert len(residuals) > 10
    assert np.sqrt(np.mean(residuals**2)) < 0.5
    assert facts["motion"] is None


def test_angles_just_below_a_full_turn_are_printed_as_zero(resting: SkyFrame) -> None:
    solution = StarTracker(fov_deg=12.0).solve(resting.pixels)
    full = 2.0 * math.pi - 1e-9
    lines = _text(replace(solution, right_ascension=full, roll=full), 0.1).splitlines()
    assert "right ascension:  0.0000 deg" in lines
    assert "roll:             0.000 deg" in lines


def test_streaks_give_the_rate_when_the_exposure_is_known(tmp_path: Path) -> None:
    frame = sky_frame(np.random.default_rng(32), 40.0, 0.2)
    path = _written(frame, tmp_path / "streaks.png")
    done = command("solve", path, "--fov", "12", "--exposure", "0.2", "--json")
    assert done.returncode == 0, done.stderr
    motion = json.loads(done.stdout)["motion"]
    assert np.linalg.norm(motion["rate_rad_s"]) == pytest.approx(np.linalg.norm(frame.rate), rel=0.02)
    assert not motion["direction_of_time_known"]
    result = command("solve", path, "--fov", "12")
    assert "give --exposure for the rate" in result.stdout


def test_streaks_of_an_unknown_field_are_as_uncertain_as_those_of_a_field_with_a_tolerance(
    tmp_path: Path,
) -> None:
    """The lens is uncalibrated in both cases."""
    frame = sky_frame(np.random.default_rng(32), 40.0, 0.2)
    path = _written(frame, tmp_path / "streaks.png")

    def sigmas(*words: str) -> np.ndarray:
        done = command("solve", path, "--exposure", "0.2", "--json", *words)
        assert done.returncode == 0, done.stderr
        return np.sqrt(np.diag(json.loads(done.stdout)["covariance_rad2"]))

    assert sigmas() == pytest.approx(sigmas("--fov", "12"), rel=0.3)


def test_the_date_takes_aberration_off(picture: Path) -> None:
    """The option for the date removes stellar aberration, which changes the attitude by at most 20.5".

    The stars were rendered without aberration.
    """
    without = json.loads(command("solve", picture, "--fov", "12", "--json").stdout)
    with_it = command("solve", picture, "--fov", "12", "--date", "2026-07-02T12:00", "--json")
    facts = json.loads(with_it.stdout)
    moved = np.degrees(angle_between(np.array(facts["quaternion"]), np.array(without["quaternion"]))) * 3600.0
    assert 2.0 < moved < 21.0


@pytest.mark.parametrize("method", sorted(SOLVERS))
def test_each_attitude_solver_finds_the_same_place(method: str, resting: SkyFrame, picture: Path) -> None:
    """All attitude solvers agree within 4 sigma. TRIAD uses only two stars, so it has the largest sigma."""
    words = ("--fov", "12", "--fov-error", "0.1", "--attitude", method)
    done = command("solve", picture, *words, "--json")
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert (facts["attitude_method"], facts["centroid_method"]) == (method, "psf")
    turn = to_rotation_vector(multiply(np.array(facts["quaternion"]), conjugate(resting.attitude)))
    sigma = np.sqrt(np.diag(np.array(facts["covariance_rad2"])))
    assert np.all(np.abs(turn) < 4.0 * sigma)
    assert np.linalg.norm(turn[:2]) < np.radians(15.0 / 3600.0)
    assert sigma[:2].max() < np.radians(15.0 / 3600.0)


@pytest.mark.parametrize("method", CENTROIDS)
def test_each_centroid_finds_the_same_place(method: str, resting: SkyFrame, picture: Path) -> None:
    words = ("--fov", "12", "--fov-error", "0.1", "--centroid", method)
    done = command("solve", picture, *words, "--json")
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert facts["centroid_method"] == method
    assert angle_between(np.array(facts["quaternion"]), resting.attitude) < np.radians(20.0 / 3600.0)
    places = np.array([star["point_px"] for star in facts["stars"]])
    # The centroids of two methods differ slightly, which shows that the option has an effect.
    other = "psf" if method != "psf" else "window"
    again = command("solve", picture, *words[:-1], other, "--json")
    others = np.array([star["point_px"] for star in json.loads(again.stdout)["stars"]])
    nearest = np.linalg.norm(places[:, None] - others, axis=2).min(axis=1)
    assert 1e-4 < np.median(nearest) < 0.2


def test_a_classical_method_finds_the_same_place(picture: Path) -> None:
    default = json.loads(command("solve", picture, "--fov", "12", "--json").stdout)
    done = command("solve", picture, "--fov", "12", "--fov-error", "0.1", "--method", "pyramid", "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)["quaternion"]
    assert angle_between(np.array(found), np.array(default["quaternion"])) < np.radians(5.0 / 3600.0)
    unknown = command("solve", picture, "--method", "pyramid")
    assert unknown.returncode != 0
    assert "Traceback" not in unknown.stderr


def test_bare_pixels_behind_a_header_are_read(resting: SkyFrame, tmp_path: Path) -> None:
    path = tmp_path / "frame.raw"
    path.write_bytes(b"a header of some bytes" + resting.pixels.astype("<u2").tobytes())
    done = command("solve", path, "--raw", "1024x1024x16+22", "--fov", "12", "--json")
    assert json.loads(done.stdout)["status"] == "solved"


@pytest.mark.parametrize(
    ("shape", "complaint"),
    [
        (
            "100x100x8",
            "has 12000 bytes, but 100 x 100 pixels of 8 bits need 10000; if the file has a header of 2000",
        ),
        (
            "100x100x8+500",
            "need 10000 after a header of 500; if the file has a header of 2000, state it: 100x100x8+",
        ),
        ("100x100x16", "has 12000 bytes, but 100 x 100 pixels of 16 bits need 20000\n"),
    ],
)
def test_bare_pixels_of_another_size_are_refused(tmp_path: Path, shape: str, complaint: str) -> None:
    path = tmp_path / "frame.raw"
    path.write_bytes(bytes(12_000))
    done = command("solve", path, "--raw", shape, "--fov", "12")
    assert done.returncode == 2
    assert complaint in done.stderr


def test_the_overlay_shows_the_stars_and_the_text_lists_them(picture: Path, tmp_path: Path) -> None:
    overlay = tmp_path / "solved.png"
    done = command("solve", picture, "--fov", "12", "--overlay", overlay)
    assert done.returncode == 0, done.stderr
    assert "right ascension" in done.stdout
    drawn = np.asarray(pillow.open(overlay))
    coloured = np.count_nonzero(np.ptp(drawn[..., :3].astype(int), axis=-1) > 50)
    assert coloured > 1000


def test_a_picture_without_stars_is_not_solved_and_the_reason_is_stated(tmp_path: Path) -> None:
    noise = np.random.default_rng(33).normal(100.0, 10.0, (256, 256)).astype(np.uint16)
    path = tmp_path / "noise.png"
    pillow.fromarray(noise).save(path, compress_level=1)
    done = command("solve", path, "--json")
    assert done.returncode == 1
    facts = json.loads(done.stdout)
    assert facts["status"] in {"no-stars", "too-few-stars"}
    assert facts["reason"]


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--fov", "200"], "1 to 120 degrees"),
        (["--date", "yesterday"], "such as 2026-03-01"),
        (["--date", "1700-01-01"], "--date 1700-01-01: give the time of the picture, from 1900 to 2099"),
        (["--fov", "wide"], "is not a number"),
        (["--raw", "1024x1024"], "such as 1280x960x16"),
        (["--raw", "9000x9000x16"], "pixels of 16 bits need 162000000"),
        (["--index", "{tmp}/none.index"], "the sky index cannot be read"),
    ],
)
def test_a_mistake_is_one_line_and_exit_status_2(
    words: list[str], complaint: str, picture: Path, tmp_path: Path
) -> None:
    done = command("solve", picture, *(word.replace("{tmp}", str(tmp_path)) for word in words))
    assert done.returncode == 2
    assert complaint in done.stderr
    assert "Traceback" not in done.stderr


def test_the_world_coordinates_put_the_stars_where_the_picture_has_them(
    picture: Path, tmp_path: Path
) -> None:
    """The world coordinates in the file agree with the star positions.

    The test computes the tangent plane by Calabretta & Greisen 2002, and SIP by Shupe 2005.
    """
    out = tmp_path / "frame.wcs"
    done = command("solve", picture, "--fov", "12", "--wcs", out, "--json")
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    wcs = facts["wcs"]
    text = out.read_bytes().decode("ascii")
    assert len(text) % 2880 == 0
    cards = {text[k : k + 8].strip(): text[k + 10 : k + 80].strip() for k in range(0, len(text), 80)}
    assert {key: float(cards[key]) for key in wcs if isinstance(wcs[key], float)} == pytest.approx(
        wcs_numbers(wcs)
    )
    crval = np.radians([wcs["CRVAL1"], wcs["CRVAL2"]])
    for name in ("image_centre", "axis"):
        place = facts[name]
        x, y = np.array(place["point_px"]) + 1.0 - (wcs["CRPIX1"], wcs["CRPIX2"])
        assert _sky_of(wcs, x, y, crval) == pytest.approx(
            (place["right_ascension_deg"], place["declination_deg"]), abs=1e-6
        )
    # The conversion from pixel to sky (forward polynomials) and the conversion back (inverse polynomials)
    # agree out to the corners.
    x, y = 400.0, -350.0
    u, v = x + _polynomial(wcs, "A", x, y), y + _polynomial(wcs, "B", x, y)
    assert (u + _polynomial(wcs, "AP", u, v), v + _polynomial(wcs, "BP", u, v)) == pytest.approx(
        (x, y), abs=0.01
    )


def wcs_numbers(wcs: dict[str, object]) -> dict[str, float]:
    return {key: value for key, value in wcs.items() if isinstance(value, float)}


def _polynomial(wcs: dict[str, float], name: str, x: float, y: float) -> float:
    order = int(wcs[f"{name}_ORDER"])
    return sum(
        wcs.get(f"{name}_{i}_{j}", 0.0) * x**i * y**j for i in range(order + 1) for j in range(order + 1 - i)
    )


def _sky_of(wcs: dict[str, float], x: float, y: float, crval: np.ndarray) -> tuple[float, float]:
    u, v = x + _polynomial(wcs, "A", x, y), y + _polynomial(wcs, "B", x, y)
    xi = math.radians(wcs["CD1_1"] * u + wcs["CD1_2"] * v)
    eta = math.radians(wcs["CD2_1"] * u + wcs["CD2_2"] * v)
    ra0, dec0 = crval
    below = math.cos(dec0) - eta * math.sin(dec0)
    ra = ra0 + math.atan2(xi, below)
    dec = math.atan2(math.sin(dec0) + eta * math.cos(dec0), math.hypot(xi, below))
    return math.degrees(ra) % 360.0, math.degrees(dec)
