"""Installed models: found by name, verified; files fetched by hash or not at all."""

import hashlib
import json
import urllib.error
import urllib.request
from collections.abc import Iterator
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import numpy as np
import pytest
from toy_models import rectangle_model, square_model

from sorvolo.cli import main as cli
from sorvolo.detection.detector import Detector
from sorvolo.detection.models import (
    Integrity,
    find_model,
    installed_models,
    integrity,
    models_folder,
)
from sorvolo.detection.session import read_info
from sorvolo.errors import InputError
from sorvolo.missions.fetched_files import WebRedirects, copy_by_hash
from sorvolo.survey.objects import CLASSES


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("SORVOLO_MODELS", str(tmp_path / "own"))
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    return tmp_path / "own"


@pytest.fixture
def model(tmp_path: Path) -> Path:
    (tmp_path / "given").mkdir()
    return rectangle_model(tmp_path / "given" / "coast.onnx", name="coast")


def _hash(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _install(folder: Path, model: Path) -> None:
    """Put a model among one's own, with a card that has its hash."""
    folder.mkdir(exist_ok=True)
    path = folder / model.name
    path.write_bytes(model.read_bytes())
    path.with_suffix(".json").write_text(json.dumps({"sha256": _hash(model)}))


class _Shelf(BaseHTTPRequestHandler):
    """Serves one folder; a name with "cut" in it ends in the middle."""

    def __init__(self, folder: Path, *arguments: object) -> None:
        self.folder = folder
        super().__init__(*arguments)  # type: ignore[arg-type]

    def do_GET(self) -> None:
        if self.path.startswith("/to-"):
            scheme, _, rest = self.path.removeprefix("/to-").partition("-")
            self.send_response(302)
            self.send_header("Location", f"{scheme}://{self.headers['Host']}/{rest}")
            self.end_headers()
            return
        path = self.folder / self.path.split("?")[0].lstrip("/").replace("cut-", "")
        if not path.is_file():
            self.send_error(404)
            return
        data = path.read_bytes()
        self.send_response(200)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data[: len(data) // 2] if "cut-" in self.path else data)

    def log_message(self, format: str, *arguments: object) -> None:
        pass


@pytest.fixture
def address(model: Path) -> Iterator[str]:
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Shelf, model.parent))
    Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()


def test_names_and_paths(folder: Path, model: Path) -> None:
    assert find_model(model) == find_model(str(model)) == model
    folder.mkdir()
    own = rectangle_model(folder / "night.onnx", name="night")
    assert find_model("night") == own
    assert Detector.load("night", provider="cpu").info.name == "night"
    with pytest.raises(InputError, match=r"no model 'day'; installed are: .*night"):
        Detector.load("day")


def test_an_own_model_that_a_packaged_name_hides_is_reported(
    folder: Path, model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "thermal.onnx").write_bytes(model.read_bytes())
    assert find_model("thermal") != folder / "thermal.onnx"
    for command in ("list", "verify"):
        assert cli.main(["models", command]) == 0
        printed = " ".join(capsys.readouterr().out.split())
        assert "is not used: 'thermal' is the name of a packaged model" in printed


def test_where_own_models_lie(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert models_folder() == folder
    monkeypatch.delenv("SORVOLO_MODELS")
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    assert models_folder() == tmp_path / "data" / "sorvolo" / "models"
    assert [each for each in installed_models() if not each.is_packaged] == []


def test_what_is_not_the_file_is_refused(model: Path, address: str, tmp_path: Path) -> None:
    copy_by_hash(f"{address}/coast.onnx?version=2", tmp_path / "x", _hash(model), offline="wait")
    assert (tmp_path / "x").read_bytes() == model.read_bytes()
    attempts = [
        (f"{address}/coast.onnx", "0" * 64, "is not the file"),
        (f"{address}/cut-coast.onnx", _hash(model), "is not the file|cannot be fetched"),
        (f"{address}/none.onnx", _hash(model), "cannot be fetched \\(Not Found"),
        ("http://127.0.0.1:9/x.onnx", _hash(model), "Without a network, wait"),
    ]
    for source, sha256, reason in attempts:
        with pytest.raises(InputError, match=reason):
            copy_by_hash(source, tmp_path / "z", sha256, offline="wait")


def test_a_redirect_is_followed_over_the_web_alone(
    model: Path, address: str, tmp_path: Path
) -> None:
    copy_by_hash(f"{address}/to-http-coast.onnx", tmp_path / "x", _hash(model), offline="")
    for scheme in ("ftp", "file"):
        with pytest.raises(InputError, match=f"cannot be fetched .*edirect.* .?{scheme}"):
            copy_by_hash(f"{address}/to-{scheme}-coast.onnx", tmp_path, _hash(model), offline="")


@pytest.mark.parametrize(
    "asked, offered, is_followed",
    [
        ("https", "https", True),
        ("http", "https", True),
        ("https", "http", False),
        ("http", "ftp", False),
    ],
)
def test_a_redirect_never_gives_up_encryption(asked: str, offered: str, is_followed: bool) -> None:
    request = urllib.request.Request(f"{asked}://example.org/a.onnx")
    follow = partial(
        WebRedirects().redirect_request,
        request,
        None,
        302,
        "",
        {},
        f"{offered}://example.org/b.onnx",
    )
    if is_followed:
        assert follow().full_url == f"{offered}://example.org/b.onnx"
    else:
        with pytest.raises(urllib.error.URLError, match="not followed"):
            follow()


def test_the_command(folder: Path, model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _install(folder, model)
    assert cli.main(["models", "verify", "coast"]) == 0
    assert capsys.readouterr().out.endswith("coast: good\n")
    assert cli.main(["models", "list", "--json"]) == 0
    row = next(each for each in json.loads(capsys.readouterr().out) if each["name"] == "coast")
    assert row["classes"] == ["person", "car", "small object"] and row["thermal"] is True
    assert cli.main(["models", "list"]) == 0 and "coast" in capsys.readouterr().out
    assert cli.main(["models", "show", "coast", "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["sha256"] == _hash(model) == shown["card"]["sha256"]
    assert cli.main(["models", "show", str(model)]) == 0
    assert "found well from 8 to 120 px" in capsys.readouterr().out


def test_classes_on_request_are_named(
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    model = rectangle_model(tmp_path / "asked.onnx", name="asked", on_request=["small object"])
    assert cli.main(["models", "show", str(model)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert (
        sum("reported only where asked for (--classes), from score" in line for line in lines) == 1
    )
    assert sum("reported from score" in line for line in lines) == 2
    _install(folder, model)
    assert cli.main(["models", "list"]) == 0
    assert "person, car, small object (on request)" in capsys.readouterr().out


def test_a_card_s_measurements_are_a_table(
    folder: Path, model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _install(folder, model)
    ap50, ap = (
        {"value": 0.6224, "low": 0.4, "high": 0.77},
        {"value": 0.264, "low": None, "high": None},
    )
    card = {
        "sha256": _hash(model),
        "fails": ["people below 10 px", "crowds"],
        "measured": {"sea_side": {"person": {"labels": 1387, "AP50": ap50, "AP": ap}}, "odd": 3},
    }
    (folder / "coast.json").write_text(json.dumps(card))
    assert cli.main(["models", "show", "coast"]) == 0
    printed = capsys.readouterr().out
    assert "{" not in printed and "AP50 %" in printed and "pictures held out," not in printed
    row = next(line.split() for line in printed.splitlines() if "sea side" in line)
    assert row == ["sea", "side", "person", "1387", "62.2", "(40.0-77.0)", "26.4"]


def test_what_is_no_model_is_reported_as_what_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("clip.mp4").write_bytes(b"")
    for name in ("clip.mp4", "./clip.mp4"):
        with pytest.raises(
            InputError, match=r"clip\.mp4 is no model: those are \.onnx files; give one, or a name"
        ):
            Detector.load(name)
    with pytest.raises(InputError, match=r"can run code when opened"):
        Detector.load("./net.pth")
    with pytest.raises(InputError, match=r"there is no model 'gone\.mp4'; installed are"):
        Detector.load("gone.mp4")


def test_verify_finds_changed_damaged_and_unknown_files(
    folder: Path, model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _install(folder, model)
    path = folder / "coast.onnx"
    path.write_bytes(square_model(model.with_name("other.onnx")).read_bytes())
    assert cli.main(["models", "verify", "coast"]) == 1
    assert "CHANGED" in capsys.readouterr().out
    assert cli.main(["models", "verify", str(path), "--sha256", _hash(path)]) == 0
    assert cli.main(["models", "verify", str(path), "--sha256", "0" * 64]) == 1
    capsys.readouterr()
    assert cli.main(["models", "verify", str(path), "--sha256", _hash(path)[:12]]) == 1
    printed = capsys.readouterr()
    assert "64 hexadecimal digits" in printed.err and "CHANGED" not in printed.out
    path.with_suffix(".json").unlink()
    capsys.readouterr()
    assert cli.main(["models", "verify", "coast"]) == 0
    assert _hash(path) in capsys.readouterr().out
    (folder / "broken.onnx").write_bytes(b"nothing")
    assert cli.main(["models", "verify", "broken"]) == 1
    printed = capsys.readouterr().out
    assert "copy or fetch it again" in printed and "models verify" not in printed
    (folder / "broken.json").write_text("{")
    assert cli.main(["models", "verify", "broken"]) == 1
    assert cli.main(["models", "list"]) == 0, "a broken file of another model stops nothing"
    assert "broken" in capsys.readouterr().out
    assert cli.main(["models", "verify", "none"]) == 1


def test_a_model_that_only_looks_again_searches_nothing(
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It finds nobody in whole pictures, so that an empty watch would mislead; it is asked by other models alone."""
    monkeypatch.setenv("COLUMNS", "200")
    model = rectangle_model(tmp_path / "again.onnx", name="again", second_only=True)
    _install(folder, model)
    for wanted in ("again", model):
        with pytest.raises(
            InputError, match=r"'again' only looks again at what other models report.*default"
        ) as no:
            Detector.load(wanted, provider="cpu", threads=1)
        assert not {"again", "second-opinion"} & set(
            str(no.value).split("pictures: ")[1].split(", ")
        )
    with pytest.raises(InputError, match="installed are: ") as unknown:
        find_model("gone")
    assert "again" not in str(unknown.value) and "second-opinion" not in str(unknown.value)
    assert cli.main(["models", "list"]) == 0
    assert "person (in other models' reports)" in capsys.readouterr().out
    assert cli.main(["models", "show", "again"]) == 0
    assert "it cannot search whole pictures" in capsys.readouterr().out


def test_help_of_every_command_has_an_example(capsys: pytest.CaptureFixture[str]) -> None:
    for command in ("list", "show", "verify"):
        assert cli.main(["models", command, "--help"]) == 0
        example = capsys.readouterr().out.split("Example", 1)[1]
        assert f"sorvolo models {command}" in " ".join(example.replace("│", " ").split())


def test_packaged_models_are_what_their_cards_state() -> None:
    packaged = [each for each in installed_models() if each.is_packaged]
    if not packaged:
        pytest.skip("no model comes with this copy of the package")
    assert "default" in [each.name for each in packaged]
    for each in packaged:
        assert integrity(each) is Integrity.GOOD
        assert each.path.stat().st_size <= 40e6
        assert read_info(each.path).second_only is (each.name == "second-opinion")
        assert read_info(each.path).classes == (
            ("person",) if each.name == "second-opinion" else CLASSES
        )
    assert sum(each.path.stat().st_size for each in packaged) <= 17.5e6
    how = Detector.load("default", provider="cpu", threads=1).info.second_look["person"]
    assert how.by == "second-opinion", "what a model asks comes with it"
    assert how.positions == 2


def test_the_packaged_model_hands_thermal_frames_to_the_thermal_one() -> None:
    detector = Detector.load("default", provider="cpu", threads=1)
    detector.detect(np.zeros((64, 64, 3), np.uint8))
    (notice,) = detector.notices
    assert notice.code == "thermal_model" and "'thermal'" in notice.text
