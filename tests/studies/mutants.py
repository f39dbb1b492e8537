"""Fraction of random one-line faults that the fast tests find.

Each mutant changes one expression on one line of product code. It is tested in a temporary copy of the
repository: the tracked files with their uncommitted changes. The fast tests of the mirrored file run first,
then the fast tests of the mirrored folder, up to the first failure. A test is fast if all its cases together
take at most two seconds of processor time, by the list slow.txt. A failure counts if the same test passes on
the unchanged code.

Docstrings, strings, annotations, decorators, imports, `raise` statements and the argument `strict` of `zip`
are not changed. Known equivalent mutants are listed in `equivalent_mutants.yaml`, each with a reason.
"""

from __future__ import annotations

import ast
import contextlib
import copy
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from json import dumps
from pathlib import Path
from queue import SimpleQueue
from typing import Annotated, Literal

import yaml

from knightcube.errors import UsageError
from tests.studies.command import Json, Seed, command, say

ROOT = Path(__file__).resolve().parents[2]
EQUIVALENT = Path(__file__).with_name("equivalent_mutants.yaml")
PACKAGES = ("knightcube", "flight", "hal", "sim_hal", "ground")
LIMIT_S = 600.0  # time limit (s) for the tests of one mutant; a longer run counts as a hang
SLOW_S = 2.0  # processor time (s) of a listed test function above which it is left out
MEMORY = 6 << 30  # largest memory (bytes) that the tests of a mutant may allocate
_COMPARISONS: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.GtE, ast.LtE),
    ast.LtE: (ast.Gt, ast.Lt),
    ast.Gt: (ast.LtE, ast.GtE),
    ast.GtE: (ast.Lt, ast.Gt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
_ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.Pow: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
}


@dataclass(frozen=True)
class Mutant:
    """A change on one line: the bytes `begin` to `end` of the line are replaced by `text`."""

    path: str
    line: int
    begin: int
    end: int
    kind: str
    text: str
    before: str
    after: str

    def __str__(self) -> str:
        """Return file, line and change as text on one line."""
        return f"{self.path}:{self.line}: {self.kind}: {self.before}  ->  {self.after}"


@dataclass
class Verdict:
    """The result of one mutant: `killed`, `survived` or `equivalent`, and the test or the reason."""

    mutant: Mutant
    result: str
    reason: str = ""


@command
def main(
    *,
    count: Annotated[int, "mutants to draw"] = 200,
    seed: Seed = 1,
    only: Annotated[tuple[str, ...], "files or folders; FILE:LINE tries a whole line"] = (),
    workers: Annotated[Literal[1, 2], "mutants at a time"] = 1,
    out: Annotated[Path | None, "file of the results (default runs/mutants/seed-S.jsonl)"] = None,
    json: Json = False,
) -> int:
    """Draw mutants, test them and print the result. Returns 0, 2 for wrong use, or 130 after Ctrl-C."""
    known = {
        (entry["line"], entry["mutant"]): entry["reason"]
        for entry in yaml.safe_load(EQUIVALENT.read_text(encoding="utf-8")) or ()
    }
    mutants, verdicts, status = draw(ROOT, count, seed, only), list[Verdict](), 0
    out = out or ROOT / "runs" / "mutants" / f"seed-{seed}.jsonl"
    out.parent.mkdir(parents=True, exist_ok=True)
    begun = time.perf_counter()
    try:
        with out.open("w", encoding="utf-8") as sink:
            for verdict in judge(ROOT, mutants, known, workers):
                verdicts.append(verdict)
                sink.write(dumps(asdict(verdict)) + "\n")
                sink.flush()
                ahead = (time.perf_counter() - begun) / len(verdicts) * (len(mutants) - len(verdicts))
                done = f"{len(verdicts)}/{len(mutants)} {verdict.result}, {ahead:.0f} s left"
                sys.stderr.write(f"{done}: {verdict.mutant}\n")
    except KeyboardInterrupt:
        sys.stderr.write(f"\nstopped after {len(verdicts)} of {len(mutants)} mutants; results are in {out}\n")
        status = 130
    _report(verdicts, json)
    return status


def draw(root: Path, count: int, seed: int, only: Sequence[str] = ()) -> list[Mutant]:
    """Return random mutants, at most one for each line of product code.

    `only` names files or folders; FILE:LINE gives every mutant of one line. Raises UsageError if a path of
    `only` has no code to change.
    """
    paths = sorted(
        path.relative_to(root).as_posix() for package in PACKAGES for path in (root / package).rglob("*.py")
    )
    places: dict[tuple[str, int], list[Mutant]] = {}
    whole: list[Mutant] = []
    for name in only or PACKAGES:
        wanted, _, line = name.partition(":")
        wanted = wanted.rstrip("/")
        found: dict[tuple[str, int], list[Mutant]] = {}
        for path in paths:
            if path == wanted or path.startswith(f"{wanted}/"):
                for mutant in mutants_of((root / path).read_text(encoding="utf-8"), path):
                    if not line or mutant.line == int(line):
                        found.setdefault((path, mutant.line), []).append(mutant)
        if not found and only:
            raise UsageError(f"--only {name}: there is no product code that can be changed")
        if line:
            whole += [mutant for mutants in found.values() for mutant in mutants]
        else:
            places |= found
    chance = random.Random(seed)
    drawn = chance.sample(sorted(places), min(count, len(places)))
    return whole + [chance.choice(places[place]) for place in drawn]


def mutants_of(source: str, path: str) -> list[Mutant]:
    """Return every mutant of a module's source."""
    lines, found = source.splitlines(), list[Mutant]()
    nodes: list[ast.AST] = [ast.parse(source)]
    while nodes:
        node = nodes.pop()
        if _is_fixed(node):
            continue
        for part, kind, changed in _changes(node):
            if part.end_lineno != part.lineno or part.end_col_offset is None:
                continue  # over several lines
            text = changed if isinstance(changed, str) else f"({ast.unparse(changed)})"
            line = lines[part.lineno - 1]
            raw = line.encode()
            after = (raw[: part.col_offset] + text.encode() + raw[part.end_col_offset :]).decode()
            place = (part.lineno, part.col_offset, part.end_col_offset)
            found.append(Mutant(path, *place, kind, text, line.strip(), after.strip()))
        nodes += reversed([part for part in _parts(node) if part is not None])
    return found


def _is_fixed(node: ast.AST) -> bool:
    """Return whether a node with all its parts is never changed: imports, messages, types, main block."""
    match node:
        case ast.Import() | ast.ImportFrom() | ast.JoinedStr() | ast.Raise() | ast.keyword(arg="strict"):
            return True
        case ast.Assign(col_offset=0, value=ast.BinOp(op=ast.BitOr()) | ast.Subscript()):
            return True
        case ast.If():
            return ast.unparse(node.test) in {"TYPE_CHECKING", "__name__ == '__main__'"}
    return False


def _parts(node: ast.AST) -> Iterable[ast.AST | None]:
    """Return the parts of a node that may change: no decorators and annotations."""
    match node:
        case ast.FunctionDef() | ast.AsyncFunctionDef():
            return [*node.args.defaults, *node.args.kw_defaults, *node.body]
        case ast.ClassDef():
            return node.body
        case ast.AnnAssign():
            return [node.value]
    return ast.iter_child_nodes(node)


def _changes(node: ast.AST) -> Iterator[tuple[ast.expr | ast.stmt, str, ast.AST | str]]:
    """Yield each change of a node: the changed part, the kind of change, and the new code."""
    match node:
        case ast.If(test=test) | ast.While(test=test) | ast.IfExp(test=test):
            yield from _negated(test)
        case ast.comprehension(ifs=tests):
            for test in tests:
                yield from _negated(test)
        case ast.Compare():
            for index, operator in enumerate(node.ops):
                for other in _COMPARISONS[type(operator)]:
                    changed = copy.copy(node)
                    changed.ops = [*node.ops[:index], other(), *node.ops[index + 1 :]]
                    yield node, "comparison", changed
        case ast.BinOp() if type(node.op) in _ARITHMETIC:
            yield node, "operator", ast.BinOp(node.left, _ARITHMETIC[type(node.op)](), node.right)
        case ast.UnaryOp(op=ast.USub()):
            yield node, "minus removed", node.operand
        case ast.BoolOp():
            other_word = ast.Or() if isinstance(node.op, ast.And) else ast.And()
            yield node, "boolean operator", ast.BoolOp(other_word, node.values)
        case ast.Constant(value=bool() | int() | float() as value):
            yield node, "constant", _other(value)
        case ast.Return(value=ast.expr() as given) if not isinstance(given, ast.Constant):
            yield node, "return value", "return None"
        case ast.Expr(value=ast.Call()):
            yield node, "call removed", "pass"


def _other(value: float) -> str:
    """Return a value of the same type that differs enough; adding 1 ns to 2 s would have no effect."""
    if isinstance(value, bool):
        return str(not value)
    if isinstance(value, int):
        return str(value + max(1, value // 2))
    return repr(1.5 * value if value else 1.0)


def _negated(test: ast.expr) -> Iterator[tuple[ast.expr, str, ast.AST]]:
    if isinstance(test, ast.UnaryOp) and isinstance(test.op, ast.Not):
        yield test, "not removed", test.operand
    elif not isinstance(test, ast.Compare | ast.Constant):
        yield test, "not added", ast.UnaryOp(ast.Not(), test)


def mirrored_tests(root: Path, path: str) -> list[str]:
    """Return the test files that may find a fault of a module.

    The mirrored file comes first, then the other files of the mirrored folder, beginning with those that
    import the module. If `tests` has no folder with the same path, the folder of the nearest parent is the
    mirrored folder.
    """
    module = Path(path)
    mirror = root / "tests" / module.parent
    while not mirror.is_dir():
        mirror = mirror.parent
    own = mirror / f"test_{module.stem.strip('_')}.py"
    dotted = path.removesuffix("/__init__.py").removesuffix(".py").replace("/", ".")
    package, _, name = dotted.rpartition(".")

    def rank(file: Path) -> tuple[bool, bool, bool, str]:
        text = file.read_text(encoding="utf-8")
        imports = dotted in text or (f"from {package} import" in text and name in text)
        return file != own, not imports, file.parent != mirror, file.as_posix()

    return [file.relative_to(root).as_posix() for file in sorted(mirror.rglob("test_*.py"), key=rank)]


@dataclass
class _Copy:
    """A copy of the repository in which mutants are tested one at a time."""

    folder: Path
    environment: dict[str, str]
    deselected: list[str] = field(default_factory=list)
    stopped: bool = False
    _sound: set[str] = field(default_factory=set)
    _process: subprocess.Popen[str] | None = None
    _writes: int = 0

    def stop(self) -> None:
        """Stop the running tests, and do not start others."""
        self.stopped = True
        if self._process is not None:
            _kill_group(self._process)

    def judge(self, mutant: Mutant) -> Verdict:
        """Test a mutant. Failures that also occur on the unchanged code do not count."""
        tests = mirrored_tests(self.folder, mutant.path)
        original = (self.folder / mutant.path).read_text(encoding="utf-8")
        lines = original.splitlines(keepends=True)
        raw = lines[mutant.line - 1].encode()
        lines[mutant.line - 1] = (raw[: mutant.begin] + mutant.text.encode() + raw[mutant.end :]).decode()
        while True:
            self._write(mutant.path, "".join(lines))
            try:
                failure = self._first_failure(tests[:1]) or self._first_failure(tests[1:])
            finally:
                self._write(mutant.path, original)
            if failure is None or failure in self.deselected:
                return Verdict(mutant, "survived", f"{len(tests)} test files of {Path(mutant.path).parent}")
            if "::" not in failure and not failure.endswith(".py"):
                return Verdict(mutant, "killed", failure)
            if failure in self._sound or self._first_failure([failure]) is None:
                self._sound.add(failure)
                return Verdict(mutant, "killed", failure)
            self.deselected.append(failure)

    def _write(self, path: str, text: str) -> None:
        """Write a module with a new modification time.

        Python recognises stale bytecode by the modification time in seconds and by the size of the module.
        """
        (self.folder / path).write_text(text, encoding="utf-8")
        self._writes += 1
        os.utime(self.folder / path, times=(1e9 + self._writes, 1e9 + self._writes))

    def _first_failure(self, tests: Sequence[str]) -> str | None:
        """Return the test function or file that fails, or the kind of failure; None if the tests pass."""
        options = ["-x", "-q", "-m", "not slow", "--no-header", "-rfE", "--tb=no", "-p", "no:xdist"]
        for name in self.deselected:
            options += ["--deselect", name]
        tests = [name for name in tests if name not in self.deselected]
        if self.stopped:
            return "stopped"
        if not tests:
            return None
        process = self._process = subprocess.Popen(
            ["nice", sys.executable, "-m", "pytest", *options, *tests],
            cwd=self.folder,
            env=self.environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            text=True,
            start_new_session=True,
        )
        with process:
            resource.prlimit(process.pid, resource.RLIMIT_DATA, (MEMORY, MEMORY))
            try:
                output, _ = process.communicate(timeout=LIMIT_S)
            except subprocess.TimeoutExpired:
                return f"hang: not done after {LIMIT_S:g} s"
            finally:
                _kill_group(process)
        if process.returncode in (0, 5):  # pytest's exit codes: 0 all passed, 5 no test was selected
            return None
        for line in output.splitlines():
            if line.startswith(("FAILED ", "ERROR ")):
                return line.split(" ", 1)[1].partition(" - ")[0].partition("[")[0].strip()
        return f"pytest ended with status {process.returncode}"


def _kill_group(process: subprocess.Popen[str]) -> None:
    """End the tests with every process that they started."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def judge(
    root: Path, mutants: Sequence[Mutant], known: dict[tuple[str, str], str], workers: int = 1
) -> Iterator[Verdict]:
    """Yield the result of each mutant.

    `known` maps the line before and after the change to the reason why the mutant is equivalent. These
    mutants are not run. Raises UsageError if git cannot copy the repository.
    """
    for mutant in mutants:
        if (mutant.before, mutant.after) in known:
            yield Verdict(mutant, "equivalent", known[mutant.before, mutant.after])
    waiting = [mutant for mutant in mutants if (mutant.before, mutant.after) not in known]
    with tempfile.TemporaryDirectory(prefix="mutants-", ignore_cleanup_errors=True) as temporary:
        copies = [_copied(root, Path(temporary) / f"copy-{index}") for index in range(workers)]
        free: SimpleQueue[_Copy] = SimpleQueue()
        for copied in copies:
            free.put(copied)

        def tested(mutant: Mutant) -> Verdict:
            copied = free.get()
            try:
                return copied.judge(mutant)
            finally:
                free.put(copied)

        pool = ThreadPoolExecutor(workers)
        try:
            yield from pool.map(tested, waiting)
        finally:
            # The tests run in sessions of their own, so Ctrl-C does not reach them.
            for copied in copies:
                copied.stop()
            pool.shutdown(cancel_futures=True)


def _copied(root: Path, folder: Path) -> _Copy:
    """Return a copy of the tracked files with their uncommitted changes."""

    def git(*arguments: str) -> str:
        done = subprocess.run(["git", *arguments], cwd=root, capture_output=True, text=True, check=False)
        if done.returncode:
            raise UsageError(f"git {arguments[0]}: {(done.stderr.strip().splitlines() or ['failed'])[-1]}")
        return done.stdout.strip()

    archive = folder.with_suffix(".tar")
    git("archive", "--format=tar", f"--output={archive}", git("stash", "create") or "HEAD")
    folder.mkdir(exist_ok=True)
    subprocess.run(["tar", "--extract", f"--file={archive}", f"--directory={folder}"], check=True)
    archive.unlink()
    # This list would put the longest test files first.
    (folder / "tests" / "order.txt").unlink(missing_ok=True)
    listed = folder / "tests" / "slow.txt"
    if listed.exists():
        lines = listed.read_text(encoding="utf-8").splitlines(keepends=True)
        listed.write_text("".join(line for line in lines if float(line.split()[-1]) > SLOW_S), "utf-8")
    environment = {**os.environ, "PYTHONPATH": str(folder), "OPENBLAS_NUM_THREADS": "1"}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    return _Copy(folder, environment)


def _report(verdicts: Sequence[Verdict], as_json: bool) -> None:
    """Print counts, survivors and equivalent mutants."""
    by_result = {
        result: [verdict for verdict in verdicts if verdict.result == result]
        for result in ("killed", "survived", "equivalent")
    }
    judged = len(by_result["killed"]) + len(by_result["survived"])
    share = len(by_result["killed"]) / judged if judged else 1.0
    if as_json:
        facts = {result: len(found) for result, found in by_result.items()}
        survivors = [str(verdict.mutant) for verdict in by_result["survived"]]
        say(**facts, killed_share=share, survivors=survivors)
        return
    for result in ("survived", "equivalent"):
        for verdict in sorted(by_result[result], key=lambda verdict: str(verdict.mutant)):
            sys.stdout.write(f"{result}: {verdict.mutant}\n")
    counts = ", ".join(f"{len(found)} {result}" for result, found in by_result.items())
    sys.stdout.write(f"{len(verdicts)} mutants: {counts}; {share:.0%} of {judged} killed\n")


if __name__ == "__main__":
    sys.exit(main())
