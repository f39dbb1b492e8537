"""Checks a signed bundle with an update of the board, and prepares its content for installation.

The program renewal.py runs `open_bundle.py TRUSTED ROOT BUNDLE KIND FOLDER PRESENT KEPT UTC` as root with
the Python of a release. A bundle is a compressed tar archive of TUF metadata and of one artefact. The TUF
target path of the artefact states its kind. Python-tuf checks the metadata against the metadata in the folder
TRUSTED, whose versions never decrease, and against the first root metadata in the file ROOT. Python-tuf reads
the unpacked bundle instead of downloading files.

The program writes the artefact to FOLDER/artefact, and the sources of a release to FOLDER/source. For a
configuration, the program also writes FOLDER/set with the configuration and the drop-ins of its units. For
orbital elements or a star catalogue, the configuration in FOLDER/set is that in the file PRESENT with one
value replaced. PRESENT must match its checksum file. KEPT is the folder in which the star catalogue is
installed later. UTC is the mission time (s since 1970) with which expiry dates are compared. If UTC is empty,
the mission time is unknown and expiry dates are not checked, because the system clock of a board may be
wrong. PRESENT, KEPT and UTC may be omitted for a release. The program prints the version, the permission to
replace a newer version, and the SHA-256 as one JSON object. For a refused bundle, the program prints one line
and exits with status 1.
"""

from __future__ import annotations

import hashlib
import json
import lzma
import re
import shutil
import sys
import tarfile
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, BinaryIO, Self

import yaml
from tuf.api.exceptions import DownloadError, DownloadHTTPError, RepositoryError
from tuf.ngclient import FetcherInterface, Updater

sys.path.insert(0, str(Path(__file__).resolve().parent))

import board_dropin

from flight.schema.document import ConfigError
from flight.schema.reader import load
from knightcube.errors import UsageError

LARGEST_METADATA, LARGEST_TARGET, MOST_MEMBERS = 1 << 19, 1 << 28, 300
"""Maximum sizes (bytes) of a metadata file and of an artefact, and maximum number of files in a bundle."""
LARGEST = {"configuration": 1 << 20, "elements": 1 << 16}
"""Maximum sizes (bytes) of the artefacts that are read as a whole; for other kinds `LARGEST_TARGET`."""
MOST_SOURCES = 20_000
"""Maximum number of files and folders in the sources of a release."""
MOST_MEMORY = 1 << 27
"""Maximum memory (bytes) for unpacking a bundle. The xz preset 9 needs 65 MiB."""
_METADATA = re.compile(r"metadata/(\d{1,6}\.root|timestamp|snapshot|targets)\.json")
_VALUES = {"elements": ("elements",), "catalogue": ("camera", "star_tracker", "index")}
"""Key path of the configuration value that an artefact replaces, by the kind of the artefact."""


class Refused(Exception):
    """Raised for a bundle that must not be installed. The error text states the reason."""


class FolderFetcher(FetcherInterface):  # type: ignore[misc]  # the package may be missing where types are checked
    """TUF fetcher that reads an unpacked bundle instead of downloading files."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def _fetch(self, url: str) -> Iterator[bytes]:
        try:
            file = (self._folder / url).open("rb")
        except OSError as error:
            raise DownloadHTTPError(f"{url} is not in the bundle", 404) from error
        with file:
            while data := file.read(1 << 20):
                yield data


class _Content:
    """Reader of an xz file, which raises LZMAError if the file needs more memory than `MOST_MEMORY`."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._decoder = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=MOST_MEMORY)

    def read(self, size: int) -> bytes:
        """Return the next `size` bytes, or fewer at the end. Raises EOFError if the file is incomplete."""
        data = b""
        while len(data) < size and not self._decoder.eof:
            packed = self._file.read(1 << 16) if self._decoder.needs_input else b""
            if self._decoder.needs_input and not packed:
                raise EOFError("its end is missing")
            data += self._decoder.decompress(packed, size - len(data))
        return data


class _Member(tarfile.TarInfo):
    """Header of a regular file. Any other header is refused before tarfile reads its values of any length."""

    @classmethod
    def frombuf(cls, buf: bytes | bytearray, encoding: str, errors: str) -> Self:
        """Return the header in a block of the archive."""
        member = super().frombuf(buf, encoding, errors)
        if member.type not in {tarfile.REGTYPE, tarfile.AREGTYPE}:
            raise Refused(f"the bundle contains {member.name!r}, which is not a file")
        return member


def unpack(bundle: Path, kind: str, folder: Path) -> None:
    """Unpack the metadata and the artefact of a bundle into a folder.

    Raises Refused for unexpected, repeated or too large files.
    """
    (folder / "metadata").mkdir(parents=True)
    (folder / "targets").mkdir()
    try:
        with (
            bundle.open("rb") as packed,
            tarfile.open(fileobj=_Content(packed), mode="r|", tarinfo=_Member) as archive,
        ):
            for number, member in enumerate(archive):
                path, metadata = folder / member.name, _METADATA.fullmatch(member.name)
                known = metadata or member.name == f"targets/{kind}"
                if number >= MOST_MEMBERS or not known or path.exists():
                    raise Refused(f"the bundle contains {member.name!r}, which is not part of a {kind}")
                largest = LARGEST_METADATA if metadata else LARGEST.get(kind, LARGEST_TARGET)
                if member.size > largest:
                    raise Refused(f"{member.name} has {member.size} bytes: at most {largest} are permitted")
                content = archive.extractfile(member)
                assert content is not None
                with path.open("wb") as file:
                    while data := content.read(1 << 20):
                        file.write(data)
    except (tarfile.TarError, lzma.LZMAError, EOFError, ValueError) as error:
        raise Refused(f"the bundle is damaged: {error}") from error


def unpack_sources(archive: Path, folder: Path) -> None:
    """Unpack the regular files and folders of a release, a tar archive without compression.

    The unpacked files are at most as large as the archive, because sparse files are refused. Raises OSError,
    and Refused for too many members, sparse files, and members that are neither file nor folder.
    """
    folder.mkdir()
    try:
        with tarfile.open(archive, "r:") as files:
            for number, member in enumerate(files):
                if number >= MOST_SOURCES:
                    raise Refused(f"the release contains more than {MOST_SOURCES} files and folders")
                path = folder / member.name
                if member.name.startswith("/") or ".." in Path(member.name).parts:
                    raise Refused(f"the release contains {member.name!r}")
                if member.isdir():
                    path.mkdir(parents=True, exist_ok=True)
                elif member.isreg() and not member.issparse():
                    path.parent.mkdir(parents=True, exist_ok=True)
                    content = files.extractfile(member)
                    assert content is not None
                    with path.open("wb") as file:
                        shutil.copyfileobj(content, file)
                    path.chmod(0o755 if member.mode & 0o100 else 0o644)
                else:
                    raise Refused(
                        f"the release contains {member.name!r}, which is neither a file nor a folder"
                    )
    except (tarfile.TarError, EOFError, ValueError) as error:
        raise Refused(f"the release is damaged: {error}") from error


def verified(
    trusted: Path, root: bytes, unpacked: Path, kind: str, artefact: Path, now: datetime
) -> dict[str, Any]:
    """Verify an unpacked bundle, write its artefact, and return the signed description of the artefact.

    Metadata that expired before `now` are refused. Raises Refused.
    """
    trusted.mkdir(parents=True, exist_ok=True)
    try:
        updater = Updater(
            str(trusted),
            "metadata/",
            str(artefact.parent),
            "targets/",
            FolderFetcher(unpacked),
            bootstrap=root,
        )
        # Python-tuf has no argument for the time, but reads the system clock when the updater is created.
        updater._trusted_set.reference_time = now
        target = updater.get_targetinfo(kind)
        if target is None:
            raise Refused(f"the signed metadata name no {kind}")
        updater.download_target(target, str(artefact))
    except (RepositoryError, DownloadError) as error:
        raise Refused(f"{type(error).__name__}: {error}") from error
    custom = target.unrecognized_fields.get("custom")
    if not isinstance(custom, dict) or not isinstance(custom.get("version"), int):
        raise Refused("the signed metadata give no version of the artefact")
    return {"version": custom["version"], "back": custom.get("back") is True}


def accepted_text(path: Path) -> str:
    """Return the text of a configuration that matches its checksum file. Raises OSError and Refused."""
    data, accepted = path.read_bytes(), path.with_name(f"{path.name}.sha256").read_bytes()
    if accepted.split()[:1] != [hashlib.sha256(data).hexdigest().encode()]:
        raise Refused("the present configuration is damaged (SHA-256): activate a configuration instead")
    return data.decode("utf-8")


def replaced(text: str, path: Sequence[str], value: str) -> str:
    """Return a configuration text in which the value at `path` is replaced by the YAML text `value`.

    Raises Refused if the configuration has no value at `path`.
    """
    node = yaml.compose(text, Loader=yaml.SafeLoader)
    for name in path:
        pairs = node.value if isinstance(node, yaml.MappingNode) else []
        node = next((child for key, child in pairs if key.value == name), None)
    if node is None:
        raise Refused(f"the present configuration has no `{'.'.join(path)}` that could be replaced")
    # A space precedes the value, because a flow sequence must not begin in the column of its key.
    return f"{text[: node.start_mark.index]} {value}{text[_end(node) :]}"


def _end(node: yaml.Node) -> int:
    """Return the index of the end of a node, before comments that follow a block collection."""
    if isinstance(node, yaml.CollectionNode) and not node.flow_style and node.value:
        last = node.value[-1]
        return _end(last[1] if isinstance(last, tuple) else last)
    return int(node.end_mark.index)


def renewed_text(kind: str, artefact: Path, present: str, kept: str, digest: str) -> str:
    """Return the configuration to install. Raises Refused for an artefact that does not fit its kind."""
    try:
        if kind == "configuration":
            return artefact.read_text(encoding="utf-8")
        if kind == "catalogue":
            return replaced(present, _VALUES[kind], json.dumps(f"{kept}/index-{digest}"))
        lines = artefact.read_text(encoding="ascii").split("\n")
    except UnicodeDecodeError as error:
        raise Refused(f"the {kind} is not text: {error}") from error
    pair = [line.rstrip() for line in lines if line.strip()]
    if len(pair) != 2:
        raise Refused(f"the elements have {len(pair)} lines instead of two")
    return replaced(present, _VALUES[kind], json.dumps(pair))


def write_set(text: str, folder: Path) -> None:
    """Write a configuration and the drop-ins of its units. Raises Refused for an invalid configuration."""
    folder.mkdir()
    path = folder / "flight.yaml"
    path.write_text(text, encoding="utf-8")
    try:
        board_dropin.check_single(path)
        config = load(path)
        if config.link is None or config.commands.socket is None:
            raise Refused("without `link` and `commands.socket` in the configuration, contact would be lost")
        made = {
            "knightcube": board_dropin.dropin(config),
            "knightcube-safe": board_dropin.safe_dropin(config),
            "knightcube-link": board_dropin.link_dropin(config),
        }
    except (ConfigError, UsageError) as error:
        raise Refused(str(error).replace(str(path), "configuration")) from error
    for name, lines in made.items():
        (folder / f"{name}.conf").write_text(lines, encoding="utf-8")
    (folder / "flight.yaml.sha256").write_text(
        f"{hashlib.sha256(path.read_bytes()).hexdigest()}  flight.yaml\n", encoding="ascii"
    )


def main(words: Sequence[str]) -> int:
    """Check the bundle and prepare its content; return the exit status."""
    if not 5 <= len(words) <= 8:
        sys.stderr.write("usage: open_bundle.py TRUSTED ROOT BUNDLE KIND FOLDER [PRESENT [KEPT [UTC]]]\n")
        return 2
    trusted, root, bundle, kind, folder = words[:5]
    present, kept, utc = (*words[5:], *("-", "-", "")[len(words) - 5 :])
    place = Path(folder)
    now = datetime.fromtimestamp(int(utc), UTC) if utc else datetime.min.replace(tzinfo=UTC)
    try:
        unpack(Path(bundle), kind, place / "unpacked")
        artefact = place / "artefact"
        facts = verified(Path(trusted), Path(root).read_bytes(), place / "unpacked", kind, artefact, now)
        with artefact.open("rb") as file:
            facts["sha256"] = hashlib.file_digest(file, "sha256").hexdigest()
        if kind == "release":
            unpack_sources(artefact, place / "source")
        else:
            before = accepted_text(Path(present)) if kind in _VALUES else ""
            write_set(renewed_text(kind, artefact, before, kept, facts["sha256"]), place / "set")
    except FileExistsError as error:
        sys.stderr.write(f"{error.filename} exists: give a new folder, or delete the files of the attempt\n")
        return 1
    except (Refused, OSError) as error:
        sys.stderr.write(f"{str(error).splitlines()[0]}\n")
        return 1
    sys.stdout.write(json.dumps(facts) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
