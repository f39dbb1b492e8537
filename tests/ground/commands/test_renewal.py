"""Tests that `knightcube renewal` makes keys and update bundles that a board accepts."""

from __future__ import annotations

import resource
import tarfile
from collections import Counter
from pathlib import Path
from random import Random
from unittest.mock import Mock

import pytest
from tuf.api.metadata import Metadata, Timestamp

from flight.link.files.store import locked
from flight.link.process.commanding import Report, Stage
from flight.schema.reader import merged_text
from ground.commands import renewal
from tests.deploy.scripts import changed_testbed, script
from tests.ground.commands.in_process import command

LINK = "{keys: /var/lib/knightcube-link/keys, udp: '192.168.7.2:5000'}"


LINES = (
    "1 99999U 26001A   26079.50000000  .00000000  00000-0  00000+0 0    05\n"
    "2 99999  97.4059   0.3561 0012106 297.0955  63.0523 15.24067538    03\n"
)


@pytest.fixture
def signing(tmp_path: Path) -> Path:
    done = command("renewal", "keys", tmp_path / "signing")
    assert (done.returncode, done.stderr) == (0, "")
    return tmp_path / "signing"


def test_a_bundle_is_opened_by_the_root_metadata_of_the_board(signing: Path, tmp_path: Path) -> None:
    config = changed_testbed(tmp_path, commands="{socket: /run/x}", link=LINK)
    done = command("renewal", "sign", signing, "configuration", config, "--version", "2", "--out", tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    bundle = tmp_path / "configuration-2.renewal"
    assert bundle.stat().st_size < 8192, "few frames of a slow radio"
    root, folder = signing / "metadata/1.root.json", tmp_path / "opened"
    folder.mkdir()
    words = [tmp_path / "trusted", root, bundle, "configuration", folder, config, "/kept", ""]
    assert script("open_bundle").main([str(word) for word in words]) == 0
    assert (folder / "set/flight.yaml").read_bytes() == config.read_bytes()


def _sources(place: Path, version: str) -> Path:
    """Return a folder with the sources of a release: a version and a file."""
    (place / "deploy").mkdir(parents=True)
    (place / "deploy/build_release.py").write_text("print('built')\n")
    (place / "pyproject.toml").write_text(f'[project]\nname = "x"\nversion = "{version}"\n')
    return place


@pytest.mark.parametrize(("version", "number"), [("0.2.0", 200), ("1.2.3", 10203), ("12.0.99", 120099)])
def test_a_release_is_signed_under_the_version_of_its_sources(
    signing: Path, tmp_path: Path, version: str, number: int
) -> None:
    source = _sources(tmp_path / "source", version)
    done = command("renewal", "sign", signing, "release", source, "--out", tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    root, folder = signing / "metadata/1.root.json", tmp_path / "opened"
    folder.mkdir()
    words = [tmp_path / "trusted", root, tmp_path / f"release-{number}.renewal", "release", folder]
    assert script("open_bundle").main([str(word) for word in words]) == 0
    with tarfile.open(folder / "artefact") as archive:
        assert {"deploy/build_release.py", "pyproject.toml"} < set(archive.getnames())


@pytest.mark.parametrize(
    ("kind", "version"), [("release", "1.2"), ("release", "0.100.0"), ("elements", "1.2.3")]
)
def test_without_a_usable_version_the_option_is_asked_for(
    signing: Path, tmp_path: Path, kind: str, version: str
) -> None:
    source = _sources(tmp_path / "source", version)
    path = source if kind == "release" else tmp_path / "elements"
    (tmp_path / "elements").write_text(LINES)
    done = command("renewal", "sign", signing, kind, path, "--out", tmp_path)
    assert done.returncode == 2
    assert "--version N" in done.stderr
    assert not list(tmp_path.glob("*.renewal"))


@pytest.mark.parametrize("limit", ["_LARGEST", "LARGEST_UP"])
def test_a_release_that_is_too_large_for_the_board_is_not_signed(
    signing: Path, tmp_path: Path, limit: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = _sources(tmp_path / "source", "1.2.3")
    monkeypatch.setattr(renewal, limit, 1000)
    done = command("renewal", "sign", signing, "release", source, "--out", tmp_path / "out")
    assert (done.returncode, "in the bundle: remove files" in done.stderr) == (2, True), done.stderr
    monkeypatch.undo()
    assert list((tmp_path / "out").iterdir()) == []
    assert not (signing / "metadata/targets.json").exists(), "no version is used up"


def test_keys_below_a_file_are_refused_with_the_reason(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    done = command("renewal", "keys", tmp_path / "file/signing")
    assert done.returncode == 2
    assert "file/signing: cannot be made: Not a directory" in done.stderr


def test_keys_are_readable_by_their_owner_only_and_never_overwritten(signing: Path) -> None:
    keys = sorted(signing.glob("*.pem"))
    assert [key.name for key in keys] == ["root-1.pem", "root-2.pem", "signing.pem"]
    assert {key.stat().st_mode & 0o777 for key in keys} == {0o600}
    before = [key.read_bytes() for key in keys]
    done = command("renewal", "keys", signing)
    assert done.returncode == 2
    assert "name a folder that does not exist" in done.stderr
    assert [key.read_bytes() for key in keys] == before


def test_one_root_key_is_enough_to_replace_all_keys(signing: Path, tmp_path: Path) -> None:
    (signing / "root-1.pem").unlink()
    assert command("renewal", "new-key", signing, "--root").returncode == 0
    assert command("renewal", "new-key", signing).returncode == 0
    elements = tmp_path / "elements"
    elements.write_text(LINES)
    done = command("renewal", "sign", signing, "elements", elements, "--version", "1", "--out", tmp_path)
    assert done.returncode == 0
    with tarfile.open(tmp_path / "elements-1.renewal") as archive:
        assert {"metadata/1.root.json", "metadata/2.root.json", "metadata/3.root.json"} < set(
            archive.getnames()
        )
    for key in signing.glob("root-*.pem"):
        key.unlink()
    assert "no root key (root-*.pem) is valid" in command("renewal", "new-key", signing).stderr


def test_elements_are_signed_as_the_command_elements_prints_them(signing: Path, tmp_path: Path) -> None:
    orbit = ("--altitude", "500", "--inclination", "97.4", "--node", "10", "--epoch", "2026-03-20T12:00:00")
    printed = tmp_path / "elements.yaml"
    printed.write_text(command("elements", *orbit).stdout, encoding="utf-8")
    done = command("renewal", "sign", signing, "elements", printed, "--version", "1", "--out", tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    with tarfile.open(tmp_path / "elements-1.renewal") as archive:
        signed = archive.extractfile("targets/elements")
        assert signed is not None
        first, second = signed.read().decode().splitlines()
    assert f"- '{first}'\n  - '{second}'\n" in printed.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("kind", "text", "options", "words"),
    [
        ("configuration", "name: [", [], "is not YAML"),
        ("elements", "1 25544U\n2 25544\n", [], "two lines of 69 characters"),
        ("elements", "elements: [1 25544U, 2 25544]\n", [], "two lines of 69 characters"),
        ("elements", "name: lark\n", [], "two lines of 69 characters"),
        ("release", "", [], "is not the folder of this software's sources"),
        ("elements", LINES, ["--expires", "soon"], "--expires soon: is not a date"),
        ("elements", LINES, ["--expires", "2020-01-01"], "--expires 2020-01-01: has passed"),
        ("elements", LINES, ["--least", "0"], "--least 0: must be 1 to 999999999999"),
        ("elements", LINES, ["--version", "-3"], "--version -3: must be 1 to 999999999999"),
        ("elements", LINES, ["--version", str(10**12)], "--version 1000000000000: must be 1"),
        ("elements", LINES.replace("26079", "26078"), [], "line 1, column 69: checksum 5"),
        ("elements", f"elements: {LINES.replace('297.0955', '297.0965').splitlines()}", [], "checksum 3"),
        ("catalogue", "x", [], "the file is not a sky index"),
        ("catalogue", None, [], "no such file; check the path"),
    ],
)
def test_artefacts_that_the_board_would_refuse_are_not_signed(
    signing: Path, tmp_path: Path, kind: str, text: str | None, options: list[str], words: str
) -> None:
    path = tmp_path / "artefact"
    if text is not None:
        path.write_text(text)
    done = command("renewal", "sign", signing, kind, path, "--version", "1", "--out", tmp_path, *options)
    assert done.returncode == 2
    assert words in done.stderr
    assert not list(tmp_path.glob("*.renewal"))


def test_a_date_of_expiry_with_a_time_zone_is_converted_to_utc() -> None:
    assert renewal._date("2030-01-01").isoformat() == "2030-01-01T00:00:00+00:00"
    assert renewal._date("2030-01-01T00:00-05:00").isoformat() == "2030-01-01T05:00:00+00:00"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("extends: base.yaml\nname: derived\n", "--merged NEW`, and sign NEW"),
        ("extends: orbit.yaml\nname: silent\n", "has no section `link`"),
    ],
)
def test_a_configuration_that_the_board_could_not_use_is_not_signed(
    signing: Path, tmp_path: Path, text: str, words: str
) -> None:
    own = "commands: {socket: x.socket}\nlink: {keys: k, udp: '127.0.0.1:5010'}\n"
    (tmp_path / "base.yaml").write_text(f"extends: orbit.yaml\n{own}")
    (tmp_path / "flight.yaml").write_text(text)
    done = command("renewal", "sign", signing, "configuration", tmp_path / "flight.yaml", "--version", "1")
    assert (done.returncode, words in done.stderr) == (2, True), done.stderr
    merged = tmp_path / "merged.yaml"
    merged.write_text(merged_text((tmp_path / "base.yaml").read_text(), str(tmp_path / "base.yaml")))
    out = tmp_path / "new/folder"
    done = command("renewal", "sign", signing, "configuration", merged, "--version", "1", "--out", out)
    assert (done.returncode, done.stderr) == (0, "")
    assert (out / "configuration-1.renewal").exists()


def test_an_unusable_folder_does_not_use_up_a_version(signing: Path, tmp_path: Path) -> None:
    (tmp_path / "elements").write_text(LINES)
    words = [
        "renewal",
        "sign",
        str(signing),
        "elements",
        str(tmp_path / "elements"),
        "--version",
        "1",
        "--out",
    ]
    done = command(*words, tmp_path / "elements/below")
    assert (done.returncode, "cannot be made" in done.stderr) == (2, True)
    assert command(*words, tmp_path).returncode == 0


def test_versions_rise_unless_going_back_is_signed(signing: Path, tmp_path: Path) -> None:
    (tmp_path / "elements").write_text(LINES)
    words = ["renewal", "sign", str(signing), "elements", str(tmp_path / "elements")]
    words += ["--out", str(tmp_path), "--version"]
    assert command(*words, "3").returncode == 0
    assert "elements 3 is signed already" in command(*words, "3").stderr
    assert command(*words, "2", "--back").returncode == 0
    assert command(*words, "3").returncode == 0


@pytest.mark.parametrize(
    ("kind", "stages", "status", "error"),
    [
        ("release", ["ACCEPTED", "STARTED", "STARTED"], 0, ""),
        ("release", ["ACCEPTED", "STARTED", "FAILED"], 1, ""),
        ("release", ["REPEATED"], 1, ""),
        ("release", ["ACCEPTED", "STARTED"], 1, "no result of the renewal within 1800 s"),
        ("elements", ["ACCEPTED", "STARTED"], 1, "no result of the renewal within 60 s"),
        ("elements", [], 1, "no answer over the link within 60 s"),
    ],
)
def test_activate_succeeds_only_if_the_trial_has_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, stages: list[str], status: int, error: str
) -> None:
    terminal = Mock()
    terminal.gate.refused, terminal.lost_spis = Counter(), ()
    reports = [Report(1, 7, Stage[stage], "activate", "text") for stage in stages]
    terminal.follow.side_effect = [reports, *[[]] * 1000]
    monkeypatch.setattr("ground.commands.renewal.terminal_of", lambda _: terminal)
    with tarfile.open(tmp_path / "bundle", "w:xz") as archive:
        archive.addfile(tarfile.TarInfo(f"targets/{kind}"))
    done = command(
        "renewal", "activate", "--link", "127.0.0.1:1", "--keys", "k", kind, "bundle", folder=tmp_path
    )
    assert done.returncode == status
    shown = [line.partition(":")[0] for line in done.stdout.splitlines()]
    assert shown == [stage.lower() for stage in stages]
    assert error in done.stderr
    assert bool(error) == bool(done.stderr)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("targets/release", "contains release, not elements: give the kind of the bundle"),
        ("other", "contains no artefact, not elements"),
        (None, "is not a bundle: give the local copy of a bundle of `renewal sign`"),
    ],
)
def test_only_a_bundle_of_the_stated_kind_is_activated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: str | None, words: str
) -> None:
    monkeypatch.setattr("ground.commands.renewal.terminal_of", lambda _: pytest.fail("a frame was sent"))
    (tmp_path / "bundle").write_text(LINES)
    if content is not None:
        with tarfile.open(tmp_path / "bundle", "w:xz") as archive:
            archive.addfile(tarfile.TarInfo(content))
    link = ["--link", "127.0.0.1:1", "--keys", "k"]
    done = command("renewal", "activate", *link, "elements", "bundle", folder=tmp_path)
    assert (done.returncode, words in done.stderr) == (2, True), done.stderr


def test_the_program_of_the_board_states_its_arguments(capsys: pytest.CaptureFixture[str]) -> None:
    assert script("open_bundle").main(["trusted", "root", "bundle"]) == 2
    assert "TRUSTED ROOT BUNDLE KIND FOLDER" in capsys.readouterr().err


def test_a_folder_of_an_earlier_attempt_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    used = tmp_path / "unpacked/metadata"
    used.mkdir(parents=True)
    words = [str(tmp_path / name) for name in ("trusted", "root", "bundle")]
    assert script("open_bundle").main([*words, "release", str(tmp_path)]) == 1
    assert capsys.readouterr().err.startswith(f"{used} exists: give a new folder")


def test_a_bundle_that_cannot_be_written_does_not_use_up_a_version(signing: Path, tmp_path: Path) -> None:
    source = _sources(tmp_path / "source", "0.2.0")
    (source / "README.md").write_bytes(Random(1).randbytes(300_000))
    words: list[str | Path] = ["renewal", "sign", signing, "release", source, "--out", tmp_path]
    before = {path: path.read_bytes() for path in (signing / "metadata").glob("*.json")}
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        done = command(*words)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert done.returncode != 0
    assert {path: path.read_bytes() for path in (signing / "metadata").glob("*.json")} == before
    assert not list(tmp_path.glob("*.renewal"))
    assert command(*words).returncode == 0
    assert (tmp_path / "release-200.renewal").exists()


def test_metadata_are_signed_before_their_bundle_has_its_name(signing: Path, tmp_path: Path) -> None:
    """If the end of the command is lost, the next bundle does not repeat the versions of the metadata."""
    (tmp_path / "elements").write_text(LINES)
    (tmp_path / "elements-1.renewal").mkdir()
    words: list[str | Path] = ["renewal", "sign", signing, "elements", tmp_path / "elements"]
    words += ["--out", tmp_path, "--version"]
    assert command(*words, "1").returncode != 0
    assert command(*words, "2").returncode == 0
    assert Metadata[Timestamp].from_file(str(signing / "metadata/timestamp.json")).signed.version == 3


@pytest.mark.parametrize("words", [["sign", "elements", "--version", "1"], ["new-key"]])
def test_two_commands_never_sign_at_the_same_time(signing: Path, tmp_path: Path, words: list[str]) -> None:
    (tmp_path / "elements").write_text(LINES)
    what, *rest = words
    given: list[str | Path] = [*rest[:1], tmp_path / "elements", *rest[1:], "--out", tmp_path] if rest else []
    with locked(signing / "metadata/.lock", ""):
        done = command("renewal", what, signing, *given)
    assert (done.returncode, "another command signs with these keys" in done.stderr) == (2, True)
    assert command("renewal", what, signing, *given).returncode == 0
