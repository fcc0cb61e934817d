"""Labelled pictures to learn from, and the weights that a training starts from, as one file.

A zip file: `manifest.json` lists the shares in their order, with every label and each set's licence; `pictures/` has
the pictures' own bytes, `weights/` each backbone's ImageNet weights. A training draws the same samples from it as from
the folders, and needs no other file, no network, and nothing of sorvolo that reads flights.
"""

import hashlib
import json
import zipfile
from collections.abc import Mapping, Sequence
from math import isfinite, nan
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch

from sorvolo.errors import InputError
from sorvolo.lab.training.samples import Share
from sorvolo.lab.training.weights import ImageNetWeights, Net
from sorvolo.store.atomic import atomic_path, writing
from sorvolo.survey.labels import LabelledPicture, LabelledSet

FORMAT = 1
MANIFEST = "manifest.json"


class TrainingArchive:
    """An archive that is open for reading, by several threads at once. Raises InputError where the file is none."""

    def __init__(self, path: Path) -> None:
        self._name = str(path)
        try:
            self._file = zipfile.ZipFile(path)
            self._manifest = json.loads(self._file.read(MANIFEST))
        except (zipfile.BadZipFile, KeyError, ValueError) as error:
            raise InputError(
                f"{path} is no whole archive of pack_training_data.py ({error}); write it anew"
            ) from error
        if self._manifest["format"] != FORMAT:
            raise InputError(
                f"{path} is of format {self._manifest['format']}, not {FORMAT}; write it anew"
            )

    @property
    def shares(self) -> list[Share]:
        """What is learnt from; a picture's path is its place in the archive, which `content` takes."""
        return [_share(each) for each in self._manifest["shares"]]

    def content(self, path: str) -> bytes:
        """The bytes of the picture's file. Raises zipfile.BadZipFile where they are damaged."""
        return self._file.read(path)

    def weights(self, net: Net) -> ImageNetWeights:
        """ImageNet weights of a backbone. Raises InputError where the archive has none of it."""
        about = self._manifest["weights"].get(net)
        if about is None:
            raise InputError(
                f"{self._name} has no weights of {net}; give --weights, or write it anew with them"
            )
        layers = safetensors.torch.load(self._file.read(_weights_path(net)))
        return ImageNetWeights(net, layers, about["original"], about["origin"])


def write_archive(
    path: Path,
    shares: Sequence[Share],
    starts: Sequence[ImageNetWeights],
    licences: Mapping[str, str],
) -> None:
    """Write the archive, whole or not at all; `licences` names that of every set.

    Raises KeyError for a set without one, StoreError on a full disk.
    """
    manifest = {
        "format": FORMAT,
        "shares": [
            _plain_share(number, each, licences[each.labelled.name])
            for number, each in enumerate(shares)
        ],
        "weights": {
            each.net: {"original": each.original, "origin": each.origin} for each in starts
        },
    }
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    # stored as they are: JPEG and weights hardly get smaller
    with (
        atomic_path(path) as partial,
        zipfile.ZipFile(partial, "w", strict_timestamps=False) as file,
    ):
        file.writestr(MANIFEST, json.dumps(manifest), zipfile.ZIP_DEFLATED)
        for number, share in enumerate(shares):
            for row, picture in enumerate(share.labelled.pictures):
                file.write(picture.path, _picture_path(number, row, picture))
        for each in starts:
            layers = {name: value.clone().contiguous() for name, value in each.layers.items()}
            file.writestr(_weights_path(each.net), safetensors.torch.save(layers))


def fingerprint(shares: Sequence[Share]) -> str:
    """Changes when pictures, labels, their order or a share's settings do; the same for a folder and its archive."""
    digest = hashlib.sha256()
    for number, share in enumerate(shares):
        digest.update(json.dumps(_plain_share(number, share, "")).encode())
    return digest.hexdigest()[:16]


def _plain_share(number: int, share: Share, licence: str) -> dict[str, Any]:
    labelled = share.labelled
    return {
        "name": labelled.name,
        "licence": licence,
        "weight": share.weight,
        "scale": list(share.scale),
        "pastes": share.pastes,
        "thermal": share.thermal,
        "aslant": share.aslant,
        "classes": list(labelled.classes),
        "unlabelled": sorted(labelled.unlabelled),
        "pictures": [
            {
                "path": _picture_path(number, row, each),
                "width_px": each.width_px,
                "height_px": each.height_px,
                "group": each.group,
                "boxes_px": each.boxes_px.tolist(),
                "labels": each.labels.tolist(),
                "ignored_px": each.ignored_px.tolist(),
                "m_per_px": each.m_per_px if isfinite(each.m_per_px) else None,
            }
            for row, each in enumerate(labelled.pictures)
        ],
    }


def _share(plain: Mapping[str, Any]) -> Share:
    pictures = tuple(
        LabelledPicture(
            each["path"],
            each["width_px"],
            each["height_px"],
            each["group"],
            np.array(each["boxes_px"], np.float32),
            np.array(each["labels"], np.int64),
            np.array(each["ignored_px"], np.float32),
            nan if each["m_per_px"] is None else each["m_per_px"],
        )
        for each in plain["pictures"]
    )
    labelled = LabelledSet(
        plain["name"], tuple(plain["classes"]), pictures, frozenset(plain["unlabelled"])
    )
    low, high = plain["scale"]
    return Share(
        labelled, plain["weight"], (low, high), plain["pastes"], plain["thermal"], plain["aslant"]
    )


def _picture_path(share: int, row: int, picture: LabelledPicture) -> str:
    """A folder of its own for each: sets have pictures of the same name."""
    return f"pictures/{share}/{row}/{Path(picture.path).name}"


def _weights_path(net: Net) -> str:
    return f"weights/{net}.safetensors"
