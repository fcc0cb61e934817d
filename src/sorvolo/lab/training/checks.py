"""How good a network in training is on the held-out pictures."""

from collections.abc import Callable, Sequence

from sorvolo.errors import InputError
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.lab.evaluation.detection_metrics import (
    ClassMatch,
    CocoNumbers,
    judged_classes,
    match_pictures,
)
from sorvolo.lab.training.faster_rcnn import FasterRCNN
from sorvolo.lab.training.held_out import Checked, mean_known
from sorvolo.lab.training.progress import Check
from sorvolo.lab.training.seeing import see
from sorvolo.mosaic.selection import evenly
from sorvolo.survey.labels import LabelledPicture, LabelledSet


def check_of(checked: Checked, step: int) -> Check:
    """The figures of a check: AP50 and AP over all classes, the plain mean, and AP50 of each class."""
    return Check(
        step, mean_known(checked.ap50.values()), mean_known(checked.ap.values()), checked.ap50
    )


def check_model(
    model: FasterRCNN,
    classes: Sequence[str],
    held_out: Sequence[LabelledSet],
    read: Callable[[str], ImageRGB],
    *,
    device: str,
    most: int,
) -> Checked:
    """Run the network over at most `most` held-out pictures, spread evenly over each set; damaged ones are left out."""
    total = sum(len(each) for each in held_out)
    matches: dict[str, tuple[ClassMatch, ...]] = {}
    numbers: dict[str, tuple[CocoNumbers, ...]] = {}
    for whole in held_out:
        count = min(len(whole), max(1, round(most * len(whole) / total)))
        seen: list[LabelledPicture] = []
        found = []
        for picture in (whole.pictures[row] for row in evenly(len(whole), count)):
            try:
                image = read(picture.path)
            except InputError:
                continue
            seen.append(picture)
            found.append(see(model, classes, image, device))
        labelled = whole.only(seen)
        own, _, by_class = match_pictures(labelled, found, judged_classes(labelled, classes))
        for match in own:
            matches[match.label] = (*matches.get(match.label, ()), match)
            numbers[match.label] = (*numbers.get(match.label, ()), by_class[match.label])
    return Checked(matches, numbers)
