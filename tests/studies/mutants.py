"""Fraction of random one-line faults that the fast tests find: `python -m tests.studies mutants`.

Each mutant changes one expression on one line of product code and is tested in a temporary copy of the
repository: the tracked files with their uncommitted changes. The fast tests of the mirrored file run first,
then those of the mirrored folder, up to the first failure. A test is fast if all its cases together take at
most two seconds of processor time, by the list slow.txt. A failure counts if the same test passes on the
unchanged code.

Docstrings, strings, annotations, decorators, imports, `raise` statements and the `strict` of `zip` are not
changed. Known equivalent mutants are listed in `equivalent_mutants.yaml`, each with a reason.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import copy
import json
import os
import random
import resource
import signal
import subprocess
import sys
import tarfile
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import asdict, dataclass, field
from pathlib import Path
from queue import SimpleQueue

import yaml

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


class MutantsError(Exception):
    """Error for a wrong option, or for a repository that cannot be copied."""


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


def main(arguments: Sequence[str] | None = None, root: Path = ROOT) -> int:
    """Draw mutants, test them and print the result. Returns 0, 2 for wrong use, or 130 after Ctrl-C."""
    options = _parser().parse_args(arguments)
    known = {
        (entry["line"], entry["mutant"]): entry["reason"]
        for entry in yaml.safe_load(EQUIVALENT.read_text(encoding="utf-8")) or ()
    }
    verdicts: list[Verdict] = []
    try:
        mutants = draw(root, options.count, options.seed, options.only)
        out = options.out or root / "runs" / "mutants" / f"seed-{options.seed}.jsonl"
        out.parent.mkdir(parents=True, exist_ok=True)
        begun = time.perf_counter()
        with out.open("w", encoding="utf-8") as sink:
            for verdict in judge(root, mutants, known, options.workers):
                verdicts.append(verdict)
                sink.write(json.dumps(asdict(verdict)) + "\n")
                sink.flush()
                spent = time.perf_counter() - begun
                ahead = spent / len(verdicts) * (len(mutants) - len(verdicts))
                line = (
                    f"{len(verdicts)}/{len(mutants)} {verdict.result}, {ahead:.0f} s left: {verdict.mutant}"
                )
                sys.stderr.write(line + "\n")
    except MutantsError as error:
        sys.stderr.write(f"mutants: {error}\n")
        return 2
    except KeyboardInterrupt:
        sys.stderr.write(f"\nstopped after {len(verdicts)} of {len(mutants)} mutants; results are in {out}\n")
        _report(verdicts, options.json)
        return 130
    _report(verdicts, options.json)
    return 0


def draw(root: Path, count: int, seed: int, only: Sequence[str] = ()) -> list[Mutant]:
    """Return random mutants, at most one for each line of product code.

    `only` names files or folders; FILE:LINE gives every mutant of one line. Raises MutantsError if a path of
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
            raise MutantsError(f"--only {name}: there is no product code that can be changed")
        if line:
            whole += [mutant for mutants in found.values() for mutant in mutants]
        else:
            places |= found
    chance = random.Random(seed)
    drawn = chance.sample(sorted(places), min(count, len(places)))
    return whole + [chance.choice(places[place]) for place in drawn]


def mutants_of(source: str, path: str) -> list[Mutant]:
    """Return every mutant of a module's source."""
    finder = _Finder(source, path)
    finder.visit(ast.parse(source))
    return finder.found


class _Finder(ast.NodeVisitor):
    """Visitor that collects the mutants of a syntax tree."""

    def __init__(self, source: str, path: str) -> None:
        self._lines = source.splitlines()
        self._path = path
        self.found: list[Mutant] = []

    def _add(self, node: ast.expr | ast.stmt, kind: str, changed: ast.AST | str) -> None:
        """Add the mutant that replaces `node`, if the node is on a single line."""
        if node.end_lineno != node.lineno or node.end_col_offset is None:
            return
        text = changed if isinstance(changed, str) else f"({ast.unparse(changed)})"
        line = self._lines[node.lineno - 1]
        raw = line.encode()
        after = (raw[: node.col_offset] + text.encode() + raw[node.end_col_offset :]).decode()
        place = (node.lineno, node.col_offset, node.end_col_offset)
        self.found.append(Mutant(self._path, *place, kind, text, line.strip(), after.strip()))

    def _visit_all(self, nodes: Sequence[ast.AST | None]) -> None:
        for node in nodes:
            if node is not None:
                self.visit(node)

    def visit_FunctionDef(self, node: ast.FunctionDef | ast.AsyncFunctionDef) -> None:
        """Visit defaults and body, not decorators and annotations."""
        self._visit_all([*node.args.defaults, *node.args.kw_defaults, *node.body])

    visit_AsyncFunctionDef = visit_FunctionDef

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        """Visit the body only."""
        self._visit_all(node.body)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        """Visit the value only."""
        self._visit_all([node.value])

    def visit_Assign(self, node: ast.Assign) -> None:
        """Visit an assignment unless it names a type."""
        value = node.value
        union = isinstance(value, ast.BinOp) and isinstance(value.op, ast.BitOr)
        if not (node.col_offset == 0 and (union or isinstance(value, ast.Subscript))):
            self.generic_visit(node)

    def _skip(self, node: ast.AST) -> None:
        """Leave a node and its parts unchanged."""

    visit_Import = visit_ImportFrom = visit_JoinedStr = visit_Raise = _skip

    def visit_If(self, node: ast.If) -> None:
        """Negate the condition; skip imports for types and the main block."""
        text = ast.unparse(node.test)
        if text in {"TYPE_CHECKING", "__name__ == '__main__'"}:
            return
        self._negate(node.test)
        self.generic_visit(node)

    def visit_While(self, node: ast.While) -> None:
        """Negate the condition."""
        self._negate(node.test)
        self.generic_visit(node)

    def visit_IfExp(self, node: ast.IfExp) -> None:
        """Negate the condition."""
        self._negate(node.test)
        self.generic_visit(node)

    def visit_comprehension(self, node: ast.comprehension) -> None:
        """Negate the conditions."""
        for test in node.ifs:
            self._negate(test)
        self.generic_visit(node)

    def _negate(self, test: ast.expr) -> None:
        if isinstance(test, ast.UnaryOp) and isinstance(test.op, ast.Not):
            self._add(test, "not removed", test.operand)
        elif not isinstance(test, ast.Compare | ast.Constant):
            self._add(test, "not added", ast.UnaryOp(ast.Not(), test))

    def visit_Compare(self, node: ast.Compare) -> None:
        """Invert and shift each comparison."""
        for index, operator in enumerate(node.ops):
            for other in _COMPARISONS[type(operator)]:
                changed = copy.copy(node)
                changed.ops = [*node.ops[:index], other(), *node.ops[index + 1 :]]
                self._add(node, "comparison", changed)
        self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        """Swap the arithmetic operator."""
        if type(node.op) in _ARITHMETIC:
            other = _ARITHMETIC[type(node.op)]()
            self._add(node, "operator", ast.BinOp(node.left, other, node.right))
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        """Remove a minus sign."""
        if isinstance(node.op, ast.USub):
            self._add(node, "minus removed", node.operand)
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        """Swap `and` and `or`."""
        other = ast.Or() if isinstance(node.op, ast.And) else ast.And()
        self._add(node, "boolean operator", ast.BoolOp(other, node.values))
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        """Change a number or a truth value."""
        value = node.value
        if isinstance(value, bool):
            self._add(node, "constant", str(not value))
        elif isinstance(value, int):
            # Adding 1 ns to 2 s would have no effect.
            self._add(node, "constant", str(value + max(1, value // 2)))
        elif isinstance(value, float):
            self._add(node, "constant", repr(1.5 * value if value else 1.0))

    def visit_Return(self, node: ast.Return) -> None:
        """Return None instead of a value."""
        if node.value is not None and not isinstance(node.value, ast.Constant):
            self._add(node, "return value", "return None")
        self.generic_visit(node)

    def visit_Expr(self, node: ast.Expr) -> None:
        """Remove a statement that is a call."""
        if isinstance(node.value, ast.Call):
            self._add(node, "call removed", "pass")
        self.generic_visit(node)

    def visit_keyword(self, node: ast.keyword) -> None:
        """Visit a keyword argument unless it only checks lengths."""
        if node.arg != "strict":
            self.generic_visit(node)


def mirrored_tests(root: Path, path: str) -> list[str]:
    """Return the test files that may find a fault of a module.

    The mirrored file comes first, then the other files of the mirrored folder, beginning with those that
    import the module. If `tests` has no folder with the same path, the mirrored folder is that of the nearest
    parent.
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
    """A copy of the repository in which one mutant at a time is tested."""

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
    """Yield the result of each mutant when it is ready.

    `known` maps the line before and after the change to the reason why the mutant is equivalent. These
    mutants are not run. Raises MutantsError if git cannot copy the repository.
    """
    for mutant in mutants:
        if (mutant.before, mutant.after) in known:
            yield Verdict(mutant, "equivalent", known[mutant.before, mutant.after])
    waiting = iter([mutant for mutant in mutants if (mutant.before, mutant.after) not in known])
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
        running: set[Future[Verdict]] = set()
        try:
            for mutant in waiting:
                running.add(pool.submit(tested, mutant))
                if len(running) == workers:
                    done, running = wait(running, return_when=FIRST_COMPLETED)
                    for future in done:
                        yield future.result()
            while running:
                done, running = wait(running, return_when=FIRST_COMPLETED)
                for future in done:
                    yield future.result()
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
            raise MutantsError(f"git {arguments[0]}: {(done.stderr.strip().splitlines() or ['failed'])[-1]}")
        return done.stdout.strip()

    archive = folder.with_suffix(".tar")
    git("archive", "--format=tar", f"--output={archive}", git("stash", "create") or "HEAD")
    with tarfile.open(archive) as tar:
        tar.extractall(folder, filter="data")
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
        sys.stdout.write(json.dumps(facts | {"killed_share": share, "survivors": survivors}) + "\n")
        return
    for result in ("survived", "equivalent"):
        for verdict in sorted(by_result[result], key=lambda verdict: str(verdict.mutant)):
            sys.stdout.write(f"{result}: {verdict.mutant}\n")
    counts = ", ".join(f"{len(found)} {result}" for result, found in by_result.items())
    sys.stdout.write(f"{len(verdicts)} mutants: {counts}; {share:.0%} of {judged} killed\n")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tests.studies mutants", description=__doc__)
    parser.add_argument("--count", type=int, default=200, metavar="N", help="mutants to draw (default 200)")
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="seed of the draw (default 1)")
    parser.add_argument(
        "--only", nargs="+", default=(), metavar="PATH", help="files or folders; FILE:LINE tries a whole line"
    )
    parser.add_argument(
        "--workers", type=int, choices=(1, 2), default=1, help="mutants at a time (default 1)"
    )
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="results (default runs/mutants/seed-S.jsonl)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of text")
    return parser


if __name__ == "__main__":
    sys.exit(main())
