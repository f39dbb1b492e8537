"""Boots a systemd-nspawn container on an overlay of the machine's files, to test the service.

`boot` runs `python -m tests.deploy.container FOLDER SCENARIO` in a separate mount namespace, so that the
mounts are not visible to other programs, and end with the program. The program installs the service by
`deploy/install.sh` and boots the container. In the container, the unit `scenario` runs the module SCENARIO.
The module writes its observations into FOLDER; then the container is shut down.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from knightcube.vision.startracker.index import PATH
from tests.hal.guardian.live_flight import ROOT, write_config

LIMIT_S = 1500.0
"""Timeout (s) of a scenario in the container on a busy machine."""
SERVICES, RENEWALS = "tests.deploy.scenario", "tests.deploy.renewal_scenario"
"""Modules of the two scenarios: faults of the services, and updates by the ground over the link."""
_SHARE = "/share"
_UNITS = "etc/systemd/system"
_FACTS = "/run/knightcube-devices/facts.json"
COMMANDS = "/run/knightcube/commands"
"""Path of the socket on which the service receives commands."""
LINK, KEYS = "127.0.0.1:5010", "/var/lib/knightcube-link/keys"
"""Address of the link and its key folder on the board, in the scenario `RENEWALS`."""

_OPENED = f"""[Service]
ProtectHome=no
ReadWritePaths={_SHARE}/result.txt
Environment=PATH={_SHARE}/bin:/usr/bin PYTHONPATH={ROOT}"""
"""Paths that the sandbox must permit in the container: an interpreter in a home folder, and the test double
of i2cset."""

_HIDDEN = tuple(map(Path, ("/tmp", "/run", "/mnt", "/dev", "/proc", "/sys")))
"""Folders where the container has its own mounts, which hide the machine's files."""

_TOOLS = ("systemd-nspawn", "unshare", "systemctl", "mount", "useradd")


def why_not() -> str:
    """Return the reason why this machine cannot boot a container, or "" if it can."""
    if os.environ.get("CI"):
        return "takes minutes: not in continuous integration"
    if os.geteuid() != 0:
        return "needs root, to mount and to boot systemd in a container"
    missing = [tool for tool in _TOOLS if shutil.which(tool) is None]
    if missing:
        return f"{', '.join(missing)} missing: install systemd-container"
    if "overlay" not in Path("/proc/filesystems").read_text(encoding="ascii"):
        return "the kernel has no overlay file system"
    return _why_no_cgroup()


def _why_no_cgroup() -> str:
    trial = "mount -t cgroup2 cgroup2 /sys/fs/cgroup && test -w /sys/fs/cgroup/cgroup.procs"
    tried = subprocess.run(
        ["unshare", "--mount", "--propagation", "private", "sh", "-c", trial],
        capture_output=True,
        check=False,
    )
    if tried.returncode != 0:
        return f"no writable cgroup2 hierarchy: {tried.stderr.decode().strip()}"
    return ""


def needs_mount(place: Path) -> bool:
    """Return whether a folder of this machine must be mounted separately to be visible in the container.

    The root of the container is an overlay of `/`. This overlay does not contain folders of other file
    systems, and mounts of the container hide the folders `_HIDDEN`.
    """
    real = place.resolve()
    covered = any(real.is_relative_to(hidden) for hidden in _HIDDEN)
    return covered or real.stat().st_dev != Path("/").stat().st_dev


def _mounted() -> list[Path]:
    """Return the folders that the container needs and that must be mounted separately."""
    needed = {place.resolve() for place in (ROOT, Path(sys.prefix), Path(sys.base_prefix))}
    wanted = [place for place in needed if needs_mount(place)]
    return [place for place in wanted if not any(other in place.parents for other in wanted)]


def boot(folder: Path, scenario: str = SERVICES) -> dict[str, Any]:
    """Boot the container, run a scenario and return its observations.

    Raises AssertionError with the log on a failure.
    """
    words = ["unshare", "--mount", "--propagation", "private", sys.executable, "-m", "tests.deploy.container"]
    done = subprocess.run(
        [*words, str(folder), scenario],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=2.0 * LIMIT_S,
        check=False,
    )
    result = folder / "seen.json"
    if not result.exists():
        journal = folder / "journal.txt"
        printed = journal.read_text(encoding="utf-8") if journal.exists() else ""
        raise AssertionError(f"the scenario did not come to its end:\n{done.stdout}{done.stderr}{printed}")
    seen: dict[str, Any] = json.loads(result.read_text(encoding="utf-8"))
    return seen


def main(folder: Path, scenario: str) -> None:
    """Build and boot the container, and remove its files and mounts afterwards."""
    root = _overlay()
    _furnish(root, folder, scenario)
    home = _enter_cgroup()
    try:
        subprocess.run(
            [
                "systemd-nspawn",
                f"--directory={root}",
                f"--bind={folder}:{_SHARE}",
                *(f"--bind=/mnt/place-{number}:{place}" for number, place in enumerate(_mounted())),
                "--register=no",
                "--keep-unit",
                "--private-network",
                # Without these mounts, the device policy and the address filter of the units would have no
                # effect in the container.
                "--system-call-filter=bpf",
                "--capability=CAP_BPF,CAP_PERFMON",
                "--console=pipe",
                "--boot",
                "systemd.unit=scenario.service",
                "systemd.show_status=no",
            ],
            stdin=subprocess.DEVNULL,
            timeout=LIMIT_S,
            check=False,
        )
    finally:
        _leave_cgroup(home)
    (root / _UNITS / "knightcube-devices.service").unlink()  # this unit belongs to the test alone
    _do("chroot", str(root), str(ROOT / "deploy/install.sh"), "--uninstall", "--purge")
    kept = subprocess.run(
        [
            "find",
            *(str(root / name) for name in ("etc", "opt", "var/lib", "var/cache")),
            "-name",
            "*knightcube*",
        ],
        capture_output=True,
        text=True,
        check=True,
    )
    (folder / "after_uninstall.txt").write_text(kept.stdout, encoding="utf-8")


def _overlay() -> Path:
    """Mount an overlay over the machine's files; its upper layer, in memory, receives all writes."""
    _do("mount", "-t", "tmpfs", "tmpfs", "/mnt")
    for name in ("upper", "work", "root"):
        Path("/mnt", name).mkdir()
    layers = "lowerdir=/,upperdir=/mnt/upper,workdir=/mnt/work"
    _do("mount", "-t", "overlay", "overlay", "-o", layers, "/mnt/root")
    for number, place in enumerate(_mounted()):
        shown, upper, work = (Path(f"/mnt/{name}-{number}") for name in ("place", "upper", "work"))
        for folder in (shown, upper, work):
            folder.mkdir()
        layers = f"lowerdir={place},upperdir={upper},workdir={work}"
        _do("mount", "-t", "overlay", "overlay", "-o", layers, str(shown))
        # The installer needs this mount of the folder. At the boot, mounts of the container hide the folder,
        # and nspawn mounts it again.
        Path(f"/mnt/root{place}").mkdir(parents=True, exist_ok=True)
        _do("mount", "--bind", str(shown), f"/mnt/root{place}")
    # nspawn stores files in this folder. These files are removed together with the mount.
    _do("mount", "-t", "tmpfs", "tmpfs", "/run/systemd")
    return Path("/mnt/root")


def _furnish(root: Path, folder: Path, scenario: str) -> None:
    """Install the service as a user would, and add the emulated devices and the scenario to the container."""
    (root / "etc/machine-id").write_text("0123456789abcdef0123456789abcdef\n", encoding="ascii")
    config = write_config(folder)
    with config.open("a", encoding="utf-8") as file:
        file.write(f"\ncommands: {{socket: {COMMANDS}}}\n")
        if scenario == RENEWALS:
            file.write(f"link: {{keys: {KEYS}, spacecraft: 0x1A5, udp: {LINK}, rate: 100000}}\n")
    installer = ["chroot", str(root), str(ROOT / "deploy/install.sh")]
    options = ["--config", str(config)]
    if scenario == RENEWALS:  # a release can only be updated from packages that are on the board
        options += ["--python", f"{sys.base_prefix}/bin/python3"]
        _make_keys(root, folder)
    else:
        options += ["--venv", sys.prefix]
    _do(*installer, *options)
    if scenario == RENEWALS:
        _do("chroot", str(root), "chown", "-R", "knightcube-link:", str(Path(KEYS).parent))
    again = subprocess.run([*installer, "--dry-run", *options], capture_output=True, text=True, check=True)
    (folder / "second_install.txt").write_text(again.stdout, encoding="utf-8")
    # If the interpreter is in a home folder, the service's user must be able to enter this folder.
    for place in (Path(sys.base_prefix), *Path(sys.base_prefix).parents, ROOT, *ROOT.parents):
        inside = root / place.relative_to("/")
        inside.chmod(inside.stat().st_mode | 0o055)
    units = root / _UNITS
    (units / "knightcube-devices.service").write_text(
        f"""[Service]
Type=exec
User=knightcube
RuntimeDirectory=knightcube-devices
Environment=TMPDIR=/run/knightcube-devices
WorkingDirectory={ROOT}
ExecStart={sys.prefix}/bin/python -m sim_hal serve /etc/knightcube/flight.yaml \
    --folder /run/knightcube-devices --facts {_FACTS}
""",
        encoding="utf-8",
    )
    (units / "knightcube.service.d/test.conf").write_text(
        f"""{_opened()}
ExecStart=
ExecStart=/opt/knightcube/bin/fly /etc/knightcube/flight.yaml --archive /var/lib/knightcube/runs \
    --realtime --devices {_FACTS}
""",
        encoding="utf-8",
    )
    for unit in ("knightcube-safe", "knightcube-renewal", "knightcube-link"):
        (units / f"{unit}.service.d").mkdir(exist_ok=True)
        (units / f"{unit}.service.d/test.conf").write_text(f"{_opened()}\n", encoding="utf-8")
    (units / "scenario.service").write_text(
        f"""[Unit]
DefaultDependencies=no
Requires=sysinit.target
After=sysinit.target
[Service]
Type=oneshot
Environment=PYTHONPATH={ROOT}
WorkingDirectory={ROOT}
ExecStart={sys.prefix}/bin/python -m {scenario} /share {_FACTS}
ExecStopPost=/bin/sh -c 'journalctl --no-pager > /share/journal.txt; systemctl --no-block --force poweroff'
""",
        encoding="utf-8",
    )
    _write_i2cset(folder)
    if PATH.exists():  # otherwise the installer builds the sky index of the boards' configurations
        index = root / "var/cache/knightcube/knightcube" / PATH.name
        index.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(PATH, index)


def _make_keys(root: Path, folder: Path) -> None:
    """Make the keys of the link and of the updates, and copy the satellite's keys to the board."""
    for words in (["keys", "keys"], ["renewal", "keys", "signing"]):
        subprocess.run(
            [sys.executable, "-m", "flight", *words], cwd=folder, check=True, stdout=subprocess.DEVNULL
        )
    board = root / KEYS.lstrip("/")
    board.parent.mkdir(parents=True, mode=0o700)
    shutil.copytree(folder / "keys/satellite", board)
    (root / "etc/knightcube").mkdir()
    shutil.copyfile(folder / "signing/metadata/1.root.json", root / "etc/knightcube/root.json")


def _opened() -> str:
    """Return the paths that the sandbox must permit, including paths that a private /tmp would hide."""
    return "\n".join([_OPENED, *(f"BindReadOnlyPaths={place}" for place in _mounted())])


def _write_i2cset(folder: Path) -> None:
    """Put a replacement of i2cset first in the services' PATH.

    The replacement writes to the emulated chip, and records the reason for each call.
    """
    (folder / "bin").mkdir()
    printed = folder / "result.txt"
    printed.touch()
    printed.chmod(0o666)
    tool = folder / "bin/i2cset"
    tool.write_text(
        f"""#!{sys.base_prefix}/bin/python3 -ISE
import json, os, sys
sys.path.insert(0, {str(ROOT)!r})
from sim_hal.serving.device_link import open_bus
_, yes, bus, address, register, value, mode = sys.argv
assert (yes, bus, mode) == ("-y", "1", "b"), sys.argv
chip = open_bus(json.load(open({_FACTS!r}))["socket"])
chip.write_byte_data(int(address, 0), int(register, 0), int(value, 0))
with open("/share/result.txt", "a") as result:
    result.write(os.environ.get("SERVICE_RESULT", "before") + "\\n")
""",
        encoding="utf-8",
    )
    tool.chmod(0o755)
    folder.chmod(0o755)


def _enter_cgroup() -> Path:
    """Move this process into a new cgroup of the cgroup2 hierarchy, for systemd; return the former cgroup."""
    _do("umount", "--recursive", "/sys/fs/cgroup")
    _do("mount", "-t", "cgroup2", "cgroup2", "/sys/fs/cgroup")
    before = Path("/proc/self/cgroup").read_text(encoding="ascii").splitlines()
    home = next(line.removeprefix("0::") for line in before if line.startswith("0::"))
    # The name contains the process identifier, so that concurrent runs use different cgroups.
    own = _own_cgroup()
    own.mkdir()
    (own / "cgroup.procs").write_text(str(os.getpid()), encoding="ascii")
    return Path("/sys/fs/cgroup") / home.lstrip("/")


def _own_cgroup() -> Path:
    return Path("/sys/fs/cgroup") / f"knightcube-test-{os.getpid()}"


def _leave_cgroup(home: Path) -> None:
    own = _own_cgroup()
    (home / "cgroup.procs").write_text(str(os.getpid()), encoding="ascii")
    (own / "cgroup.kill").write_text("1", encoding="ascii")
    for inside, _, _ in os.walk(own, topdown=False):
        for _ in range(50):
            try:
                Path(inside).rmdir()
                break
            except OSError:  # killed processes have not ended yet
                subprocess.run(["sleep", "0.05"], check=True)


def _do(*words: str) -> None:
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
