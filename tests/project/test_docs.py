"""The pages keep to the program and stay readable; `make docs` checks the site."""

import ast
import inspect
import posixpath
import re
import shlex
from collections.abc import Iterator
from functools import reduce
from pathlib import Path
from typing import Any

import pytest
import typer
import typer.main

import sorvolo
from sorvolo.cli.main import app

ROOT = Path(__file__).parents[2]
SOURCE = ROOT / "src" / "sorvolo"
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
USERS = [
    path
    for path in PAGES
    if "decisions" not in path.parts and path.name not in {"ARCHITECTURE.md", "CONTRIBUTING.md"}
]
WRITTEN = [path for path in PAGES if path.name != "ARCHITECTURE.md"]
Command = Any  # of the click that is inside typer
UsageError: Any = typer.BadParameter.__mro__[1]
MOST_IMAGE_BYTES = 1_500_000
MOST_PROSE_BYTES = 230_000  # of all pages but the architecture
MOST_WORDS = 1_700  # of a page
MOST_WORDS_OF = {"formats.md": 2_600, "thesis.md": 2_650}  # a table of 87 rows
LONG_SENTENCE = 28  # words that nine of ten sentences of a page have at most
_LINK = re.compile(r"\[(?:[^\[\]]|\[[^\]]*\])*\]\(([^)\s]+)\)")
_CODE = re.compile(r"(?s:```.*?\n(.*?)```)|`([^`\n]+)`|^ {4,}(\S.*)$", re.M)
_BLOCK = r"(?s:```.*?```)|^ {4,}.*$"
_OPTION = re.compile(r"(?<![\w-])--[a-z][a-z0-9-]*")
_HASH = re.compile(r"\b(?=[0-9a-f]*[0-9])(?=[0-9a-f]*[a-f])[0-9a-f]{7,40}\b")


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_somewhere(page: Path) -> None:
    broken = []
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.S)
    for target in _LINK.findall(text):
        path, _, anchor = target.partition("#")
        if ":" in path:
            continue
        linked = page if not path else Path(posixpath.normpath((page.parent / path).as_posix()))
        is_anchor_lost = anchor and linked.suffix == ".md" and anchor not in anchors(linked)
        if not linked.exists() or is_anchor_lost:
            broken.append(target)
    assert broken == []


def anchors(page: Path) -> set[str]:
    titles = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.M)
    return {
        re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", title.lower())).strip("-")
        for title in titles
    }


@pytest.mark.parametrize("page", USERS, ids=name_of)
def test_commands_and_options_of_a_page_exist(page: Path) -> None:
    commands = commands_by_name()
    own = {
        "--config",
        "--debug",
        "--quiet",
        "--verbose",
        "--version",
        "--help",
        "--install-completion",
    }
    known = {option for command in commands.values() for option in options_of(command)}
    known |= own | options_of_other_programs()
    wrong = []
    for line, is_whole in code_of(page):
        words = line.split()
        while words and re.fullmatch(r"[A-Z_]+=\S*", words[0]):  # variables of the shell
            words = words[1:]
        if words[:1] != ["sorvolo"]:
            wrong += [
                f"{line}: {option}" for option in _OPTION.findall(line) if option not in known
            ]
            continue
        name = next((name for n in (3, 2) if (name := " ".join(words[1:n])) in commands), None)
        if name is None:
            is_a_command = len(words) > 1 and words[1].isidentifier() and not words[1].isupper()
            if is_a_command and words[1] not in {name.split()[0] for name in commands}:
                wrong.append(line)
            continue
        try:
            parse(commands[name], shlex.split(line.partition("|")[0])[1 + len(name.split()) :])
        except UsageError as error:
            if is_whole or "requires an argument" not in str(error):
                wrong.append(f"{line}: {error}")
    assert wrong == []


def parse(command: Command, arguments: list[str]) -> None:
    """Raise UsageError for an unknown option or one without its value; types are not checked."""
    context = typer.Context(command, info_name=command.name)
    command.make_parser(context).parse_args(arguments)


def code_of(page: Path) -> Iterator[tuple[str, bool]]:
    """Yield each line of code, and whether it stands in a block, so that it must be whole."""
    for fenced, span, indented in _CODE.findall(page.read_text(encoding="utf-8")):
        for line in (fenced or span or indented).splitlines():
            yield re.split(r"\s#\s|\s{3,}", line.strip())[0], not span


def commands_by_name() -> dict[str, Command]:
    commands: dict[str, Command] = {}

    def walk(command: Command, name: str) -> None:
        children = getattr(command, "commands", {})
        if not children:
            commands[name] = command
        for child, below in children.items():
            walk(below, f"{name} {child}".strip())

    walk(typer.main.get_command(app), "")
    return commands


def options_of(command: Command) -> set[str]:
    return {option for one in command.params for option in (*one.opts, *one.secondary_opts)}


def options_of_other_programs() -> set[str]:
    scripts = [*(ROOT / "benchmarks").glob("*.py"), *(ROOT / "docs").rglob("*.py")]
    own = {
        option
        for path in scripts
        for option in re.findall(r'add_argument\(\s*"(--[a-z0-9-]+)"', path.read_text())
    }
    ray = {"--head", "--node-ip-address", "--ray-client-server-port", "--include-dashboard"}
    return own | ray | {"--address", "--no-deps", "--strict"}  # of ray, pip and mypy


def test_functions_take_what_the_page_on_python_gives_them() -> None:
    text = (ROOT / "docs/python.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", text, re.S)
    calls = 0
    for call in ast.walk(ast.parse("".join(blocks))):
        if not isinstance(call, ast.Call):
            continue
        path = ast.unparse(call.func)
        if not re.fullmatch(r"sorvolo(\.\w+)+", path):
            continue
        function = reduce(getattr, path.split(".")[1:], sorvolo)
        named = {str(each.arg): each.value for each in call.keywords}
        inspect.signature(function).bind(*call.args, **named)
        calls += 1
    assert calls > 30


def test_functions_and_rooms_of_an_explanation_exist() -> None:
    code = "\n".join(path.read_text(encoding="utf-8") for path in SOURCE.rglob("*.py"))
    wrong = []
    for page in [*(ROOT / "docs" / "how").glob("*.md"), ROOT / "docs" / "detector.md"]:
        text = page.read_text(encoding="utf-8")
        for owner, function in re.findall(r"`(?:([A-Z]\w*)\.)?(\w+)\(\)`", text):
            is_there = f"def {function}(" in code and (not owner or f"class {owner}" in code)
            wrong += [] if is_there else [f"{page.name}: {owner}.{function}"]
        rooms = re.findall(r"`([a-z]+(?:/[a-z]+)*)/`", text)
        wrong += [f"{page.name}: {room}" for room in rooms if not (SOURCE / room).is_dir()]
    assert wrong == []


def test_source_files_that_a_page_names_exist() -> None:
    roots = SOURCE, SOURCE / "lab" / "thesis", ROOT
    wrong = []
    for page in (ROOT / "docs").rglob("*.md"):
        files = re.findall(r"`([a-z_]+(?:/\w+)*\.py)`", page.read_text(encoding="utf-8"))
        wrong += [
            f"{page.name}: {file}"
            for file in files
            if not any((root / file).is_file() for root in roots)
        ]
    assert wrong == []


def test_the_page_of_commands_names_them_all() -> None:
    page = (ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
    assert [name for name in commands_by_name() if f"`{name}`" not in page] == []


@pytest.mark.parametrize("page", USERS, ids=name_of)
def test_a_users_page_has_no_history_of_the_laboratory(page: Path) -> None:
    prose = re.sub(_BLOCK, "", page.read_text(encoding="utf-8"), flags=re.M)
    assert _HASH.findall(prose) == []


@pytest.mark.parametrize("page", WRITTEN, ids=name_of)
def test_a_page_is_short_and_so_are_its_sentences(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    most = MOST_WORDS_OF.get(page.name, MOST_WORDS)
    if "decisions" in page.parts:
        most = 500
    assert len(text.split()) <= most
    lengths = sorted(len(sentence.split()) for sentence in sentences_of(text))
    assert not lengths or lengths[int(0.9 * (len(lengths) - 1))] <= LONG_SENTENCE


def sentences_of(text: str) -> Iterator[str]:
    """Yield the sentences of paragraphs and list items, without code, tables and headings."""
    text = re.sub(rf"{_BLOCK}|^[|#!].*$", "\n", text, flags=re.M)
    text = _LINK.sub("link", text)
    for paragraph in re.split(r"\n\s*\n|\n(?=\s*(?:-|\d+\.) )", text):
        for sentence in re.split(r"(?<=[.!?:])\s+", " ".join(paragraph.split())):
            if len(sentence.split()) > 2:
                yield sentence


def test_the_prose_does_not_grow() -> None:
    assert sum(path.stat().st_size for path in WRITTEN) <= MOST_PROSE_BYTES


def test_pictures_are_few_and_all_used() -> None:
    used = {
        (page.parent / target).resolve()
        for page in PAGES
        for target in _LINK.findall(page.read_text(encoding="utf-8"))
    }
    pictures = [path for path in (ROOT / "docs" / "images").iterdir() if path.is_file()]
    assert [name_of(path) for path in pictures if path.resolve() not in used] == []
    assert sum(path.stat().st_size for path in pictures) < MOST_IMAGE_BYTES


def test_every_page_is_in_the_sites_navigation() -> None:
    site = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    pages = [path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")]
    assert [
        page for page in pages if not page.startswith("decisions/") and f"- {page}\n" not in site
    ] == []
