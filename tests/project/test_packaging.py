"""What an sdist and a wheel hold, and the licences on paper; `make wheel` itself runs by hand and in CI."""

import json
import re
import subprocess
import tomllib
from fnmatch import fnmatch
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
CARDS = sorted((ROOT / "src/sorvolo/detection/data").glob("*.json"))
SOURCES_OF_KERNELS = {".cpp", ".hpp"}


def files_of_package() -> list[Path]:
    listed = subprocess.run(
        ["git", "ls-files", "src/sorvolo"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if listed.returncode or not listed.stdout:
        pytest.skip("this is no git checkout")
    return [Path(line).relative_to("src/sorvolo") for line in listed.stdout.splitlines()]


def test_the_wheel_takes_every_file_of_the_package_that_is_not_python() -> None:
    patterns = PROJECT["tool"]["setuptools"]["package-data"]["sorvolo"]
    left_out = [
        path
        for path in files_of_package()
        if path.suffix not in {".py", *SOURCES_OF_KERNELS}
        and not any(path.match(each) for each in patterns)
    ]
    assert left_out == []


def test_the_sdist_takes_every_file_of_the_package() -> None:
    lines = (ROOT / "MANIFEST.in").read_text(encoding="utf-8").splitlines()
    patterns = next(
        line.split()[2:] for line in lines if line.startswith("recursive-include src/sorvolo")
    )
    left_out = [
        path
        for path in files_of_package()
        if path.suffix != ".py" and not any(fnmatch(path.name, each) for each in patterns)
    ]
    assert left_out == []


def test_licence_expression_names_a_full_text_each() -> None:
    expression = PROJECT["project"]["license"]
    texts = {path.stem for path in (ROOT / "LICENSES").glob("*.txt")}
    assert set(re.split(r" (?:AND|OR) ", expression)) == texts
    for path in (ROOT / "LICENSES").glob("*.txt"):
        assert len(path.read_text(encoding="utf-8")) > 10_000
    assert {"LICENSE", "NOTICE", "LICENSES/*.txt"} <= set(PROJECT["project"]["license-files"])


@pytest.mark.parametrize("card", CARDS, ids=lambda path: path.stem)
def test_every_shipped_model_is_under_a_licence_of_the_package_and_its_sources_are_credited(
    card: Path,
) -> None:
    written = json.loads(card.read_text(encoding="utf-8"))
    assert written["licence"] in PROJECT["project"]["license"]
    credited = section_of(written["name"])
    for other in re.findall(r"^All sources of the model `([^`]+)`", credited, re.M):
        credited += section_of(other)
    for source in written["trained_on"]:
        what = source["what"].partition(", seed")[
            0
        ]  # how many pictures, and which seed, is the card's
        assert what in credited, (
            f"NOTICE does not credit {source['what']} under the model {written['name']}"
        )


def section_of(model: str) -> str:
    notice = (ROOT / "NOTICE").read_text(encoding="utf-8")
    found = re.search(
        rf"^Model `{model}`.*?\n-+\n(.*?)(?=^[^\n]+\n-{{5,}}\n|\Z)", notice, re.M | re.S
    )
    assert found, f"NOTICE has no section for the model {model}"
    return found[1]


def test_locks_that_are_installed_together_agree() -> None:
    """Two versions of one package cannot be installed, and a fresh clone would end there."""
    versions: dict[str, set[str]] = {}
    for lock in ("requirements.lock", "requirements-training.lock", "requirements-notebooks.lock"):
        for line in (ROOT / lock).read_text(encoding="utf-8").splitlines():
            name, _, version = line.partition("==")
            if version:
                versions.setdefault(name.lower().replace("_", "-"), set()).add(version)
    assert not {name: each for name, each in versions.items() if len(each) > 1}


def test_the_locks_hold_all_that_their_packages_require() -> None:
    """The environment is installed from them without their dependencies."""
    locked = {}
    for lock in ("requirements.lock", "requirements-training.lock", "requirements-notebooks.lock"):
        for line in (ROOT / lock).read_text(encoding="utf-8").splitlines():
            if "==" in line and not line.startswith("#"):
                name, _, version = line.partition("==")
                locked[canonicalize_name(name)] = version
    missing = []
    for name in locked:
        try:
            required = [Requirement(each) for each in metadata.requires(name) or ()]
        except metadata.PackageNotFoundError:  # an extra that is not installed here
            continue
        for each in required:
            if each.marker is None or each.marker.evaluate({"extra": ""}):
                found = locked.get(canonicalize_name(each.name))
                if found is None or not each.specifier.contains(found, prereleases=True):
                    missing.append(f"{name}: {each}, locked: {found}")
    assert len(locked) > 100 and not missing


def test_build_lock_holds_what_the_build_requires() -> None:
    locked = dict(
        line.split("==")
        for line in (ROOT / "requirements-build.lock").read_text(encoding="utf-8").splitlines()
        if "==" in line
    )
    for required in PROJECT["build-system"]["requires"]:
        name, _, least = required.partition(">=")
        assert [int(each) for each in locked[name].split(".")] >= [
            int(each) for each in least.split(".")
        ]
