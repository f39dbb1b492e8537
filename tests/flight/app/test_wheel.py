"""The wheel is complete: installed elsewhere it flies its carried configuration and reports on the run."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

from flight.schema.carried import FOLDER, config_path, names

ROOT = Path(__file__).resolve().parents[3]


def test_a_bare_name_is_a_carried_configuration_and_a_path_stays_a_path() -> None:
    assert config_path("step_demo").samefile(ROOT / "config" / "step_demo.yaml")
    for path in ("step_demo.yaml", "./step_demo", "config/step_demo", "unknown", "", ".", "/"):
        assert config_path(path) == Path(path)


def test_the_repository_s_folder_is_the_one_source_of_the_carried_configurations() -> None:
    assert FOLDER.resolve() == ROOT / "config"
    assert names() == sorted(path.stem for path in (ROOT / "config").glob("*.yaml"))


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a virtual environment of the wheel alone; other packages are those of this environment."""
    place = tmp_path_factory.mktemp("wheel")
    for name in ("knightcube", "flight", "ground", "hal", "sim_hal", "config"):
        leave = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / name, place / "source" / name, symlinks=True, ignore=leave)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, place / "source")
    pip: list[str | Path] = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    without = ["--no-deps", "--no-index"]
    build: list[str | Path] = [
        "wheel",
        *without,
        "--no-build-isolation",
        "--wheel-dir",
        place,
        place / "source",
    ]
    subprocess.run([*pip, *build], check=True, timeout=60)
    (wheel,) = place.glob("*.whl")
    home = place / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", home], check=True, timeout=30)
    python = home / "bin" / "python"
    subprocess.run([*pip, "--python", python, "install", *without, wheel], check=True, timeout=60)
    # A .pth in a folder that a .pth adds is not read: an editable installation stays out.
    (site,) = home.glob("lib/python*/site-packages")
    (site / "others.pth").write_text(sysconfig.get_path("purelib") + "\n", encoding="utf-8")
    return home


def _type(environment: Path, folder: Path, *words: str) -> str:
    """Type a command in a folder; return its output."""
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
    script = "from flight.schema.carried import FOLDER as f; print(*sorted(p.name for p in f.glob('*/*')))"
    carried = _type(environment, tmp_path, "python", "-c", script).split()
    assert carried == sorted(path.name for path in (ROOT / "config" / "sensors").iterdir())
