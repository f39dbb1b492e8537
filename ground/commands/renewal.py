"""Command `knightcube renewal`: keys, signatures and commands for updates in orbit (docs/fly/renewal.md)."""

from __future__ import annotations

import argparse
import io
import lzma
import os
import re
import sys
import tarfile
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager, closing, nullcontext, suppress
from datetime import UTC, datetime
from pathlib import Path

from cryptography.hazmat.primitives import serialization
from securesystemslib.signer import CryptoSigner
from tuf.api.exceptions import RepositoryError
from tuf.api.metadata import Metadata, MetaFile, Root, Snapshot, T, TargetFile, Targets, Timestamp

from flight.app.cli import PROGRAM
from flight.app.run import utc_ns
from flight.link.files.store import locked, make_lasting
from flight.link.process import directives
from flight.link.process.commanding import Report, Stage
from flight.link.process.directives import KINDS, Activate, Confirm, Directive, Withdraw
from flight.link.process.filing import LARGEST_UP
from flight.link.security import COMMAND_SPIS
from flight.loop.state import LinuxFiles, replace_file
from flight.schema.document import read_document, read_text
from flight.schema.reader import parse
from ground.commands.options import positive, utc
from ground.link.commanding import add_link_options, command, explained, failed, sha256_of, terminal_of
from knightcube.astro.earth.orbit_knowledge import TwoLineElements
from knightcube.errors import KnightCubeError, UsageError, reason_of
from knightcube.vision.startracker import index

ENDLESS = datetime(9999, 12, 31, 23, 59, 59, tzinfo=UTC)
"""Expiry date of metadata that never expire, so that a wrong clock on board does not matter."""
_FOLDERS = ("knightcube", "flight", "hal", "sim_hal", "deploy", "config")
PARTS = (*_FOLDERS, "pyproject.toml", "README.md", "LICENSE", "wheels")
"""Source files and folders that a release contains."""
_SIGNED_BY_ONE = ("targets", "snapshot", "timestamp")
_LAST_VERSION = 10**12 - 1
"""Highest version that is signed: 12 digits, enough for a date with hours and minutes."""
_TARGETS = tuple(f"targets/{kind}" for kind in KINDS)  # names of the artefacts in a bundle
_LARGEST = 1 << 28  # size (bytes) of the largest artefact that deploy/open_bundle.py unpacks
_TIMEOUT_S, _BUILD_TIMEOUT_S = 60.0, 1800.0
"""Default times (s) to wait for the privileged part, which runs every 10 s, and for a release to be built."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `knightcube renewal` to the parser."""
    parser.description = (
        "Update software or files of a satellite in orbit: make signing keys, sign a configuration, "
        "elements, a sky index or a release, and activate, confirm or withdraw it over the link."
    )
    words = parser.add_subparsers(required=True, metavar="WHAT", dest="what")
    keys = words.add_parser("keys", help="make root keys, a signing key and the first metadata")
    keys.add_argument("folder", type=Path, metavar="FOLDER", help="new folder to create")
    renewed = words.add_parser("new-key", help="replace the signing key")
    renewed.add_argument("folder", type=Path, metavar="FOLDER", help="folder with the keys and the metadata")
    renewed.add_argument("--root", action="store_true", help="replace both root keys too")
    signed = words.add_parser("sign", help="sign an artefact and write its bundle")
    signed.add_argument("folder", type=Path, metavar="FOLDER", help="folder with the keys and the metadata")
    signed.add_argument("kind", choices=KINDS, help="kind of the artefact")
    signed.add_argument(
        "path", type=Path, metavar="FILE", help="the artefact to sign; for a release, its folder of sources"
    )
    text = "version number, above the last (default for a release: 200 for 0.2.0, 10203 for 1.2.3)"
    signed.add_argument("--version", type=int, metavar="N", help=text)
    signed.add_argument("--back", action="store_true", help="permit a version that is not newer")
    signed.add_argument(
        "--expires", metavar="DATE", help="end of validity, such as 2030-01-01 (default none)"
    )
    signed.add_argument(
        "--least", type=int, default=1, metavar="N", help="lowest version of the new metadata (default 1)"
    )
    signed.add_argument("--out", type=Path, default=Path(), metavar="DIR", help="folder of the bundle")
    for word, purpose in (
        ("activate", "start the trial of a bundle that was uploaded to the satellite"),
        ("confirm", "end the trial and keep the artefact"),
        ("withdraw", "end the trial, or return to the previous configuration or release"),
    ):
        placed = words.add_parser(word, help=purpose)
        add_link_options(placed, placed.add_mutually_exclusive_group(required=True))
        placed.add_argument("kind", choices=KINDS, help="kind of the artefact")
        text = "key of the commands on the link (default %(default)s)"
        placed.add_argument("--spi", type=int, choices=COMMAND_SPIS, default=COMMAND_SPIS[0], help=text)
        text = (
            f"time to wait for the satellite (default {_TIMEOUT_S:g} s, for a release {_BUILD_TIMEOUT_S:g} s)"
        )
        placed.add_argument("--timeout", type=positive, metavar="S", help=text)
        if word == "activate":
            placed.add_argument("path", type=Path, metavar="BUNDLE", help="local copy of the bundle")
            text = "powered time (h) within which the ground must confirm (default %(default)g)"
            placed.add_argument("--hours", type=float, default=24.0, metavar="H", help=text)
            text = "a fault that the flight reports does not end the trial"
            placed.add_argument("--despite-faults", action="store_true", help=text)
    parser.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Execute the command."""
    match options.what:
        case "keys":
            root = make_signing_keys(options.folder)
            sys.stdout.write(
                f"keys in {options.folder}; for the board: {root} as /etc/knightcube/root.json\n"
            )
        case "new-key":
            with _alone(options.folder):
                version = replace_signing_key(options.folder, options.root)
            sys.stdout.write(f"root metadata {version}; the next bundle carries them\n")
        case "sign":
            data = artefact(options.kind, options.path)
            if options.version is None:
                options.version = _release_version(options.kind, options.path)
            _check_permanent(options)
            with _alone(options.folder):
                bundle = sign(options, data)
            sys.stdout.write(f"{bundle}: {bundle.stat().st_size} bytes\n")
        case _:
            return _command(options)
    return 0


def _alone(folder: Path) -> AbstractContextManager[None]:
    """Return a lock that keeps two commands from signing different metadata of the same version.

    A folder without metadata is not locked. Raises UsageError if the folder is locked already.
    """
    metadata = folder / "metadata"
    problem = f"{folder}: another command signs with these keys: try again after its end"
    return locked(metadata / ".lock", problem) if metadata.is_dir() else nullcontext()


def make_signing_keys(folder: Path) -> Path:
    """Make two root keys, a signing key and the first root metadata, and return the metadata file."""
    try:
        folder.mkdir(mode=0o700, parents=True)
    except FileExistsError as error:
        raise UsageError(f"{folder}: {error.strerror}: name a folder that does not exist") from error
    except OSError as error:
        raise UsageError(f"{folder}: cannot be made: {reason_of(error)}") from error
    (folder / "metadata").mkdir()
    roots = [_new_key(folder / f"root-{number}.pem") for number in (1, 2)]
    signing = _new_key(folder / "signing.pem")
    root = Root(expires=ENDLESS, consistent_snapshot=False)
    for signer in roots:
        root.add_key(signer.public_key, "root")
    for role in _SIGNED_BY_ONE:
        root.add_key(signing.public_key, role)
    return _write_signed(folder / "metadata/1.root.json", root, roots)


def replace_signing_key(folder: Path, also_root: bool) -> int:
    """Replace the signing key and, if `also_root`, the root keys. Return the version of the root metadata."""
    root = _newest_root(folder)
    old = [_read_key(path) for path in sorted(folder.glob("root-*.pem"))]
    old = [signer for signer in old if signer.public_key.keyid in root.roles["root"].keyids]
    if not old:
        raise UsageError(f"{folder}: no root key (root-*.pem) is valid: copy a root key into this folder")
    new = _new_key(folder / "signing.pem", replaced=True)
    for role in _SIGNED_BY_ONE:
        for keyid in list(root.roles[role].keyids):
            root.revoke_key(keyid, role)
        root.add_key(new.public_key, role)
    roots = old
    if also_root:
        roots = [_new_key(folder / f"root-{number}.pem", replaced=True) for number in (1, 2)]
        for keyid in list(root.roles["root"].keyids):
            root.revoke_key(keyid, "root")
        for signer in roots:
            root.add_key(signer.public_key, "root")
    root.version += 1
    signers = {signer.public_key.keyid: signer for signer in (*old, *roots)}
    _write_signed(folder / f"metadata/{root.version}.root.json", root, signers.values())
    return root.version


def _check_permanent(options: argparse.Namespace) -> None:
    """Raise UsageError for an option whose effect on board cannot be undone, and for an unusable folder."""
    for name in ("version", "least"):
        if not 1 <= (value := getattr(options, name)) <= _LAST_VERSION:
            problem = f"must be 1 to {_LAST_VERSION}, because the board never accepts a lower version again"
            raise UsageError(f"--{name} {value}: {problem}")
    if options.expires is not None and _date(options.expires) <= datetime.now(UTC):
        raise UsageError(f"--expires {options.expires}: has passed: give a later date, or omit the option")
    try:
        options.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"--out {options.out}: cannot be made: {reason_of(error)}") from error


def sign(options: argparse.Namespace, data: bytes) -> Path:
    """Sign the bytes of an artefact, and return the path of their bundle. Raises UsageError.

    The bundle is written completely before the metadata, so that a failed write does not use up a version.
    The bundle gets its final name only after the metadata are stored. Otherwise a failed write could leave a
    usable bundle, and the next bundle would have the same metadata versions.
    """
    folder, kind = options.folder, options.kind
    signer = _read_key(folder / "signing.pem")
    if signer.public_key.keyid not in _newest_root(folder).roles["targets"].keyids:
        raise UsageError(f"{folder}/signing.pem is not the signing key that the root metadata name")
    expires = ENDLESS if options.expires is None else _date(options.expires)
    targets = _read(folder, Targets) or Targets()
    before = targets.targets.get(kind)
    last = before.unrecognized_fields["custom"]["version"] if before is not None else 0
    if options.version <= last and not options.back:
        problem = f"{kind} {last} is signed already: give a higher version, or add --back"
        raise UsageError(f"--version {options.version}: {problem}")
    target = TargetFile.from_data(kind, data)
    target.unrecognized_fields["custom"] = {"version": options.version, "back": bool(options.back)}
    targets.targets[kind] = target
    snapshot = _read(folder, Snapshot) or Snapshot()
    timestamp = _read(folder, Timestamp) or Timestamp()
    for one in (targets, snapshot, timestamp):
        one.version, one.expires = max(one.version + 1, options.least), expires
    snapshot.meta["targets.json"] = MetaFile(version=targets.version)
    timestamp.snapshot_meta = MetaFile(version=snapshot.version)
    files = {path.name: path.read_bytes() for path in (folder / "metadata").glob("*.root.json")}
    new = {
        "targets.json": _signed_bytes(targets, [signer]),
        "snapshot.json": _signed_bytes(snapshot, [signer]),
        "timestamp.json": _signed_bytes(timestamp, [signer]),
    }
    bundle: Path = options.out / f"{kind}-{options.version}.renewal"
    unnamed = bundle.with_name(f"{bundle.name}.part")
    packed = _bundle({**files, **new}, kind, data)
    if len(data) > _LARGEST or len(packed) > LARGEST_UP:
        limits = f"the board accepts {_LARGEST} bytes, {LARGEST_UP} in the bundle: remove files"
        raise UsageError(f"{kind}: has {len(data)} bytes, {len(packed)} in the bundle; {limits}")
    replace_file(LinuxFiles(), unnamed, packed)
    for name, content in new.items():
        replace_file(LinuxFiles(), folder / "metadata" / name, content)
    unnamed.replace(bundle)
    make_lasting(options.out)
    return bundle


def _command(options: argparse.Namespace) -> int:
    """Send a command to activate, confirm or withdraw an update, and print each stage of its execution."""
    kind = KINDS.index(options.kind)
    directive: Directive
    if options.what == "activate":
        if not 0.0 < options.hours < float("inf"):
            raise UsageError(f"--hours {options.hours}: must be a positive number")
        _check_bundle(options.path, options.kind)
        name = f"received/{options.kind}/{options.path.name}"
        directive = Activate(name, sha256_of(options.path), options.hours, int(options.despite_faults))
    else:
        directive = Confirm(kind) if options.what == "confirm" else Withdraw(kind)

    def show(report: Report) -> None:
        sys.stdout.write(f"{report.stage.name.lower()}: {explained(report)}\n")
        sys.stdout.flush()

    def has_begun(reports: list[Report]) -> bool:
        """Return whether both the link and the privileged part have reported that the trial started."""
        return options.what == "activate" and [one.stage for one in reports].count(Stage.STARTED) == 2

    builds = options.what == "activate" and options.kind == "release"
    timeout = options.timeout or (_BUILD_TIMEOUT_S if builds else _TIMEOUT_S)
    packet = directives.pack(directive, utc_ns())
    with closing(terminal_of(options)) as terminal:
        reports = command(terminal, packet, options.spi, timeout, show, has_begun)
    if failed(reports) or has_begun(reports):
        return int(bool(failed(reports)))
    if not reports[-1].stage.final:
        raise KnightCubeError(
            f"no result of the renewal within {timeout:g} s: look at the telemetry, and send `confirm` or "
            "`withdraw`; the reply to either states whether a trial is running"
        )
    return 0


def artefact(kind: str, path: Path) -> bytes:
    """Return the bytes to sign. Raises UsageError for an artefact that the board would refuse."""
    if kind == "release":
        return _packed(path)
    if kind == "configuration":
        text = read_text(path)
        if parse(text, str(path)).link is None:
            raise UsageError(
                f"{path}: has no section `link`, without which the ground cannot reach the board: add it"
            )
        if len(read_document(text, str(path)).chain) > 1:
            cure = f"merge the files by `{PROGRAM} check {path} --merged NEW`, and sign NEW"
            raise UsageError(f"{path}: `extends` names a file that the board does not have: {cure}")
        return text.encode()
    data = LinuxFiles().read(path)
    if data is None:
        raise UsageError(f"{path}: no such file; check the path")
    if kind == "elements":
        return _two_lines(data, path)
    index.load(path)  # raises InputError for a file that is not a sky index
    return data


def _check_bundle(path: Path, kind: str) -> None:
    """Raise UsageError if a file is not a bundle with an artefact of this kind."""
    try:
        with tarfile.open(path) as archive:
            kinds = [name.removeprefix("targets/") for name in archive.getnames() if name in _TARGETS]
    except (OSError, EOFError, lzma.LZMAError, tarfile.TarError) as error:
        problem = (isinstance(error, OSError) and error.strerror) or "is not a bundle"
        raise UsageError(f"{path}: {problem}: give the local copy of a bundle of `renewal sign`") from error
    if kinds != [kind]:
        found = ", ".join(kinds) or "no artefact"
        raise UsageError(f"{path}: contains {found}, not {kind}: give the kind of the bundle")


def _two_lines(data: bytes, path: Path) -> bytes:
    """Return the two-line elements in a text or YAML file. Raises UsageError for invalid elements."""
    lines = [line.rstrip() for line in data.decode(errors="replace").splitlines() if line.strip()]
    plain = [len(line) for line in lines] == [69, 69]
    if not plain:
        lines = []
        with suppress(UsageError):
            found = read_document(read_text(path), str(path)).values.get("elements")
            lines = [str(line) for line in found] if isinstance(found, list) else []
        if [len(line) for line in lines] != [69, 69]:
            problem = "give two lines of 69 characters, or a YAML file with them as `elements`"
            raise UsageError(f"{path}: {problem}")
    try:
        TwoLineElements(lines[0], lines[1])
    except UsageError as error:
        raise UsageError(f"{path}: {error}") from error
    return data if plain else "".join(f"{line}\n" for line in lines).encode()


def _release_version(kind: str, source: Path) -> int:
    """Return a release's version as one number, 10203 for 1.2.3. Raises UsageError if no version is found."""
    if kind != "release":
        raise UsageError(f"{kind}: give its version with --version N")
    text = read_text(source / "pyproject.toml", packaged=False)
    found = re.search(r'^version = "(\d+)\.(\d\d?)\.(\d\d?)"$', text, re.MULTILINE)
    if found is None:
        raise UsageError(f"{source}/pyproject.toml: has no version such as 1.2.3: give --version N")
    major, minor, patch = map(int, found.groups())
    return 10_000 * major + 100 * minor + patch


def _packed(source: Path) -> bytes:
    """Return the sources of a release as a tar archive. Raises UsageError."""
    if not (source / "deploy/build_release.py").is_file():
        raise UsageError(f"{source}: is not the folder of this software's sources")

    def plain(member: tarfile.TarInfo) -> tarfile.TarInfo | None:
        if "__pycache__" in member.name:
            return None
        member.uid = member.gid = member.mtime = 0
        member.uname = member.gname = ""
        return member

    data = io.BytesIO()
    with tarfile.open(fileobj=data, mode="w", dereference=True) as archive:
        for part in PARTS:
            if (source / part).exists():
                archive.add(source / part, part, filter=plain)
    return data.getvalue()


def _bundle(metadata: Mapping[str, bytes], kind: str, data: bytes) -> bytes:
    """Return a compressed tar archive of the files of the metadata and of the artefact."""
    content = io.BytesIO()
    with tarfile.open(fileobj=content, mode="w:xz") as archive:
        for name, file in sorted(metadata.items()):
            _add(archive, f"metadata/{name}", file)
        _add(archive, f"targets/{kind}", data)
    return content.getvalue()


def _add(archive: tarfile.TarFile, name: str, data: bytes) -> None:
    member = tarfile.TarInfo(name)
    member.size = len(data)
    archive.addfile(member, io.BytesIO(data))


def _new_key(path: Path, *, replaced: bool = False) -> CryptoSigner:
    """Make a key in a file that only its owner can read. A replaced key's file gets the suffix .pem.old."""
    signer = CryptoSigner.generate_ed25519()
    if replaced and path.exists():
        path.replace(path.with_suffix(".pem.old"))
    with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(signer.private_bytes)
        file.flush()
        os.fsync(file.fileno())
    return signer


def _read_key(path: Path) -> CryptoSigner:
    """Return the key in a file. Raises UsageError."""
    try:
        key = serialization.load_pem_private_key(path.read_bytes(), None)
        return CryptoSigner(key)
    except OSError as error:
        cure = "give the folder that `renewal keys` has made"
        raise UsageError(f"{path}: cannot be read: {error.strerror or error}: {cure}") from error
    except (ValueError, TypeError) as error:
        raise UsageError(f"{path}: is not a readable key: {error}") from error


def _newest_root(folder: Path) -> Root:
    """Return the newest root metadata. Raises UsageError."""
    files = sorted(
        (folder / "metadata").glob("*.root.json"), key=lambda path: int(path.name.partition(".")[0])
    )
    if not files:
        raise UsageError(f"{folder}: there are no metadata: make keys by `renewal keys`")
    return _signed(files[-1], Root)


def _read(folder: Path, kind: type[T]) -> T | None:
    """Return the newest metadata of a role, or None if the file does not exist. Raises UsageError."""
    path = folder / "metadata" / f"{kind.type}.json"
    return _signed(path, kind) if path.exists() else None


def _signed(path: Path, kind: type[T]) -> T:
    """Return the metadata in a file, without the signatures. Raises UsageError."""
    try:
        signed = Metadata[T].from_file(str(path)).signed
    except RepositoryError as error:
        raise UsageError(f"{path}: is damaged: {error}") from error
    if not isinstance(signed, kind):
        raise UsageError(f"{path}: are not metadata of the role {kind.type}")
    return signed


def _write_signed(path: Path, signed: T, signers: Iterable[CryptoSigner]) -> Path:
    """Sign metadata, and write the file atomically."""
    replace_file(LinuxFiles(), path, _signed_bytes(signed, signers))
    return path


def _signed_bytes(signed: T, signers: Iterable[CryptoSigner]) -> bytes:
    """Return the content of a file with metadata and their signatures."""
    metadata = Metadata(signed)
    for signer in signers:
        metadata.sign(signer, append=True)
    return metadata.to_bytes()


def _date(text: str) -> datetime:
    """Return the expiry date in an argument such as 2030-01-01, in UTC. Raises UsageError."""
    try:
        return utc(text)
    except argparse.ArgumentTypeError as error:
        raise UsageError(f"--expires {text}: is not a date such as 2030-01-01") from error
