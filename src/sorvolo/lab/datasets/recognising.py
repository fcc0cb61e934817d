"""Which form a file or folder of labels has, by what its files hold."""

from pathlib import Path

from sorvolo.lab.datasets.coco import coco_files
from sorvolo.lab.datasets.okutama import looks_like_okutama
from sorvolo.lab.datasets.parsed import files_below, is_label_file, read_text
from sorvolo.lab.datasets.umcd import looks_like_umcd
from sorvolo.lab.datasets.visdrone import looks_like_visdrone
from sorvolo.lab.datasets.voc import looks_like_voc
from sorvolo.lab.datasets.yolo import looks_like_yolo

_MOST_LOOKED_AT = 200  # files; the first ones may be empty, of pictures of nothing
_PARTS = frozenset({"images", "train", "val", "valid", "test"})


def form_of(place: Path) -> str | None:
    """The form's name among READERS; None for what is of none of them."""
    if place.is_file():
        ending = place.suffix.lower()
        known = {".json": "coco", ".yaml": "yolo", ".yml": "yolo", ".xml": "voc"}
        return known.get(ending) or (_form_of_text(place) if ending == ".txt" else None)
    if coco_files(place):
        return "coco"
    if any(looks_like_voc(path) for path in files_below(place, ".xml")[:_MOST_LOOKED_AT]):
        return "voc"
    found = (_form_of_text(path) for path in _label_texts(place)[:_MOST_LOOKED_AT])
    return next((form for form in found if form), None)


def _label_texts(folder: Path) -> list[Path]:
    """The folder's text files of labels; of one part of a set without any, those beside the part."""
    texts = [path for path in files_below(folder, ".txt") if is_label_file(path)]
    if not texts and folder.name.lower() in _PARTS:
        texts = [path for path in files_below(folder.parent, ".txt") if is_label_file(path)]
    return texts


def _form_of_text(path: Path) -> str | None:
    line = next((line for line in read_text(path).splitlines() if line.strip()), "")
    for form, looks_like in (
        ("visdrone", looks_like_visdrone),
        ("okutama", looks_like_okutama),
        ("yolo", looks_like_yolo),
    ):
        if looks_like(line):
            return form
    return "umcd" if looks_like_umcd(path) else None
