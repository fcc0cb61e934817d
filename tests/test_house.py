"""The few laws of the house that a program can hold, and the sizes that only ever fall.

A size is a ratchet: a change that makes it smaller lowers the number here. Who raises one gives the reason in the commit.
"""

import ast
import io
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

MOST_TOKENS = 782_215
MOST_FILES = 482
MOST_PROSE_BYTES = 227_200
MOST_BENCHMARK_LINES = 4_977
MOST_DOUBLE_CLASS_NAMES = 0
MOST_SMALL_NEIGHBOURS = 5

_NESTING = (ast.If, ast.For, ast.AsyncFor, ast.While, ast.Match)  # what a reader must decide
_NO_CODE = {
    tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.ENCODING, tokenize.ENDMARKER,
    tokenize.INDENT, tokenize.DEDENT,
}  # fmt: skip
_Function = ast.FunctionDef | ast.AsyncFunctionDef


@cache
def _parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


def _sources() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def _functions(path: Path) -> Iterator[_Function]:
    for node in ast.walk(_parsed(path)):
        if isinstance(node, _Function):
            yield node


def _nesting(node: ast.AST) -> int:
    """Return how many blocks are nested in a node at the deepest place; `elif` is no level."""
    deepest = 0
    for name, value in ast.iter_fields(node):
        for child in value if isinstance(value, list) else [value]:
            if not isinstance(child, ast.AST) or isinstance(child, _Function | ast.ClassDef):
                continue
            is_elif = name == "orelse" and isinstance(node, ast.If) and isinstance(child, ast.If)
            level = 1 if isinstance(child, _NESTING) and not is_elif else 0
            deepest = max(deepest, level + _nesting(child))
    return deepest


def _tokens(path: Path) -> int:
    docstrings = {
        node.body[0].lineno
        for node in ast.walk(_parsed(path))
        if isinstance(node, ast.Module | ast.ClassDef | _Function)
        and ast.get_docstring(node, False) is not None
    }
    return sum(
        token.type not in _NO_CODE
        and not (token.type == tokenize.STRING and token.start[0] in docstrings)
        for token in tokenize.generate_tokens(io.StringIO(path.read_text()).readline)
    )


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
        for node in _parsed(path).body
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    double = sorted(name for name, count in names.items() if count > 1)
    assert len(double) <= MOST_DOUBLE_CLASS_NAMES, double


def test_no_more_small_modules_serve_one_neighbour() -> None:
    """A module of a few lines that one module of its own folder imports belongs into that one."""
    importers: dict[str, set[Path]] = {}
    for path in _sources():
        for node in ast.walk(_parsed(path)):
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
