"""Tests of `python -m tests.studies mutants` on a small repository, and of mutants of small sources."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest
import yaml

from tests.studies import mutants
from tests.studies.mutants import EQUIVALENT, ROOT, draw, main, mirrored_tests, mutants_of

PRODUCT = '''"""A module."""


def larger(first: float, second: float) -> bool:
    """Compare."""
    return first > second


def unseen(number: int) -> int:
    return number + 7


def halve(number: int) -> int:
    """Halve until 0; a mutant of the loop never ends."""
    while number > 0:
        number = number // 2
    return number
'''
TEST = """from knightcube.product import larger


def test_broken_without_a_mutant():
    assert larger(1, 2)


def test_larger():
    assert larger(2, 1) and not larger(1, 2) and not larger(2, 2)
"""
OTHER_TEST = """from knightcube.product import halve


def test_halve():
    assert halve(8) == 0
"""


@pytest.fixture
def repository(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a repository with one module and its tests; one of the tests fails."""
    # The import of the installed plugins would take half of each run.
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    root = tmp_path / "repository"
    files = {
        "knightcube/__init__.py": "",
        "knightcube/product.py": PRODUCT,
        "tests/knightcube/test_product.py": TEST,
        "tests/knightcube/test_of_another_module.py": OTHER_TEST,
        "pyproject.toml": '[tool.pytest.ini_options]\nmarkers = ["slow"]\naddopts = "-p no:cacheprovider"\n',
    }
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text, encoding="utf-8")
    git = ["git", "-c", "user.name=a", "-c", "user.email=a@b.c", "-C", str(root)]
    for words in (["init", "-q"], ["add", "."], ["commit", "-q", "-m", "Begin"]):
        subprocess.run([*git, *words], check=True)
    return root


def changes(source: str) -> set[str]:
    """Return the changed lines of a source's mutants."""
    return {mutant.after for mutant in mutants_of(source, "knightcube/a.py")}


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("a = b < c", {"a = (b >= c)", "a = (b <= c)"}),
        ("a = b is None", {"a = (b is not None)"}),
        ("a = b * c", {"a = (b / c)"}),
        ("a = -b", {"a = (b)"}),
        ("a = 0.25", {"a = 0.375"}),
        ("a = 3", {"a = 4"}),
        ("a = True", {"a = False"}),
        ("if a:\n    pass", {"if (not a):"}),
        ("if not a:\n    pass", {"if (a):"}),
        ("a = b and c", {"a = (b or c)"}),
        ("def f():\n    return a", {"return None"}),
        ("f(a)", {"pass"}),
        ("ä = 'ä' + b", {"ä = ('ä' - b)"}),
    ],
)
def test_one_line_is_changed(source: str, expected: set[str]) -> None:
    """Check each kind of change that makes a mutant."""
    assert changes(source) == expected


@pytest.mark.parametrize(
    "source",
    [
        '"""Text of 3 lines."""',
        "from a import b",
        "a: Literal[3]",
        "def f(a: Literal[3]) -> Literal[4]: ...",
        "@f(3)\nclass A: ...",
        "raise A(3)",
        "a = f'{3:.1f}'",
        "if TYPE_CHECKING:\n    a = 3",
        "A = B | None",
        "zip(a, b, strict=True)[b]",
        "a = (b <\n     c)",
    ],
)
def test_a_change_without_an_effect_is_not_a_mutant(source: str) -> None:
    """Annotations, text, imports and changes over several lines give no mutant."""
    assert not changes(source)


def test_killed_survived_and_equivalent(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Check the result of each mutant and the file of results, and that the checkout is unchanged.

    A test that always fails kills no mutant.
    """
    known = tmp_path / "known.yaml"
    known.write_text(
        "- {line: return number + 7, mutant: return None, reason: nobody reads it}\n", encoding="utf-8"
    )
    monkeypatch.setattr(mutants, "ROOT", repository)
    monkeypatch.setattr(mutants, "EQUIVALENT", known)
    monkeypatch.setattr(mutants, "LIMIT_S", 300.0)
    out = tmp_path / "results.jsonl"
    assert main(["--only", "knightcube/product.py:6", "--out", str(out), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["killed"], facts["survived"], facts["equivalent"]) == (3, 0, 0)
    results = [json.loads(line) for line in out.read_text(encoding="utf-8").splitlines()]
    assert {result["reason"] for result in results} == {"tests/knightcube/test_product.py::test_larger"}
    assert main(["--only", "knightcube/product.py:10", "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert "survived: knightcube/product.py:10: operator: return number + 7  ->  return (number - 7)" in text
    assert "3 mutants: 0 killed, 2 survived, 1 equivalent; 0% of 2 killed" in text
    assert (repository / "knightcube/product.py").read_text(encoding="utf-8") == PRODUCT


def test_a_hang_is_killed(repository: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The time limit kills a mutant with an endless loop, in a test file other than that of the module."""
    monkeypatch.setattr(mutants, "LIMIT_S", 3.0)
    found = mutants_of(PRODUCT, "knightcube/product.py")
    [endless] = [mutant for mutant in found if mutant.text == "(number >= 0)"]
    [verdict] = mutants.judge(repository, [endless], {})
    assert (verdict.result, verdict.reason) == ("killed", "hang: not done after 3 s")


def test_draw_depends_on_the_seed_only() -> None:
    """No line is drawn twice, and the same seed draws the same lines."""
    only = ["knightcube/astro", "hal/drivers"]
    drawn = draw(ROOT, 100, 5, only)
    assert drawn == draw(ROOT, 100, 5, only) != draw(ROOT, 100, 6, only)
    assert len({(mutant.path, mutant.line) for mutant in drawn}) == 100
    assert {mutant.path.partition("/")[0] for mutant in drawn} == {"knightcube", "hal"}


def test_wrong_path_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    """The error is one line that names the path."""
    assert main(["--only", "knightcube/none.py"]) == 2
    assert capsys.readouterr().err.startswith("mutants: --only knightcube/none.py:")


def test_mirrored_tests_come_first() -> None:
    """The mirrored file comes first, then the files that import the module, then all others of the folder."""
    tests = mirrored_tests(ROOT, "knightcube/astro/quaternion.py")
    assert tests[0] == "tests/knightcube/astro/test_quaternion.py"
    assert all(name.startswith("tests/knightcube/astro/") for name in tests)


def test_equivalent_mutants_have_reasons() -> None:
    """Check each entry of the committed list."""
    entries = yaml.safe_load(EQUIVALENT.read_text(encoding="utf-8"))
    assert all(len(entry["reason"].split()) >= 4 for entry in entries)


def test_slice_of_product_code(tmp_path: Path) -> None:
    """Any test of the two mutated functions detects that they return None."""
    drawn = draw(ROOT, 400, 1, ["knightcube/astro/inertia.py"])
    found = [one for one in drawn if one.text == "return None"][:2]
    assert len(found) == 2
    assert [verdict.result for verdict in mutants.judge(ROOT, found, {})] == ["killed", "killed"]
