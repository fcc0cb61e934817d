"""What strangers import: every function takes files as text or as any path, one input or several."""

import inspect
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import is_dataclass
from enum import EnumMeta
from pathlib import Path
from typing import Any, Literal, get_origin, get_type_hints

import numpy as np
import pytest
from PIL import Image

import sorvolo
from sorvolo.paths import listed


def public_functions() -> Iterator[tuple[str, Callable[..., Any]]]:
    for name in sorvolo.__all__:
        given = getattr(sorvolo, name)
        if inspect.isfunction(given):
            yield name, given
        elif inspect.isclass(given):
            for own, value in vars(given).items():
                if isinstance(value, classmethod) and not own.startswith("_"):
                    yield f"{name}.{own}", value.__func__


def test_no_public_function_insists_on_a_path() -> None:
    insisting = [
        f"{name}({parameter})"
        for name, function in public_functions()
        for parameter in inspect.signature(function).parameters.values()
        if "pathlib" in str(parameter.annotation)
    ]
    assert insisting == []


def test_one_input_is_no_row_of_letters(tmp_path: Path) -> None:
    class Odd:
        def __fspath__(self) -> str:
            return "a/b"

    assert listed("flight.mp4") == ["flight.mp4"] and listed(Odd()) == ["a/b"]
    assert listed([Path("a"), "rtsp://b/c"]) == ["a", "rtsp://b/c"]
    with pytest.raises(sorvolo.InputError, match=r"no such file or folder: flight\.mp4"):
        next(sorvolo.map_flights("flight.mp4", "site"))


def test_a_folder_as_text_is_inspected(tmp_path: Path) -> None:
    for index in range(2):
        pixels = np.random.default_rng(index).integers(0, 255, (48, 64, 3), np.uint8)
        Image.fromarray(pixels).save(tmp_path / f"IMG_{index}.jpg")
    (one,) = sorvolo.inspect_input(str(tmp_path))
    (other,) = sorvolo.inspect_input([os.fspath(tmp_path)])
    assert one.inputs == other.inputs == ("IMG_0.jpg", "IMG_1.jpg")


def test_one_class_is_no_row_of_letters() -> None:
    for settings in (
        sorvolo.MapSettings,
        sorvolo.CompareSettings,
        sorvolo.WatchSettings,
        sorvolo.SearchSettings,
    ):
        assert settings(classes="car").classes == ("car",)  # type: ignore[arg-type]
        assert settings(classes=["car", "person"]).classes == ("car", "person")  # type: ignore[arg-type]
    assert sorvolo.MapSettings(checks="A*").checks == ("A*",)  # type: ignore[arg-type]
    assert sorvolo.SearchOutputs("results", flights="a").flights == ("a",)  # type: ignore[arg-type]
    assert sorvolo.WatchOutputs(labels="coco").labels == ("coco",)  # type: ignore[arg-type]


def test_records_of_outputs_take_text() -> None:
    assert sorvolo.WatchOutputs(folder="found").folder == Path("found")  # type: ignore[arg-type]
    outputs = sorvolo.SearchOutputs("results", refly=("holes.kmz",))  # type: ignore[arg-type]
    assert (outputs.folder, outputs.refly) == (Path("results"), (Path("holes.kmz"),))


def test_a_word_that_is_no_choice_is_refused_by_the_record() -> None:
    """Also by every public record that gains such a field: a batch with the mission "nope" was made in silence."""
    tried = []
    for name in sorvolo.__all__:
        record = getattr(sorvolo, name)
        if not (is_dataclass(record) and name.endswith(("Settings", "Outputs"))):
            continue
        for field, kind in get_type_hints(record).items():
            if isinstance(kind, EnumMeta) or get_origin(kind) is Literal:
                with pytest.raises(sorvolo.SettingsError, match=f"{field} must be one of .*'nope'"):
                    record(**{field: "nope"})
                tried.append(f"{name}.{field}")
    assert len(tried) >= 4, tried


def test_every_type_that_a_public_function_takes_or_gives_is_public() -> None:
    hidden = {
        f"{name}: {kind}"
        for name, function in public_functions()
        for given in _annotations(function)
        for kind in re.findall(r"sorvolo\.[\w.]*?\.([A-Z]\w+)(?![\w.])", str(given))
        if kind not in sorvolo.__all__
    }
    assert hidden == set()


def _annotations(function: Callable[..., Any]) -> list[Any]:
    signature = inspect.signature(function)
    parameters = (parameter.annotation for parameter in signature.parameters.values())
    return [*parameters, signature.return_annotation]


@pytest.mark.parametrize(
    ("words", "in_python"),
    [
        ("give --offset 2, or --telemetry FILE", "give offset_s 2, or telemetry FILE"),
        ("use --height-model (--gsd)", "use height_model (m_per_px)"),
        ("a--b.mp4: give --camera", "a--b.mp4: give camera"),
        (
            "first run sorvolo map --site s, then --gcp",
            "first run sorvolo map --site s, then control",
        ),
    ],
)
def test_errors_name_arguments_in_python_and_options_in_commands(
    words: str, in_python: str
) -> None:
    error = sorvolo.InputError(words)
    assert str(error) == in_python and f"{error}" == words
    assert str(sorvolo.StoreError(f"x: {error}")) == f"x: {in_python}"


def test_no_error_of_python_asks_for_an_option() -> None:
    with pytest.raises(sorvolo.SettingsError, match=r"accuracy \(control_sigma_m\) must"):
        sorvolo.MapSettings(control_sigma_m=0)


def test_what_cannot_be_is_named_and_nothing_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    picture = np.zeros((48, 64, 3), np.uint8)
    seconds = [(0.0, picture), (1.5, picture)]  # as nanoseconds 0 and 1
    flight = sorvolo.frames([(0, picture), (10**9, picture)])
    for work, words in (
        (lambda: sorvolo.frames(seconds), "give pairs of a time, whole nanoseconds"),
        (lambda: sorvolo.frames([picture, picture]), "give pairs of a time"),
        (lambda: sorvolo.map_flights(picture, "site").result(), "ndarray is no input"),
        (lambda: sorvolo.watch([None]).result(), "a NoneType is no input"),
        (lambda: sorvolo.watch(flight, detector="default").result(), "'default' is no detector"),
        (lambda: sorvolo.Archive.open("nowhere", write=False), "no site at nowhere"),
    ):
        with pytest.raises(sorvolo.SorvoloError, match=words) as raised:
            work()
        assert "--" not in str(raised.value)
    assert list(tmp_path.iterdir()) == []


def test_a_report_of_an_unknown_flight_is_none(tmp_path: Path) -> None:
    with (
        sorvolo.Archive.open(tmp_path / "site", write=True) as archive,
        pytest.raises(sorvolo.StoreError, match="has no flight 'nope', only none"),
    ):
        archive.report("nope")
