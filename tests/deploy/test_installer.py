"""Tests of the installer: into an image, without root and systemd, and as a dry run."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.specifiers import SpecifierSet

from knightcube.vision.startracker.index import build
from sim_hal.faults.host import corrupted
from tests.deploy.boards import FakeBoard
from tests.deploy.scripts import DEPLOY, ROOT, TESTBED, changed_testbed, script
from tests.support.flights import CONFIG

pytestmark = pytest.mark.skipif(
    shutil.which("systemctl") is None, reason="systemctl is missing: install systemd"
)


def call(*words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["sh", str(DEPLOY / "install.sh"), *words],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )


class Image:
    """Files of a board, in an image that is not running."""

    def __init__(self, root: Path, environment: Path | None = None) -> None:
        self.root = root
        self.environment = environment or root.parent / "environment"
        self.config = self.root / "etc/knightcube/flight.yaml"
        self.sum = self.root / "etc/knightcube/flight.yaml.sha256"
        self.rules = self.root / "etc/udev/rules.d/99-knightcube.rules"

    def call(self, *words: str) -> tuple[int, str]:
        done = call(*words, DESTDIR=str(self.root))
        return done.returncode, done.stdout + done.stderr

    def install(self, *words: str) -> tuple[int, str]:
        """Install from this folder, without making a new virtual environment."""
        python = self.environment / "bin" / "python"
        if not python.exists():
            python.parent.mkdir(parents=True)
            python.write_text(f'#!/bin/sh\nPYTHONPATH={ROOT} exec {sys.executable} "$@"\n', encoding="utf-8")
            python.chmod(0o755)
        return self.call("--venv", str(python.parents[1]), *words)

    def text(self, name: str) -> str:
        return (self.root / name).read_text(encoding="utf-8")

    def files(self) -> dict[Path, float]:
        return {path: path.lstat().st_mtime for path in self.root.rglob("*") if not path.is_dir()}


def test_the_services_can_read_what_root_installs_with_any_umask(tmp_path: Path) -> None:
    """The services run as other users, and root often has the umask 077."""
    board = FakeBoard(tmp_path / "root")
    board.root.mkdir()
    board.python("new")  # the interpreter of the machine can be read by all users
    before = os.umask(0o077)
    try:
        board.install("new")
    finally:
        os.umask(before)
    hidden = [
        str(path)
        for folder in (board.prefix, board.root / "etc")
        for path in [folder, *folder.rglob("*")]
        if not path.is_symlink() and not path.stat().st_mode & 0o004
    ]
    assert hidden == []


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Image:
    image = Image(tmp_path_factory.mktemp("installed") / "image")
    status, output = image.install("--config", str(TESTBED))
    assert status == 0, output
    return image


@pytest.fixture
def image(installed: Image, tmp_path: Path) -> Image:
    """Return a copy of an image with the testbed's configuration installed."""
    shutil.copytree(installed.root, tmp_path / "image", symlinks=True)
    return Image(tmp_path / "image", installed.environment)


def test_a_second_installation_changes_no_file_and_an_uninstallation_removes_them(image: Image) -> None:
    assert image.text("etc/modules-load.d/knightcube.conf").splitlines()[-1] == "i2c-dev"
    assert "\nRuntimeWatchdogSec=10\n" in image.text("etc/systemd/system.conf.d/knightcube.conf")
    assert image.config.read_bytes() == TESTBED.read_bytes()
    assert "DeviceAllow=/dev/i2c-1 rw\n" in image.text(
        "etc/systemd/system/knightcube-safe.service.d/board.conf"
    )
    assert (image.root / "etc/systemd/system/multi-user.target.wants/knightcube.service").is_symlink()
    before = image.files()
    assert image.install("--config", str(TESTBED))[0] == 0
    assert image.files() == before
    # An update may write the settings of the link's unit although the unit itself is not installed.
    settings = image.root / "etc/systemd/system/knightcube-link.service.d"
    settings.mkdir()
    (settings / "board.conf").touch()
    assert image.call("--uninstall")[0] == 0
    assert sorted(path.name for path in image.files()) == ["flight.yaml", "flight.yaml.sha256"]
    assert image.call("--uninstall", "--purge")[0] == 0
    assert not image.files()
    assert not list(image.root.rglob("knightcube*"))


def test_a_release_is_built_again_for_changed_sources_but_not_for_caches(tmp_path: Path) -> None:
    source, prefix, venv = (tmp_path / name for name in ("source", "prefix", "venv"))
    for folder in ("deploy", "knightcube/__pycache__", "knightcube/build"):
        (source / folder).mkdir(parents=True)
    (venv / "bin").mkdir(parents=True)
    (venv / "bin/python").symlink_to("/bin/true")
    for name in ("build_release.py", "releases.py", "requirements.lock"):
        shutil.copy(DEPLOY / name, source / "deploy")
    (source / "pyproject.toml").write_text('version = "1.0"\n', encoding="utf-8")
    (source / "knightcube/one.py").touch()

    def build() -> str:
        script = [sys.executable, "-B", str(source / "deploy/build_release.py"), str(prefix)]
        words = [*script, "build", "--venv", str(venv)]
        name = subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip()
        subprocess.run([*script, "switch", name], check=True)
        return name

    assert build() == "1.0+1"
    for name in ("__pycache__/one.f-1.py311.nbi", "__pycache__/one.pyc", "build/one.py"):
        (source / "knightcube" / name).write_text("x", encoding="utf-8")
    assert build() == "1.0+1"
    (source / "knightcube/one.py").write_text("x", encoding="utf-8")
    assert build() == "1.0+2"
    # A release that failed its trial is removed later. A new release must not have its name.
    (prefix / "current").unlink()
    (prefix / "current").symlink_to("releases/1.0+1")
    shutil.rmtree(prefix / "releases/1.0+2")
    (source / "knightcube/one.py").write_text("y", encoding="utf-8")
    assert build() == "1.0+3"


def test_the_checksum_is_one_that_sha256sum_checks(image: Image) -> None:
    assert image.sum.read_text(encoding="ascii") == (
        f"{hashlib.sha256(TESTBED.read_bytes()).hexdigest()}  flight.yaml\n"
    )
    words = ["sha256sum", "--check", "--strict", image.sum.name]
    assert subprocess.run(words, cwd=image.sum.parent, capture_output=True, check=False).returncode == 0


def test_only_the_option_accept_accepts_a_changed_configuration(image: Image, tmp_path: Path) -> None:
    image.config.write_text(corrupted(TESTBED.read_text(encoding="utf-8"), 1, 7), encoding="utf-8")
    status, output = image.install()
    assert status == 2
    assert "is not the accepted configuration: if you edited it, run install.sh --accept" in output
    shutil.copy(changed_testbed(tmp_path, coils_bus="/dev/knightcube-i2c"), image.config)
    status, output = image.call("--accept")
    assert (status, output.startswith("accepted")) == (0, True), output
    assert hashlib.sha256(image.config.read_bytes()).hexdigest() in image.sum.read_text(encoding="ascii")
    assert "/dev/knightcube-i2c" in image.text("etc/systemd/system/knightcube.service.d/board.conf")
    assert image.install()[0] == 0


def test_an_invalid_configuration_is_not_accepted(image: Image) -> None:
    accepted = image.sum.read_bytes()
    image.config.write_text("name: [", encoding="utf-8")
    status, output = image.call("--accept")
    assert status == 2
    assert "Traceback" not in output
    assert image.sum.read_bytes() == accepted


def test_a_configuration_other_than_the_installed_one_is_refused(image: Image) -> None:
    status, output = image.install("--config", str(CONFIG))
    assert status == 2
    assert f"another configuration is installed: remove it first: rm {image.config}" in output
    assert image.config.read_bytes() == TESTBED.read_bytes()


def test_device_names_that_were_edited_survive_an_update(image: Image) -> None:
    shipped = image.rules.read_text(encoding="utf-8")
    mine = shipped.replace("Synopsys DesignWare I2C adapter", "CP2112 SMBus Bridge")
    image.rules.write_text(mine, encoding="utf-8")
    assert image.install()[0] == 0
    assert image.rules.read_text(encoding="utf-8") == mine
    # If the udev rules of an update are new, unedited rules are replaced. Edited rules are kept and reported.
    copy = image.root / "opt/knightcube/share/99-knightcube.rules"
    copy.write_text(shipped + "# of yesterday\n", encoding="utf-8")
    status, output = image.install()
    assert (status, "was edited and is kept" in output) == (0, True)
    assert image.rules.read_text(encoding="utf-8") == mine
    for path in (image.rules, copy):
        path.write_text(shipped + "# of yesterday\n", encoding="utf-8")
    assert image.install()[0] == 0
    assert image.rules.read_text(encoding="utf-8") == shipped


@pytest.mark.parametrize(
    ("camera", "wanted"),
    [
        ("{device: {driver: v4l2, pixel_format: Y16}}", False),
        ("{device: {driver: v4l2, pixel_format: Y16}, star_tracker: {}}", True),
    ],
)
def test_the_sky_index_is_built_if_the_configuration_has_a_star_tracker(
    image: Image, tmp_path: Path, camera: str, wanted: bool
) -> None:
    shutil.copy(changed_testbed(tmp_path, camera=camera), image.config)
    _, output = image.call("--accept", "--dry-run")
    assert ("sky_index.py" in output) == wanted


def test_the_sky_index_is_built_if_it_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program, built = script("sky_index"), tmp_path / "index"
    monkeypatch.setattr(build, "PATH", built)
    monkeypatch.setattr(build, "ensure_default_index", lambda: built.write_bytes(b"index"))
    camera = "{device: {driver: v4l2, pixel_format: Y16}, star_tracker: {}}"
    program.main([str(changed_testbed(tmp_path, camera=camera))])
    assert built.read_bytes() == b"index"
    built.write_bytes(b"older")
    program.main([str(tmp_path / "flight.yaml")])
    assert built.read_bytes() == b"older"


def test_a_dry_run_prints_every_step_and_touches_nothing() -> None:
    before = sorted(Path("/etc/systemd/system").iterdir())
    output = call("--dry-run", "--config", str(TESTBED)).stdout
    for step in (
        "useradd",
        "venv",
        "--require-hashes",
        "--no-build-isolation",
        "coils-off",
        "flight.yaml and its checksum",
        "knightcube.service",
        "99-knight",
        "modules-load.d",
    ):
        assert step in output
    assert sorted(Path("/etc/systemd/system").iterdir()) == before
    assert not Path("/opt/knightcube").exists()


def _pins(path: Path) -> dict[str, str]:
    """Return the versions in a lock file, by the normalised names of the packages."""
    found = re.findall(r"^([\w.-]+)==([^\s\\]+)", path.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[-_.]+", "-", name).lower(): version for name, version in found}


LOCKS = [DEPLOY / "requirements.lock", ROOT / "requirements.lock", ROOT / "requirements-test.lock"]


@pytest.mark.parametrize("lock", LOCKS, ids=["board", "demo", "test"])
def test_a_lock_has_all_requirements_each_with_hashes(lock: Path) -> None:
    needed = set()
    for path in (ROOT / "pyproject.toml", ROOT / "knightcube" / "pyproject.toml"):
        text = tomllib.loads(path.read_text(encoding="utf-8"))
        needed |= {*text["project"]["dependencies"], *text["build-system"]["requires"]}
    extras = tomllib.loads((ROOT / "knightcube" / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    flown = {name: lines for name, lines in extras["optional-dependencies"].items() if name != "fast"}
    needed |= {line for lines in flown.values() for line in lines}
    names = {re.sub(r"[-_.]+", "-", re.split(r"[<>=~!\[]", line)[0]).lower() for line in needed} - {
        "knightcube"
    }
    assert names <= _pins(lock).keys(), "run `make lock`"
    blocks = re.split(r"^(?=\S)", lock.read_text(encoding="utf-8"), flags=re.M)
    assert all("--hash=sha256:" in block for block in blocks if "==" in block)


def test_the_locked_packages_can_be_installed_with_each_supported_python() -> None:
    for name, version in _pins(ROOT / "requirements-test.lock").items():
        assert metadata.version(name) == version
        fields = metadata.metadata(name)
        supported = SpecifierSet(",".join(fields.get_all("Requires-Python") or []))
        for python in ("3.11.0", "3.11.2", "3.12.0", "3.13.0"):  # the second one is that of Debian 12
            assert python in supported, f"{name} {version}"


def test_board_and_demonstration_have_the_versions_that_the_tests_have() -> None:
    board, demo, tested = (_pins(lock) for lock in LOCKS)
    assert board.items() <= demo.items() <= tested.items()


@pytest.mark.parametrize(
    ("words", "output"),
    [
        (["--frobnicate"], "unknown option"),
        (["--config"], "needs a value"),
        (["--config", "--wheels"], "--config needs a value"),
        (["--dry-run", "--config", "/no"], "--config /no: cannot be read"),
        (["--dry-run", "--wheels", "/no"], "--wheels /no: no such folder"),
        (["--dry-run", "--venv", "/no"], "--venv /no: no virtual environment"),
        (["--dry-run", "--venv", "/no", "--wheels", "/tmp"], "one of them"),
        (["--dry-run", "--python", "/no"], "--python /no: Python 3.11 or newer is needed"),
        (["--dry-run", "--purge"], "--purge needs --uninstall"),
        (["--dry-run", "--accept", "--config", str(TESTBED)], "--accept: omit --config, --wheels and --venv"),
        (["--dry-run", "--accept"], "there is no"),
        (["--dry-run", "--rollback"], "there is no previous release"),
    ],
)
def test_wrong_use_of_the_installer_is_refused_before_the_first_step_with_status_2(
    words: list[str], output: str
) -> None:
    done = call(*words)
    assert done.returncode == 2
    assert output in done.stderr
    assert not done.stdout, "nothing was done, or would have been"
