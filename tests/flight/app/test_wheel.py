"""Tests that installed wheels run a configuration and a report, and that the library's wheel works alone."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import tomllib
from pathlib import Path

import pytest

import flight
from flight.schema.document import FOLDER, config_path, names

ROOT = Path(__file__).resolve().parents[3]


def test_a_bare_name_is_a_packaged_configuration_and_a_path_stays_a_path() -> None:
    assert config_path("step_demo").samefile(ROOT / "config" / "step_demo.yaml")
    for path in ("step_demo.yaml", "./step_demo", "config/step_demo", "unknown", "", ".", "/"):
        assert config_path(path) == Path(path)


def test_the_folder_of_the_repository_is_the_only_source_of_packaged_configurations() -> None:
    assert FOLDER.resolve() == ROOT / "config"
    assert names() == sorted(path.stem for path in (ROOT / "config").glob("*.yaml"))


PIP: list[str | Path] = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
ALONE = ["--no-deps", "--no-index"]


@pytest.fixture(scope="module")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the wheels of both distributions, built from a copy of the sources."""
    folder = tmp_path_factory.mktemp("wheels")
    source = folder / "source"
    for name in ("knightcube", "flight", "ground", "hal", "sim_hal", "config"):
        leave = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / name, source / name, symlinks=True, ignore=leave)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    build: list[str | Path] = [
        "wheel",
        *ALONE,
        "--no-build-isolation",
        "--wheel-dir",
        folder,
        source / "knightcube",
        source,
    ]
    subprocess.run([*PIP, *build], check=True, timeout=60)
    return folder


def _installed(home: Path, wheels: list[Path], packages: Path) -> Path:
    """Return a new virtual environment with the given wheels and the packages of a folder."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", home], check=True, timeout=30)
    python = home / "bin" / "python"
    install = [*PIP, "--python", python, "install", "--no-compile", *ALONE, *wheels]
    subprocess.run(install, check=True, timeout=60)
    # Python ignores .pth files in a folder that a .pth file has added, so no editable installation is found.
    (site,) = home.glob("lib/python*/site-packages")
    (site / "others.pth").write_text(f"{packages}\n", encoding="utf-8")
    return home


@pytest.fixture(scope="module")
def environment(wheels: Path) -> Path:
    """Return a virtual environment of both wheels and the other packages of the test environment."""
    return _installed(wheels / "venv", sorted(wheels.glob("*.whl")), Path(sysconfig.get_path("purelib")))


def _type(environment: Path, folder: Path, *words: str) -> str:
    """Run a command line in a folder, and return its output."""
    clean = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    program = environment / "bin" / words[0]
    done = subprocess.run(
        [program, *words[1:]], cwd=folder, env=clean, capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_the_installed_wheel_flies_the_demonstration_from_any_folder(
    environment: Path, tmp_path: Path
) -> None:
    script = "import flight, sim_hal, ground; print(flight.__file__, sim_hal.__file__, ground.__file__)"
    for path in _type(environment, tmp_path, "python", "-c", script).split():
        assert Path(path).is_relative_to(environment)
    flown = _type(environment, tmp_path, "knightcube", "run", "step_demo", "--duration", "2", "--out", "demo")
    assert "next:     knightcube report demo" in flown
    text = (ROOT / "config" / "step_demo.yaml").read_text(encoding="utf-8")
    assert (tmp_path / "demo" / "config.yaml").read_text(encoding="utf-8") == text
    assert "q2" in _type(environment, tmp_path, "knightcube", "report", "demo", "--no-figures")
    assert "energy:" in _type(environment, tmp_path, "knightcube", "plan", "--from", "0.1", "--to", "0")


def test_the_installed_wheel_carries_the_sensor_suites(environment: Path, tmp_path: Path) -> None:
    script = "from flight.schema.document import FOLDER as f; print(*sorted(p.name for p in f.glob('*/*')))"
    carried = _type(environment, tmp_path, "python", "-c", script).split()
    assert carried == sorted(path.name for path in (ROOT / "config" / "sensors").iterdir())


def test_the_library_alone_needs_numpy_and_scipy_only(wheels: Path, tmp_path: Path) -> None:
    packages = tmp_path / "packages"
    packages.mkdir()
    for path in Path(sysconfig.get_path("purelib")).iterdir():
        if path.name.partition(".")[0] in {"numpy", "scipy"}:
            (packages / path.name).symlink_to(path)
    (library,) = wheels.glob("knightcube-*.whl")
    home = _installed(tmp_path / "venv", [library], packages)
    script = """
import numpy as np
from knightcube import StarTracker
print(StarTracker(fov_deg=11.4).solve(np.zeros((480, 640))).reason)
try:
    from knightcube import plan_step
except ImportError as error:
    print(error)
try:
    import flight
except ImportError as error:
    print(error)
"""
    reason, extra, application = _type(home, tmp_path, "python", "-c", script).splitlines()
    assert reason == "all pixels of the frame are equal"
    assert "pip install 'knightcube[vmc]'" in extra
    assert application == "No module named 'flight'"


def test_both_distributions_have_one_version() -> None:
    library, application = (
        tomllib.loads((ROOT / path).read_text(encoding="utf-8"))["project"]
        for path in ("knightcube/pyproject.toml", "pyproject.toml")
    )
    assert library["version"] == application["version"] == flight.__version__
    (requirement,) = (text for text in application["dependencies"] if text.startswith("knightcube"))
    flown = [extra for extra in library["optional-dependencies"] if extra != "fast"]
    assert requirement == f"knightcube[{','.join(flown)}]=={library['version']}"
