"""Pictures that a tiny network can learn in seconds."""

from pathlib import Path

import cv2
import numpy as np

_WIDTH, _HEIGHT = 128, 96


def labelled_squares(
    folder: Path, videos: int, frames: int, *, names: tuple[str, ...] = ("car",), seed: int = 0
) -> Path:
    """YOLO pictures of bright squares on dark ground, one of each class; the class is its brightness."""
    rng = np.random.default_rng(seed)
    for part in ("images", "labels"):
        (folder / part).mkdir(parents=True)
    for video in range(videos):
        for frame in range(frames):
            image = rng.integers(40, 60, (_HEIGHT, _WIDTH, 3)).astype(np.uint8)
            rows = []
            for label in range(len(names)):
                side = int(rng.integers(22, 32))
                x, y = int(rng.integers(0, _WIDTH - side)), int(rng.integers(0, _HEIGHT - side))
                image[y : y + side, x : x + side] = (30, 220, 240) if label == 0 else (240, 60, 40)
                rows.append(
                    f"{label} {(x + side / 2) / _WIDTH} {(y + side / 2) / _HEIGHT} {side / _WIDTH} "
                    f"{side / _HEIGHT}"
                )
            name = f"flight{video}_{frame:04d}"
            cv2.imwrite(str(folder / "images" / f"{name}.png"), image)
            (folder / "labels" / f"{name}.txt").write_text("\n".join(rows))
    (folder / "classes.txt").write_text("\n".join(names))
    return folder
