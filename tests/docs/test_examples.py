"""Tests that the examples of the pages "Extending" run, and change only the files that the pages name."""

from __future__ import annotations

import contextlib
import io
import math
import os
import re
import runpy
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from knightcube.vision.startracker.sky_map import Pointing
from tests.docs.blocks import ROOT
from tests.knightcube.vision.startracker.frames import sky_frame
from tests.support.fits_files import fits_file

EXAMPLES = ROOT / "docs" / "examples"


def run(words: list[str], tree: Path, status: int = 0) -> subprocess.CompletedProcess[str]:
    """Run Python code with the packages in a folder."""
    environment = {**os.environ, "PYTHONPATH": str(tree)}
    words = [sys.executable, *words]
    done = subprocess.run(
        words, cwd=tree, env=environment, capture_output=True, text=True, timeout=110, check=False
    )
    assert done.returncode == status, done.stderr
    return done


def patched(name: str, folder: Path) -> Path:
    """Return a copy of the packages with `name`.diff applied, and the bytecode of all unchanged modules."""
    for package in ("knightcube", "flight", "hal", "sim_hal", "ground", "config"):
        shutil.copytree(ROOT / package, folder / package)
    words = ["git", "apply", "-C1", "--unidiff-zero", str(EXAMPLES / f"{name}.diff")]
    environment = {**os.environ, "GIT_CEILING_DIRECTORIES": str(folder.parent)}
    done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"docs/examples/{name}.diff no longer fits the tree:\n{done.stderr}"
    return folder


def files_of(name: str) -> list[str]:
    """Return the files that a diff file changes."""
    return re.findall(
        r"^\+\+\+ b/(.+)$", (EXAMPLES / f"{name}.diff").read_text(encoding="utf-8"), re.MULTILINE
    )


@cache
def printed_by(script: str, *arguments: str) -> str:
    """Return the output of an example that changes no package.

    The example runs in this process, to avoid repeated imports.
    """
    output = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(output):
        patch.chdir(ROOT)
        patch.setattr(sys, "argv", [f"{script}.py", *arguments])
        runpy.run_path(str(EXAMPLES / f"{script}.py"), run_name="__main__")
    return output.getvalue()


@pytest.mark.parametrize(("name", "most"), [("command", 3), ("packet", 1), ("field", 2), ("config_key", 2)])
def test_an_extension_changes_few_files(name: str, most: int) -> None:
    assert 1 <= len(files_of(name)) <= most


def test_the_star_tracker_solves_the_image_of_its_example() -> None:
    """The star Alnilam (HIP 26311, V 1.69) is near the centre of the field that the script renders."""
    printed = printed_by("star_tracker").splitlines()
    assert printed[0] == "right ascension  84.050 deg"
    assert printed[1] == "declination      -1.200 deg"
    assert "HIP 26311        V 1.69 at pixel 511" in printed[6]


def test_own_pictures_of_any_kind_are_solved_or_refused_with_a_reason(tmp_path: Path) -> None:
    """The command is given the same stars in four file formats, an image without stars, and a text file."""
    pillow = pytest.importorskip("PIL.Image", reason="needs Pillow, the extra `images`")
    frame = sky_frame(np.random.default_rng(31), 0.0, 0.2)
    bright = (frame.pixels / frame.pixels.max() * 255.0).astype(np.uint8)
    pillow.fromarray(frame.pixels).save(tmp_path / "grey.png", compress_level=1)
    pillow.fromarray(np.repeat(bright[..., None], 3, axis=2)).save(tmp_path / "colour.png", compress_level=1)
    pillow.fromarray(bright[:, ::-1]).save(tmp_path / "mirrored.tif")
    (tmp_path / "stars.fits").write_bytes(fits_file(frame.pixels.astype(">i4"), 32))
    pillow.fromarray(np.zeros((64, 64), dtype=np.uint8)).save(tmp_path / "dark.jpg")
    (tmp_path / "notes.txt").write_text("not a picture")
    names = ("grey.png", "colour.png", "mirrored.tif", "stars.fits", "dark.jpg", "notes.txt")
    printed = printed_by("own_pictures", *(str(tmp_path / name) for name in names))
    lines = [line.removeprefix(f"{tmp_path}/") for line in printed.splitlines()]
    sky = Pointing.of(frame.attitude)
    for name, line in zip(names[:4], lines, strict=False):
        ascension, declination = (float(word) for word in line.split()[1:3])
        assert line.startswith(f"{name}: ")
        assert ascension == pytest.approx(math.degrees(sky.right_ascension), abs=0.03)
        assert declination == pytest.approx(math.degrees(sky.declination), abs=0.01)
        assert line.endswith(", mirrored") == (name == "mirrored.tif")
    assert lines[4].startswith("dark.jpg: no-stars: ")
    assert lines[5].startswith("notes.txt: is not a PNG, TIFF, JPEG, BMP, PGM or FITS image")


def test_the_step_of_its_example_is_optimal_within_its_horizon() -> None:
    printed = printed_by("step").splitlines()
    assert printed[0] == "status   optimal"
    assert printed[1] == "horizon  15.00 s"
    assert len(printed) == 8


def test_the_slew_of_its_example_keeps_off_the_moon() -> None:
    printed = printed_by("slew").splitlines()
    assert printed[0] == "status        optimal"
    assert "deg outside its cone" in printed[5]
    assert float(printed[5].split()[1]) >= 0.0


@pytest.mark.parametrize("name", ["command", "packet"])
def test_an_extension_without_its_change_names_the_change(name: str) -> None:
    done = run([str(EXAMPLES / f"{name}.py")], ROOT, status=1)
    assert done.stderr == f"apply the change of the page first: git apply docs/examples/{name}.diff\n"


@pytest.mark.slow
def test_a_new_command_is_obeyed_and_logged(tmp_path: Path) -> None:
    printed = run([str(EXAMPLES / "command.py")], patched("command", tmp_path / "tree")).stdout.splitlines()
    assert printed[0] == "answer: executed - note lamp on"
    assert printed[1].endswith("commanded socket: note lamp on")


def test_a_new_packet_is_recorded_read_exported_and_documented(tmp_path: Path) -> None:
    printed = run([str(EXAMPLES / "packet.py")], patched("packet", tmp_path / "tree")).stdout
    assert "read:   [21.5, 19.0, 20.25, 20.5, 22.0, 18.75]" in printed
    assert "export: 0.0,21.5,19.0,20.25" in printed
    assert "fields: thermal,celsius_1,degree C,panels" in printed
    assert "| 15 | celsius | f4 x 6 | degree C |" in printed


@pytest.mark.slow
def test_a_new_field_is_flown_and_exported(tmp_path: Path) -> None:
    tree = patched("field", tmp_path / "tree")
    commands = (
        ["run", "config/step_demo.yaml", "--duration", "1", "--out", "out"],
        ["export", "out", "--out", "csv"],
    )
    run(["-c", f"from flight.app.cli import main\nfor words in {commands}:\n  assert main(words) == 0"], tree)
    names = (tree / "csv" / "housekeeping.csv").read_text(encoding="utf-8").splitlines()[0]
    assert names.endswith("records_lost,braked_1,braked_2,braked_3")


@pytest.mark.slow
def test_a_new_configuration_key_is_flown_and_checked(tmp_path: Path) -> None:
    tree = patched("config_key", tmp_path / "tree")
    text = (tree / "config" / "step_demo.yaml").read_text(encoding="utf-8")
    for value, status in ((3.0, 0), (-1.0, 2)):
        changed = text.replace("  strategy: goal", f"  least_horizon: {value}\n  strategy: goal")
        (tree / "changed.yaml").write_text(changed, encoding="utf-8")
        words = ["-m", "flight", "run", "changed.yaml", "--duration", "1", "--out", f"run{status}"]
        done = run(words, tree, status)
        assert status == 0 or "least_horizon" in done.stderr


@pytest.mark.slow
def test_a_body_of_its_own_module_flies_to_the_attitude_that_its_law_gives() -> None:
    """Under PD control, the suspension thread's torsion deflects the body by the angle k theta / (J w^2)."""
    printed = printed_by("pointing_body")
    found = re.search(r"pointing error ([\d.]+) deg", printed)
    assert found is not None
    theta = 2.0 * math.asin(0.3)
    assert float(found[1]) == pytest.approx(math.degrees(1e-5 * theta / (1.05e-3 * 0.6**2)), abs=0.1)


NUMBER = re.compile(r"[+-]?\d+\.?\d*")


@pytest.mark.parametrize(
    ("page", "script"),
    [
        ("filters-and-controllers", "filters_and_controllers"),
        ("horizon-and-sun", "horizon_and_sun"),
        ("lens", "lens"),
        ("orbit", "orbit_and_field"),
        ("streaks", "streak_rate"),
    ],
)
def test_an_example_of_the_library_prints_what_its_page_shows(page: str, script: str) -> None:
    """The words of the output equal those on the page. Numbers agree within two units of their last digit."""
    printed = printed_by(script).rstrip()
    text = (ROOT / "docs" / "library" / f"{page}.md").read_text(encoding="utf-8")
    shown = text.partition("It prints:\n\n```\n")[2].partition("\n```")[0]
    assert NUMBER.sub("#", printed).split() == NUMBER.sub("#", shown).split()
    for found, stated in zip(NUMBER.findall(printed), NUMBER.findall(shown), strict=True):
        unit = 10.0 ** -len(stated.partition(".")[2])
        assert abs(float(found) - float(stated)) < 2.5 * unit, (found, stated)


def test_the_examples_find_what_they_have_drawn() -> None:
    """The estimates that the examples print agree with the true values of the drawn images."""
    streaks = printed_by("streak_rate")
    rate, true = (np.array(text.split(), dtype=float) for text in re.findall(r"\[([^\]]+)\]", streaks)[:2])
    sigma = np.array(re.findall(r"1 sigma +\[([^\]]+)\]", streaks)[0].split(), dtype=float)
    assert np.all(np.abs(rate - true) < 4.0 * sigma)
    assert np.all(sigma < 0.02 * np.linalg.norm(true))
    assert streaks.count("object ") == 1
    lens = printed_by("lens")
    focal_length, error = map(float, re.findall(r"focal length +([\d.]+) \+- ([\d.]+) px", lens)[0])
    assert abs(focal_length - 2250.0) < max(4.0 * error, 0.05)
    k1, error = map(float, re.findall(r"k1 +(\S+) \+- (\S+)", lens)[0])
    assert abs(k1 + 0.41) < 4.0 * error + 1e-4
