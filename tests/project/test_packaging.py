"""What an sdist and a wheel hold, and the licences on paper; `make wheel` itself runs by hand and in CI."""

import json
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from fnmatch import fnmatch
from importlib import metadata
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from typer.main import get_command

from sorvolo.build import VERSION
from sorvolo.cli.main import app
from sorvolo.store.site.catalogue_place import VARIABLE

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
MODELS = tomllib.loads((ROOT / "models/pyproject.toml").read_text(encoding="utf-8"))
MODELS_FOLDER = Path("detection/data")  # a wheel of its own
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
        and path.parent != MODELS_FOLDER
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
        if path.suffix != ".py"
        and path.parent != MODELS_FOLDER
        and not any(fnmatch(path.name, each) for each in patterns)
    ]
    assert left_out == []


def test_licence_expression_names_a_full_text_each() -> None:
    expression = f"{PROJECT['project']['license']} AND {MODELS['project']['license']}"
    texts = {path.stem for path in (ROOT / "LICENSES").glob("*.txt")}
    assert set(re.split(r" (?:AND|OR) ", expression)) == texts
    for path in (ROOT / "LICENSES").glob("*.txt"):
        assert len(path.read_text(encoding="utf-8")) > 10_000
    assert {"LICENSE", "NOTICE"} <= set(PROJECT["project"]["license-files"])
    assert {"NOTICE", "LICENSES/*.txt"} == set(MODELS["project"]["license-files"])


@pytest.mark.parametrize("card", CARDS, ids=lambda path: path.stem)
def test_every_shipped_model_is_under_a_licence_of_the_package_and_its_sources_are_credited(
    card: Path,
) -> None:
    written = json.loads(card.read_text(encoding="utf-8"))
    assert written["licence"] in MODELS["project"]["license"]
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


def test_the_models_are_a_wheel_of_their_own_and_not_in_the_programs(tmp_path: Path) -> None:
    """The program's own build leaves them out; one target puts together all that theirs is made from."""
    shutil.copytree(ROOT / "models", tmp_path / "models")
    for name in ("Makefile", "NOTICE"):
        shutil.copy(ROOT / name, tmp_path)
    (tmp_path / "LICENSES").symlink_to(ROOT / "LICENSES")
    data = tmp_path / "src/sorvolo" / MODELS_FOLDER
    data.mkdir(parents=True)
    for name in ("default.onnx", "default.json"):
        (data / name).write_bytes(b"{}")
    subprocess.run(["make", "-s", "build/models"], cwd=tmp_path, check=True)
    build = "from setuptools import build_meta; build_meta.build_wheel('.')"
    command = [sys.executable, "-c", build]
    subprocess.run(command, cwd=tmp_path / "build/models", check=True, capture_output=True)
    (wheel,) = (tmp_path / "build/models").glob("sorvolo_models-*.whl")
    with zipfile.ZipFile(wheel) as opened:
        names = opened.namelist()
    assert {f"sorvolo/{MODELS_FOLDER}/default.{each}" for each in ("onnx", "json")} <= set(names)
    assert not any(name.endswith(".py") for name in names)
    assert any(name.endswith("CC-BY-SA-4.0.txt") for name in names)
    left_out = PROJECT["tool"]["setuptools"]["exclude-package-data"]["sorvolo"]
    assert left_out == [f"{MODELS_FOLDER}/*"]


def test_the_images_steps_can_be_taken() -> None:
    """What the Dockerfile copies is there and not ignored; extras, ports and variables are those of the program."""
    steps = re.sub(r"\\\n\s*", " ", (ROOT / "Dockerfile").read_text(encoding="utf-8"))
    shown = {line[1:] for line in (ROOT / ".dockerignore").read_text().split() if line[0] == "!"}
    copied = [
        name
        for line in re.findall(r"^COPY (?!--from)(.*)$", steps, re.M)
        for name in line.split()[:-1]
    ]
    assert copied and all((ROOT / name).exists() and name in shown for name in copied)
    assert (
        "libexpat1" in steps.rpartition("\nFROM ")[2]
    )  # of the image that runs: rasterio's wheel lacks it
    (extras,) = re.findall(r'"\.\[(.*?)\]"', steps)
    assert set(extras.split(",")) <= set(PROJECT["project"]["optional-dependencies"])
    (python,) = set(re.findall(r"^FROM python:([\d.]+)-slim", steps, re.M))
    assert f"Programming Language :: Python :: {python}" in PROJECT["project"]["classifiers"]
    compose = (ROOT / "compose.yaml").read_text(encoding="utf-8")
    assert f"{VARIABLE}: postgresql://" in compose and "127.0.0.1:8750:8750" in compose
    (arguments,) = re.findall(r"command: (\[.*\])", compose)
    assert get_command(app).commands["serve"].make_context("serve", json.loads(arguments)[1:])


def test_the_base_needs_no_extra() -> None:
    """All public names but those of training, and the command line, in a process without what extras bring."""
    extras = {
        canonicalize_name(Requirement(each).name)
        for group in PROJECT["project"]["optional-dependencies"].values()
        for each in group
    }
    program = f"""
import sys
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0].replace("_", "-") in {sorted(extras)!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Missing())
from sorvolo import *
import pydoc, sorvolo, sorvolo.cli.main
try:
    train_detector()
except ImportError as error:
    assert "sorvolo[training]" in str(error)
assert sorvolo.map_flights and "map_flights" in pydoc.render_doc(sorvolo)
sys.exit(sorvolo.cli.main.main(["models", "list"]))
"""
    done = subprocess.run(
        [sys.executable, "-P", "-c", program], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0 and "default" in done.stdout, done.stderr


def pinned(lock: str) -> list[tuple[str, str]]:
    """The packages of a lock, by their canonical names, and their versions."""
    text = (ROOT / lock).read_text(encoding="utf-8")
    found = re.findall(r"^([\w.-]+)==([^\s\\]+)", text, re.M)
    return [(canonicalize_name(name), version) for name, version in found]


RUNNING = ("requirements.lock",)
TOGETHER = (
    *RUNNING,
    "requirements-test.lock",
    "requirements-training.lock",
    "requirements-torch.lock",
    "requirements-notebooks.lock",
)


def test_locks_that_are_installed_together_agree() -> None:
    """Two versions of one package cannot be installed, and a fresh clone would end there."""
    versions: dict[str, set[str]] = {}
    for name, version in (each for lock in TOGETHER for each in pinned(lock)):
        versions.setdefault(name, set()).add(version)
    assert not {name: each for name, each in versions.items() if len(each) > 1}


@pytest.mark.parametrize(
    "lock",
    sorted(
        path.name for path in ROOT.glob("requirements*.lock") if "torch" not in path.name
    ),  # its files differ by machine
)
def test_every_package_of_a_lock_has_hashes_and_no_address(lock: str) -> None:
    text = (ROOT / lock).read_text(encoding="utf-8")
    blocks = re.split(r"^(?=[\w.-]+==)", text, flags=re.M)[1:]
    assert len(blocks) == len(pinned(lock)) and "://" not in text
    assert not [each.split()[0] for each in blocks if "--hash=sha256:" not in each]


@pytest.mark.parametrize(("locks", "least"), [(RUNNING, 60), (TOGETHER, 100)])
def test_the_locks_hold_all_that_their_packages_require(locks: tuple[str, ...], least: int) -> None:
    """The environment is installed from them without their dependencies: `make demo` from the first alone."""
    locked = dict(each for lock in locks for each in pinned(lock))
    extras = PROJECT["project"]["optional-dependencies"]
    own = [Requirement(each) for each in PROJECT["project"]["dependencies"] + extras["station"]]
    assert {canonicalize_name(each.name) for each in own} <= locked.keys()
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
    assert len(locked) > least and not missing


def test_build_lock_holds_what_the_build_requires() -> None:
    locked = dict(pinned("requirements-build.lock"))
    for required in PROJECT["build-system"]["requires"]:
        name, _, least = required.partition(">=")
        assert [int(each) for each in locked[name].split(".")] >= [
            int(each) for each in least.split(".")
        ]


def test_the_conda_recipe_is_of_this_version_and_its_requirements() -> None:
    """OpenCV alone has another name there. Rendering it needs rattler-build, which is not installed here."""
    recipe = yaml.safe_load((ROOT / "recipe/recipe.yaml").read_text(encoding="utf-8"))
    project, own = PROJECT["project"], {"opencv-contrib-python-headless": "py-opencv"}
    assert recipe["context"]["version"] == VERSION
    assert recipe["about"]["license"] == project["license"]
    assert recipe["build"]["python"]["entry_points"] == [
        f"{name} = {function}" for name, function in project["scripts"].items()
    ]

    def wanted(requirements: list[str]) -> dict[str, str]:
        found = [Requirement(each) for each in requirements]
        named = {own.get(each.name, each.name): str(each.specifier) for each in found}
        return named | {"python": project["requires-python"]}

    listed = {
        part: {name: spec for name, _, spec in (each.partition(" ") for each in requirements)}
        for part, requirements in recipe["requirements"].items()
    }
    assert listed["run"] == wanted(project["dependencies"])
    built_with = wanted(PROJECT["build-system"]["requires"])
    assert listed["host"] == built_with | {"python": "", "pip": ""}
