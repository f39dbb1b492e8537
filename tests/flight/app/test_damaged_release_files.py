"""Tests that an intact release starts despite damaged releases, start records or configurations."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path
from random import Random

import pytest
from hypothesis import given, settings

from flight.app.service import FOLDER, TRIALS, FlownRelease, accepted_config, kept_configs
from flight.schema.document import ConfigError
from tests.deploy.scripts import script
from tests.support.damaged import Files, chances, fill, offer
from tests.support.flights import CONFIG

NAMES = ("1.0.0-a", "1.1.0-b")
FILES = ("flight/loop.py", "deploy/install.sh", "manifest")


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Files]:
    """Return a folder with two releases, and its files."""
    place = tmp_path_factory.mktemp("board")
    record = {"starts": {NAMES[1]: 2}, "proven": [NAMES[0]]}
    files = {TRIALS: json.dumps(record).encode()}
    for name, link in zip(NAMES, ("previous", "current"), strict=True):
        release = place / "releases" / name
        fill(release, {file: f"{name} {file}\n".encode() * 20 for file in FILES[:2]})
        (release / "manifest").write_text(script("releases").manifest_text(release), encoding="utf-8")
        files |= {f"releases/{name}/{file}": (release / file).read_bytes() for file in FILES}
        (place / link).symlink_to(release)
    return place, files


@settings(max_examples=50)
@given(chance=chances())
def test_a_whole_release_flies_instead_of_a_damaged_one(board: tuple[Path, Files], chance: Random) -> None:
    place, written = board
    chooser = script("releases")

    def read(files: Files, whole: bool) -> None:
        fill(place, files)
        found, note = chooser.choose(place, chooser.Trials(place))
        assert found is not None
        sound = [
            name
            for name in NAMES
            if all(files[f"releases/{name}/{file}"] == written[f"releases/{name}/{file}"] for file in FILES)
        ]
        assert not sound or found.name in sound
        assert not whole or (not note and found.name == NAMES[1])
        FlownRelease({"KNIGHTCUBE_RELEASE": found.name, "STATE_DIRECTORY": str(place)}).prove()
        assert found.name in chooser.Trials(place).proven

    offer(chance, [written], read)


@settings(max_examples=50)
@given(chance=chances())
def test_only_a_configuration_flies_that_was_accepted_or_flew_before(
    tmp_path_factory: pytest.TempPathFactory, chance: Random
) -> None:
    place = tmp_path_factory.mktemp("flown")
    text = (CONFIG.parent / "step_simulation.yaml").read_bytes()
    older = [text + b"# %d\n" % number for number in range(2)]
    digest = {one: hashlib.sha256(one).hexdigest() for one in (text, *older)}
    example = {"flight.yaml": text, "flight.yaml.sha256": f"{digest[text]}  flight.yaml\n".encode()}
    example |= {f"{FOLDER}/{n + 1:06d}-{digest[one]}.yaml": one for n, one in enumerate(older)}
    known = {one.decode() for one in digest}

    def read(files: Files, whole: bool) -> None:
        fill(place, files)
        assert all(one.text in known for one in kept_configs(place))
        chosen = accepted_config(place / "flight.yaml", {"STATE_DIRECTORY": str(place)})
        assert chosen.text in known
        assert not whole or (chosen.accepted and not chosen.problem)

    offer(chance, [example], read, (ConfigError,))
    shutil.rmtree(place)
