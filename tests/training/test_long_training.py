"""Long trainings: packed data teach the same as folders, held-out pictures stay out, a killed run goes on."""

import importlib
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from square_pictures import labelled_squares

from real_data import real_data
from sorvolo.errors import InputError, SettingsError
from sorvolo.lab.datasets import read_dataset
from sorvolo.lab.training.drawing import batches_from
from sorvolo.lab.training.joint import JointSettings, JointTraining
from sorvolo.lab.training.presets import accurate, fast
from sorvolo.lab.training.samples import Augmentation, Sample, Share
from sorvolo.lab.training.weights import ImageNetWeights
from sorvolo.store.exports.label_files import write_coco
from sorvolo.survey.labels import LabelledSet
from sorvolo.survey.objects import CLASSES

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
_STEPS, _SIDE_PX = 4, 64


@pytest.fixture(scope="module")
def recipe() -> Iterator[Callable[[str], ModuleType]]:
    sys.path.insert(0, str(BENCHMARKS))
    yield importlib.import_module
    sys.path.remove(str(BENCHMARKS))


@pytest.fixture(scope="module")
def shares(tmp_path_factory: pytest.TempPathFactory) -> list[Share]:
    folder = tmp_path_factory.mktemp("data")
    cars = read_dataset(labelled_squares(folder / "cars", 2, 3))
    people = read_dataset(labelled_squares(folder / "people", 2, 3, names=("person", "car")))
    shut = np.array([[1.5, 2.25, 30.1, 40.0]], np.float32)
    pictures = [replace(each, ignored_px=shut, m_per_px=0.031) for each in people.pictures]
    return [
        Share(replace(cars, unlabelled=frozenset({"person"})), 1.4, (0.5, 1.1), pastes=CLASSES[2]),
        Share(people.only(pictures), 0.6, thermal=True, aslant=True),
    ]


@pytest.fixture(scope="module")
def packed(
    shares: list[Share],
    recipe: Callable[[str], ModuleType],
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    path = tmp_path_factory.mktemp("packed") / "new" / "data.zip"
    weights = ImageNetWeights(
        "lite0", {"stem": torch.arange(6.0).reshape(2, 3).T}, False, "ImageNet, a file"
    )
    recipe("training_archive").write_archive(
        path, shares, [weights], {"cars": "CC0", "people": "CC0"}
    )
    return path


def _batches(
    shares: Sequence[Share], read: Callable[[str], np.ndarray], start: int = 0
) -> Iterator[list[Sample]]:
    return batches_from(
        shares, CLASSES, read, Augmentation(side_px=_SIDE_PX), seed=1, batch=1, start=start
    )


def test_an_archive_gives_the_samples_that_the_folders_give(
    shares: list[Share], packed: Path, recipe: Callable[[str], ModuleType]
) -> None:
    reader, module = recipe("train_default_model").reader, recipe("training_archive")
    archive = module.TrainingArchive(packed)
    assert module.fingerprint(archive.shares) == module.fingerprint(shares)
    assert module.fingerprint([replace(shares[0], weight=1.5), shares[1]]) != module.fingerprint(
        shares
    )
    both = zip(_batches(shares, reader()), _batches(archive.shares, reader(archive.content)))
    for _ in range(12):
        for one, other in zip(*next(both)):
            for part in ("image", "boxes", "labels", "ignored", "known"):
                assert np.array_equal(getattr(one, part), getattr(other, part))
    weights = archive.weights("lite0")
    assert weights.layers["stem"].tolist() == [[0, 3], [1, 4], [2, 5]]
    assert not weights.original and weights.origin == "ImageNet, a file"
    with pytest.raises(InputError, match="no weights of resnet50"):
        archive.weights("resnet50")


def test_what_is_no_archive_is_refused(
    tmp_path: Path, packed: Path, recipe: Callable[[str], ModuleType]
) -> None:
    (tmp_path / "cut.zip").write_bytes(packed.read_bytes()[:-300])
    with pytest.raises(InputError, match="no whole archive"):
        recipe("training_archive").TrainingArchive(tmp_path / "cut.zip")


def test_a_long_training_goes_on_from_its_checkpoint_as_if_nothing_had_been(
    packed: Path, tmp_path: Path, recipe: Callable[[str], ModuleType]
) -> None:
    module, archive = (
        recipe("train_default_model"),
        recipe("training_archive").TrainingArchive(packed),
    )
    run = {"preset": "fast", "frozen": False, "steps": _STEPS}
    read = module.reader(archive.content)

    def learning(out: Path, save_s: float, run: dict[str, object] = run) -> Iterator[object]:
        out.mkdir(exist_ok=True)
        torch.manual_seed(1)
        training = JointTraining(
            module.started("fast", None), JointSettings(steps=_STEPS, batch=1), 1
        )
        return module.learn(
            training, lambda start: _batches(archive.shares, read, start), out, run, save_s=save_s
        )

    whole, killed = tmp_path / "whole", tmp_path / "killed"
    assert [done.step for done in learning(whole, 1e9)] == [1, 2, 3, 4]  # type: ignore[attr-defined]
    steps = learning(killed, 0.0)
    assert [next(steps).step for _ in range(2)] == [1, 2]  # type: ignore[attr-defined]
    steps = learning(killed, 1e9)
    assert next(steps).step == 3  # type: ignore[attr-defined]  # no checkpoint has it: it is lost
    (killed / ".tmp-1-weights.pt").write_bytes(b"what a kill in the middle of writing leaves")
    with pytest.raises(SettingsError, match="steps was 4, is 5"):
        next(learning(killed, 1e9, {**run, "steps": 5}))
    assert [done.step for done in learning(killed, 1e9)] == [3, 4]  # type: ignore[attr-defined]
    assert sorted(each.name for each in killed.iterdir()) == [
        "checkpoint.pt",
        "log.jsonl",
        "run.json",
        "weights.pt",
    ]
    one, other = (torch.load(each / "weights.pt", weights_only=True) for each in (whole, killed))
    assert all(torch.equal(one[name], other[name]) for name in one)
    logs = [
        (each / "log.jsonl").read_text().partition(', "seconds"')[0] for each in (whole, killed)
    ]
    assert logs[0] == logs[1] and logs[0].startswith('{"step": 4')
    module.network_of(run).load_state_dict(other)


def test_weights_fit_the_network_that_their_run_names(recipe: Callable[[str], ModuleType]) -> None:
    module = recipe("train_default_model")
    with torch.device("meta"):
        for preset, frozen, built in (
            ("fast", True, fast(CLASSES)),
            ("fast", False, module.started("fast", None)),
            ("accurate", True, accurate(CLASSES)),
            ("accurate", False, module.started("accurate", None)),
        ):
            again = module.network_of({"preset": preset, "original": True, "frozen": frozen})
            assert [*again.state_dict()] == [*built.state_dict()]


def test_only_sets_of_a_known_licence_are_packed(recipe: Callable[[str], ModuleType]) -> None:
    def share(name: str) -> Share:
        return Share(LabelledSet(name, CLASSES, ()), 1.0)

    demand_licences = recipe("pack_training_data").demand_licences
    demand_licences([share("hituav"), share("aerial_cars")])
    for name in ("cats", "sdd", "semantic_drone"):
        with pytest.raises(SystemExit, match=name):
            demand_licences([share("hituav"), share(name)])


def test_only_the_publishers_own_cars_are_read(
    tmp_path: Path, recipe: Callable[[str], ModuleType]
) -> None:
    """For every training, from a folder as from a pack: another's video is under another licence."""
    place = labelled_squares(tmp_path / "aerial_cars", 1, 5)
    for old, new in zip(
        range(5), ("DJI_0005-0018", "harlem-0005", "DJI-007-01", "M", "DJI_0762-1")
    ):
        for part, end in (("images", ".png"), ("labels", ".txt")):
            (place / part / f"flight0_{old:04d}{end}").rename(place / part / f"{new}{end}")
    parts = recipe("detection_data").aerial_cars(tmp_path)
    names = {
        part: [Path(each.path).stem for each in labelled.pictures]
        for part, labelled in parts.items()
    }
    assert names == {"train": ["DJI-007-01", "DJI_0005-0018"], "val": [], "test": ["DJI_0762-1"]}


def test_what_a_long_training_cannot_use_ends_it_with_one_line(
    packed: Path,
    tmp_path: Path,
    recipe: Callable[[str], ModuleType],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        "torch.set_flush_denormal", lambda _: True
    )  # it would hold for the tests after this one

    def trained(data: Path, steps: str = "1") -> None:
        words = [
            "--weights",
            "none",
            "--steps",
            steps,
            "--batch",
            "1",
            "--side",
            "64",
            "--device",
            "cpu",
        ]
        monkeypatch.setattr(
            "sys.argv", ["train_default_model.py", str(data), str(tmp_path / "out"), *words]
        )
        recipe("train_default_model").main()

    with pytest.raises(
        SystemExit, match=r"error: there is no file .*none\.zip; make it by `make training-data"
    ):
        trained(tmp_path / "none.zip")
    (tmp_path / "cut.zip").write_bytes(packed.read_bytes()[:-300])
    with pytest.raises(SystemExit, match=r"error: .* no whole archive"):
        trained(tmp_path / "cut.zip")
    trained(packed)
    with pytest.raises(SystemExit, match=r"error: .*steps was 1, is 2"):
        trained(packed, "2")


def test_held_out_pictures_stay_out_of_the_pack(
    tmp_path: Path, recipe: Callable[[str], ModuleType]
) -> None:
    data = real_data("detection")
    sets, pack = recipe("detection_data"), recipe("pack_training_data")
    simulated = labelled_squares(tmp_path / "squares", 1, 1)
    write_coco(simulated / "boxes.json", read_dataset(simulated))
    packed = pack.training_shares(data, simulated)
    pack.demand_licences(packed)
    paths = {each.path for share in packed for each in share.labelled.pictures}
    for read in (sets.hituav, sets.tinyperson, sets.aerial_cars):
        parts = read(data)
        assert paths >= {each.path for each in parts["train"].pictures}
        assert not paths & {each.path for name in ("val", "test") for each in parts[name].pictures}
    assert {share.labelled.name for share in packed} <= set(pack.LICENCES)
    assert not any(
        name in path for path in paths for name in ("/cats/", "/sdd/", "/semantic_drone/")
    )
