"""The house as ARCHITECTURE.md draws it: every file named once, and functions that a reader holds in one look."""

import ast
import gc
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "sorvolo"
LONGEST_LINES = 60
COMPLEX_ABOVE = 10
COMPLEX_SHARE = 0.03


def _files() -> set[str]:
    return {
        path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("*")
        if path.suffix in (".py", ".cpp", ".hpp") and not (path.name == "__init__.py" and path.parent != PACKAGE)
    }


def _drawn() -> list[str]:
    """The files of ARCHITECTURE.md's tree, by the folder under which they stand."""
    text = (ROOT / "ARCHITECTURE.md").read_text()
    tree = text[text.index("    src/sorvolo/\n"):]
    tree = tree[:re.search(r"^\S", tree, re.MULTILINE).start()]  # type: ignore[union-attr]
    folders: list[tuple[int, str]] = []
    found = []
    for line in tree.splitlines()[1:]:
        if not (entry := re.match(r"^( {6,14})([\w./-]+)(?: |$)", line)):
            continue
        indent, name = len(entry[1]), entry[2]
        folders = [each for each in folders if each[0] < indent]
        if name.endswith("/"):
            folders.append((indent, name))
        elif "." in name:
            found.append("".join(each[1] for each in folders) + name)
    return found


def test_every_file_stands_in_the_tree_and_every_line_of_the_tree_is_a_file() -> None:
    drawn = _drawn()
    assert len(drawn) == len(set(drawn))
    assert set(drawn) == _files()


def test_what_answers_the_questions_of_architecture_is_there() -> None:
    """Each file that section 1 names exists, and defines the name in brackets behind it."""
    text = (ROOT / "ARCHITECTURE.md").read_text()
    answers = text[text.index("## 1. "):text.index("## 2. ")]
    named = re.findall(r"`(\w[\w/]*/\w+\.(?:py|js))`(?: \(`([\w.]+)`)?", answers)
    named = [each for each in named if each[0] != "cli/COMMAND.py"]
    missing = [path for path, _ in named if not (PACKAGE / path).is_file()]
    missing += [
        f"{path}: {part}" for path, name in named for part in name.split(".")
        if part and not re.search(rf"(def|class) {part}\b", (PACKAGE / path).read_text())
    ]
    assert len(named) > 40 and not missing


@cache
def _parsed(path: Path) -> ast.Module:
    gc.disable()  # else it walks all trees so far again and again
    try:
        return ast.parse(path.read_text())
    finally:
        gc.enable()


def _functions(path: Path) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    for node in ast.walk(_parsed(path)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node


def test_no_function_is_longer_than_a_look() -> None:
    too_long = [
        f"{path.relative_to(PACKAGE)}: {each.name} has {each.end_lineno - each.lineno + 1} lines"
        for path in PACKAGE.rglob("*.py") for each in _functions(path)
        if each.end_lineno is not None and each.end_lineno - each.lineno + 1 > LONGEST_LINES
    ]
    assert not too_long


def test_few_functions_are_complex() -> None:
    """Cyclomatic complexity by radon, which counts conditions and comprehensions."""
    complexity = pytest.importorskip("radon.complexity")
    every, complex_ones = 0, []
    for path in PACKAGE.rglob("*.py"):
        for block in complexity.cc_visit_ast(_parsed(path)):
            for each in (*getattr(block, "methods", ()), *([] if hasattr(block, "methods") else [block])):
                every += 1
                if each.complexity > COMPLEX_ABOVE:
                    complex_ones.append(f"{path.relative_to(PACKAGE)}: {each.name} {each.complexity}")
    assert len(complex_ones) <= COMPLEX_SHARE * every, "\n".join(sorted(complex_ones))


def test_files_of_tests_have_names_of_their_own() -> None:
    """Pytest imports them by their bare names: of two alike it collects one."""
    names = [path.name for path in (ROOT / "tests").rglob("*.py") if path.name != "conftest.py"]
    assert sorted(names) == sorted(set(names))


def test_code_pages_help_and_docs_are_in_plain_english() -> None:
    """The glossary of CONTRIBUTING.md: report, announce, state, name, estimate in place of telling and saying."""
    verbs = r"(?<![.])\b(told|tells?|telling|says?|said|saying|bears? out)\b(?!\()"
    words = re.compile(rf"{verbs}|(?<![a-z])(as_told|teller)(?![a-z])", re.IGNORECASE)
    folders = {
        "src": (".py", ".cpp", ".html", ".js", ".css"), "docs": (".md",), "tests": (".py",), "benchmarks": (".py",)
    }
    texts = [
        path for folder, endings in folders.items() for path in (ROOT / folder).rglob("*")
        if path.suffix in endings and path != Path(__file__)
    ]
    found = [
        f"{path.relative_to(ROOT)}, line {number}: {line.strip()[:100]}"
        for path in [*texts, ROOT / "README.md"]
        if not {"vendor", "decisions"} & set(path.parts)  # libraries of others; how it came about
        for number, line in enumerate(path.read_text().splitlines(), start=1) if words.search(line)
    ]
    assert not found, "\n".join(found)
