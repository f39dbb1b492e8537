"""Tests of the texts that describe errors."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest

from hal.interfaces.errors import NotResponding, OutOfRange
from knightcube.errors import ArgumentError, InputError, UsageError, reason_of


def test_the_reason_of_a_frequent_file_error_has_a_remedy(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(FileExistsError) as exists:
        (tmp_path / "file").mkdir()
    with pytest.raises(NotADirectoryError) as below_a_file:
        (tmp_path / "file" / "folder").mkdir()
    with pytest.raises(IsADirectoryError) as folder:
        tmp_path.write_text("")
    assert reason_of(exists.value) == "File exists; give another name"
    assert reason_of(below_a_file.value) == "Not a directory; a part of the path is a file; give another path"
    assert reason_of(folder.value) == "Is a directory; give the name of a file"


@pytest.mark.parametrize("error", [OSError("truncated"), OSError(None, "truncated")])
def test_an_error_without_a_number_is_its_own_reason(error: OSError) -> None:
    assert reason_of(error).endswith("truncated")


@pytest.mark.parametrize(
    "error",
    [
        UsageError("give a file"),
        InputError("file", "is empty"),
        ArgumentError("angle", "is not finite"),
        NotResponding("coils", "no answer"),
        OutOfRange("coils", "current", 0.2, -0.1, 0.1, "A"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_an_error_of_a_worker_process_reaches_the_process_of_a_campaign_unchanged(error: Exception) -> None:
    error.add_note("in case 3")
    received = pickle.loads(pickle.dumps(error))
    assert (type(received), str(received)) == (type(error), str(error))
    assert vars(received) == vars(error)
