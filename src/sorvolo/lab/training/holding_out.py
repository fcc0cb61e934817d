"""Which pictures of a set are held out from training: the same ones whenever share and seed are the same."""

from sorvolo.errors import InputError, SettingsError
from sorvolo.lab.datasets.splits import split_by_blocks, split_by_group
from sorvolo.survey.labels import LabelledSet

_BLOCKS, _GAP = (
    10,
    10,
)  # into which a set of too few videos is cut; frames left out between them, at most


def hold_out(
    labelled: LabelledSet, share: float, seed: int
) -> tuple[LabelledSet, LabelledSet, list[str]]:
    """What is learnt from, what is held out, and notices about that; whole videos wherever there are enough.

    `sorvolo train --val SHARE` and `read_sets` take it from here. Raises
    SettingsError for a share outside 0 to below 1.
    """
    if not 0 <= share < 1:
        raise SettingsError(f"the share to hold out must lie in 0 to below 1, got {share}")
    shares = {"learnt": 1 - share, "held out": share}
    empty = labelled.only([])
    if share == 0:
        return labelled, empty, []
    try:
        parts = split_by_group(labelled, shares, seed)
        if share / 3 <= len(parts["held out"]) / len(labelled) <= min(3 * share, (1 + share) / 2):
            return parts["learnt"], parts["held out"], []
    except InputError:
        pass  # too few videos: blocks of frames are held out below
    block = max(1, len(labelled) // _BLOCKS)
    try:
        parts = split_by_blocks(labelled, shares, block, min(_GAP, block // 2), seed)
    except InputError as error:
        return labelled, empty, [f"nothing of {labelled.name} is held out: {error}"]
    text = (
        f"{labelled.name} has too few videos to hold whole ones out: blocks of about {block} neighbouring frames were "
        "instead; frames of one video look alike, so the score will be too good"
    )
    remarks = [
        f"{labelled.name}: {notice.text}" for each in parts.values() for notice in each.notices
    ]
    return parts["learnt"], parts["held out"], [text, *remarks]
