"""The few laws of the house that a program can hold, and the sizes that only ever fall.

A size is a ratchet: a change that makes it smaller lowers the number here. Who raises one gives the reason in the commit.
"""

import ast
import re
import tokenize
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "sorvolo"
LONGEST_LINES = 120
DEEPEST_NESTING = 4
SMALL_LINES = 80

MOST_TOKENS = 767_508
MOST_FILES = 481
MOST_PROSE_BYTES = 226_500
MOST_BENCHMARK_LINES = 4_783
MOST_DOUBLE_CLASS_NAMES = 0
MOST_SMALL_NEIGHBOURS = 5

_NESTING = (ast.If, ast.For, ast.AsyncFor, ast.While, ast.Match)  # what a reader must decide
_STRING = r'[rbfu]{0,2}(?:"""(?s:.*?)"""|\'{3}(?s:.*?)\'{3}|"(?:\\.|[^"\\])*"|\'(?:\\.|[^\'\\])*\')'
_NUMBER_OR_SIGN = re.sub(r"(?<!\\)\((?!\?)", "(?:", rf"{tokenize.Number}|\w+|{tokenize.Special}")
_TOKEN = re.compile(rf"#.*|([^\W\d]\w\w+|{_STRING}|{_NUMBER_OR_SIGN})", re.IGNORECASE)
_Function = ast.FunctionDef | ast.AsyncFunctionDef


@cache
def _statements(path: Path) -> list[ast.AST]:
    """A module, and all its statements at any depth."""
    found: list[ast.AST] = [ast.parse(path.read_text())]
    for node in found:
        found.extend(_blocks(node))
    return found


def _blocks(node: ast.AST) -> Iterator[ast.AST]:
    """What is nested in a statement: statements, and the parts of a `try` and a `match`."""
    for name in ("body", "orelse", "handlers", "finalbody", "cases"):
        parts = getattr(node, name, None)
        yield from parts if isinstance(parts, list) else []


def _sources() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def _functions(path: Path) -> Iterator[_Function]:
    for node in _statements(path):
        if isinstance(node, _Function):
            yield node


def _nesting(node: ast.AST) -> int:
    """Return how many blocks are nested in a node at the deepest place; `elif` is no level."""
    deepest = 0
    for child in _blocks(node):
        if isinstance(child, _Function | ast.ClassDef):
            continue
        is_elif = isinstance(node, ast.If) and child in node.orelse and isinstance(child, ast.If)
        level = 1 if isinstance(child, _NESTING) and not is_elif else 0
        deepest = max(deepest, level + _nesting(child))
    return deepest


def _tokens(path: Path) -> int:
    """Count the tokens of a file, comments and docstrings aside."""
    docstrings = sum(
        isinstance(node, ast.Module | ast.ClassDef | _Function)
        and ast.get_docstring(node, False) is not None
        for node in _statements(path)
    )
    return sum(bool(each) for each in _TOKEN.findall(path.read_text())) - docstrings


def test_functions_are_of_a_length_and_depth_that_a_reader_holds() -> None:
    faults = []
    for path in _sources():
        for function in _functions(path):
            lines = (function.end_lineno or function.lineno) - function.lineno + 1
            if lines > LONGEST_LINES or _nesting(function) > DEEPEST_NESTING:
                name = f"{path.relative_to(PACKAGE)}: {function.name}"
                faults.append(f"{name}: {lines} lines, nesting {_nesting(function)}")
    assert not faults, "\n".join(faults)


def test_no_more_public_classes_share_a_name() -> None:
    names = Counter(
        node.name
        for path in _sources()
        for node in _statements(path)[0].body  # type: ignore[attr-defined]
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    double = sorted(name for name, count in names.items() if count > 1)
    assert len(double) <= MOST_DOUBLE_CLASS_NAMES, double


def test_no_more_small_modules_serve_one_neighbour() -> None:
    """A module of a few lines that one module of its own folder imports belongs into that one."""
    importers: dict[str, set[Path]] = {}
    for path in _sources():
        for node in _statements(path):
            if isinstance(node, ast.ImportFrom) and node.module and not node.level:
                for module in (node.module, *(f"{node.module}.{name.name}" for name in node.names)):
                    importers.setdefault(module, set()).add(path)
    small = []
    for path in _sources():
        module = ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
        users = importers.get(module, set())
        is_small = len(path.read_text().splitlines()) < SMALL_LINES and path.name != "__init__.py"
        if is_small and len(users) == 1 and next(iter(users)).parent == path.parent:
            small.append(module)
    assert len(small) <= MOST_SMALL_NEIGHBOURS, small


def test_the_source_does_not_grow() -> None:
    sources = _sources()
    assert len(sources) <= MOST_FILES
    assert sum(map(_tokens, sources)) <= MOST_TOKENS


def test_benchmarks_and_prose_do_not_grow() -> None:
    scripts = (ROOT / "benchmarks").rglob("*.py")
    assert sum(len(path.read_text().splitlines()) for path in scripts) <= MOST_BENCHMARK_LINES
    pages = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
    assert sum(path.stat().st_size for path in pages) <= MOST_PROSE_BYTES


def test_files_of_tests_have_names_of_their_own() -> None:
    """Pytest imports them by their bare names: of two alike it collects one."""
    names = [path.name for path in (ROOT / "tests").rglob("*.py") if path.name != "conftest.py"]
    assert sorted(names) == sorted(set(names))


def test_what_answers_the_questions_of_architecture_is_there() -> None:
    """Each file that ARCHITECTURE.md names exists and defines the name in brackets behind it."""
    text = (ROOT / "ARCHITECTURE.md").read_text()
    named = re.findall(r"`(\w[\w/]*/\w+\.py)`(?: \(`(\w+)`)?", text[text.index("## 3. ") :])
    missing = [f"{path}: {name}" for path, name in named if not _defines(PACKAGE / path, name)]
    assert len(named) > 15 and not missing, missing


def _defines(path: Path, name: str) -> bool:
    if not path.is_file():
        return (ROOT / path.relative_to(PACKAGE)).is_file()
    return bool(re.search(rf"(def|class) {name}\b", path.read_text())) if name else True
