"""Tests that the compiled or the numpy implementation of a function runs as expected, even without numba."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.compiled import HotFunction, compiled_form_of, in_use
from tests.support.compiled_forms import assert_forms_agree, sum_of_squares, sum_of_squares_numpy

ROOT = Path(__file__).resolve().parents[2]
VALUES = np.linspace(-1.0, 2.0, 1_000)


def test_all_forms_return_the_same() -> None:
    assert_forms_agree(sum_of_squares, VALUES)
    assert sum_of_squares.numpy_form(VALUES) == pytest.approx(1001.5015015015, rel=1e-9)


def test_the_variable_selects_the_numpy_form(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("KNIGHTCUBE_COMPILED", "0")
    assert not in_use()

    @compiled_form_of(sum_of_squares_numpy)
    def fails(values: FloatArray) -> float:
        raise AssertionError(f"called with {values.size} values")

    assert fails(VALUES) == sum_of_squares_numpy(VALUES)


@pytest.mark.parametrize(
    "numba", ["", "raise ImportError('Numba needs NumPy 2.4 or less')"], ids=["missing", "unfit"]
)
def test_without_a_usable_numba_the_numpy_form_is_used(numba: str, tmp_path: Path) -> None:
    """If numba cannot be used, numpy implementations run. Numba fails on import if numpy is too new."""
    (tmp_path / "numba.py").write_text(numba, encoding="utf-8")
    hidden = "" if numba else "sys.modules['numba'] = None\n"
    code = (
        f"import sys\n{hidden}import numpy as np\nfrom knightcube import compiled\n"
        "from knightcube.vision.background import estimate_background\n"
        "estimate_background(np.zeros((64, 64)))\nsys.exit(compiled.in_use())"
    )
    path = os.pathsep.join([str(tmp_path), str(ROOT)])
    environment = {**os.environ, "KNIGHTCUBE_COMPILED": "1", "PYTHONPATH": path}
    subprocess.run([sys.executable, "-c", code], env=environment, timeout=100, check=True)


def test_compilation_is_announced_and_a_damaged_file_of_machine_code_is_left_aside(tmp_path: Path) -> None:
    """Compilation is announced, and a truncated file of machine code is ignored.

    A full disk or a power failure may truncate the file.
    """
    pytest.importorskip("numba", reason="numba is not installed: pip install knightcube[fast]")
    environment = {
        **os.environ,
        "KNIGHTCUBE_COMPILED": "1",
        "NUMBA_CACHE_DIR": str(tmp_path),
        "PYTHONPATH": str(ROOT),
    }
    code = (
        "import numpy as np\nfrom tests.support.compiled_forms import sum_of_squares as hot\n"
        "assert hot(np.arange(5.0)) == 30.0"
    )
    for damage in ("", "none", "index", "code", "folder"):
        for file in tmp_path.rglob("*.nbi" if damage == "index" else "*.nbc"):
            if damage not in {"", "none"}:
                file.write_bytes(file.read_bytes()[:40])
            if damage == "folder":
                file.unlink()
                file.mkdir()
        done = subprocess.run(
            [sys.executable, "-c", code],
            env=environment,
            timeout=100,
            check=True,
            capture_output=True,
            text=True,
        )
        assert done.stderr.count("numba compiles") == (damage == "")
        assert list(tmp_path.rglob("*.nbc"))


def test_the_time_of_compilation_is_measured_and_each_function_is_reported_once(tmp_path: Path) -> None:
    pytest.importorskip("numba", reason="numba is not installed: pip install knightcube[fast]")
    places = {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(ROOT), "KNIGHTCUBE_COMPILED": "1"}
    code = (
        "import numpy as np\nfrom knightcube import compiled\n"
        "from tests.support.compiled_forms import sum_of_squares as hot\n"
        "compiled.report_compilations(print)\nhot(np.arange(5.0))\nspent = compiled.compilation_ns()\n"
        "hot(np.arange(5.0))\nassert compiled.compilation_ns() == spent\nprint(spent > 0)"
    )
    printed = [
        subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, **places},
            timeout=100,
            check=True,
            capture_output=True,
            text=True,
        ).stdout.split()
        for _ in range(2)
    ]
    assert printed == [["sum_of_squares", "True"], ["False"]], "the second process loads the machine code"


def test_the_process_that_compiles_a_function_computes_the_same_as_later_processes(tmp_path: Path) -> None:
    """Background subtraction is tested, because its compiled helpers may compute sums in any order."""
    pytest.importorskip("numba", reason="numba is not installed: pip install knightcube[fast]")
    environment = {
        **os.environ,
        "KNIGHTCUBE_COMPILED": "1",
        "NUMBA_CACHE_DIR": str(tmp_path),
        "PYTHONPATH": str(ROOT),
    }
    code = (
        "import hashlib\nimport numpy as np\nfrom knightcube.vision.background import Background\n"
        "rng = np.random.default_rng(1)\nlevel, noise = rng.uniform(90.0, 110.0, (2, 8, 8))\n"
        "pixels = rng.poisson(400.0, (512, 512)).astype(np.uint16)\n"
        "signal, variance = Background(level, noise, (512, 512), False).subtracted(pixels)\n"
        "print(hashlib.sha256(signal.tobytes() + variance.tobytes()).hexdigest())"
    )
    command = [sys.executable, "-c", code]
    results = [
        subprocess.run(command, env=environment, timeout=100, check=True, capture_output=True).stdout
        for _ in range(2)
    ]
    assert results[0] == results[1]


@pytest.mark.parametrize("dtype", [">f8", "f2"])
def test_arrays_that_numba_does_not_know_are_left_to_numpy(
    dtype: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("numba", reason="numba is not installed: pip install knightcube[fast]")
    monkeypatch.setenv("KNIGHTCUBE_COMPILED", "1")
    hot = HotFunction(sum_of_squares_numpy, sum_of_squares.loop_form)
    values = VALUES.astype(dtype)
    assert hot(values) == pytest.approx(sum_of_squares_numpy(values))
    assert hot(VALUES) == pytest.approx(sum_of_squares_numpy(VALUES))


@pytest.mark.parametrize("module", ["knightcube", "flight.__main__", "knightcube.vision.star_tracker"])
def test_an_import_does_not_load_numba(module: str) -> None:
    """A command that calls no compiled function does not import numba.

    The import of numba takes a third of a second and 100 MB.
    """
    code = f"import sys, {module}; sys.exit('numba' in sys.modules)"
    subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "KNIGHTCUBE_COMPILED": "1"}, timeout=100, check=True
    )


@pytest.mark.parametrize("selected", [True, False])
def test_numba_can_be_loaded_before_the_first_call_of_a_compiled_form(selected: bool) -> None:
    pytest.importorskip("numba", reason="numba is not installed: pip install knightcube[fast]")
    code = "import sys\nfrom knightcube import compiled\ncompiled.load()\nsys.exit('numba' in sys.modules)"
    environment = {**os.environ, "KNIGHTCUBE_COMPILED": str(int(selected)), "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, timeout=100, check=False)
    assert done.returncode == selected


def test_stored_machine_code_can_be_loaded_before_the_first_call(tmp_path: Path) -> None:
    pytest.importorskip("numba", reason="numba is not installed: pip install knightcube[fast]")
    places = {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(ROOT)}
    code = (
        "import sys\nimport numpy as np\nfrom knightcube import compiled\n"
        "from tests.support.compiled_forms import sum_of_squares as hot\n"
        "compiled.load('tests.')\nloaded = len(hot._chosen.overloads)\n"
        "assert hot(np.arange(5.0)) == 30.0\nsys.exit(loaded)"
    )
    found = []
    for damaged in (False, False, True):
        for file in tmp_path.rglob("*.nbi") if damaged else ():
            file.write_bytes(file.read_bytes()[:40])
        done = subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, "KNIGHTCUBE_COMPILED": "1", **places},
            timeout=100,
            check=False,
        )
        found.append(done.returncode)
    assert found == [0, 1, 0]
