"""What the thesis prints in chapters 2 and 4: the dataset's videos, the tables, the figures, and how ours differ."""

from typing import Any

from sorvolo.lab.thesis.umcd_folder import CHANGES, MOSAICKING, WITH, WITHOUT

VIDEOS: dict[str, dict[str, tuple[str, ...]]] = {
    f"{WITHOUT}/{MOSAICKING}": {
        "Dirt": tuple(f"path{number:02d}" for number in range(1, 21)),
        "Countryside": tuple(f"path{number:02d}" for number in range(1, 11)),
    },
    f"{WITH}/{MOSAICKING}": {
        "Urban": ("path1", "path2", "path3", "path4"),
        "Dirt": ("path1", "path2", "path3", "path4"),
        "Countryside": ("path1", "path2"),
    },
    f"{WITH}/{CHANGES}": {
        "Urban": ("path1", "path2", "path3", "path4_1", "path4_2"),
        "Dirt": ("path1", "path2", "path3", "path4"),
        "Countryside": ("path1", "path2"),
    },
}
"""Tables 2.1, 2.3 and 2.4: the videos of each part by environment."""

APPEARANCES: dict[str, tuple[int, tuple[tuple[int, int], ...]]] = {
    "urban/path1": (48, ((9, 18), (12, 20), (16, 24))),
    "urban/path2": (25, ((13, 16), (14, 16))),
    "urban/path3": (25, ((8, 18), (9, 19))),
    "urban/path4_1": (12, ((6, 9),)),
    "urban/path4_2": (14, ((10, 11),)),
    "dirt/path1": (125, ((32, 42), (69, 81), (80, 91), (101, 111))),
    "dirt/path2": (123, ((30, 40), (83, 93), (103, 113), (113, 122))),
    "dirt/path3": (66, ((28, 32),)),
    "dirt/path4": (60, ((27, 37),)),
    "countryside/path1": (40, ((0, 9), (11, 21))),
    "countryside/path2": (47, ((3, 13), (19, 26), (36, 46))),
}
"""Table 2.4: each change detection video's length, s, and from which second to which its objects are in view."""

TABLE_4_1: tuple[dict[str, Any], ...] = tuple(
    dict(
        zip(("sequence", "frames", "keyframes", "proposed", "bu_et_al", "pix4d", "photoscan"), row)
    )
    for row in (
        ("phantom3-npu", 19983, 457, 7.2, 9.32, 140.08, 538.38),
        ("phantom3-centralPark", 12744, 471, 6.01, 8.49, 127.73, 563.57),
        ("phantom3-village", 16969, 406, 10.4, 11.31, 132.07, 360.70),
        ("phantom3-huangqi", 14776, 393, 8.0, 10.36, 102.83, 462.32),
    )
)
"""Minutes by method, on the NPU Drone-Map dataset."""

SECTION_4_1_1 = {"deviation": 0.15, "correlation": 0.80, "videos": 40}
TABLE_4_3 = {"tp": 3167, "fp": 884, "fn": 41, "tn": 9779}
TABLE_4_4 = {"precision": 0.7818, "recall": 0.9872, "accuracy": 0.9333, "f1": 0.8726}
TABLE_4_5: tuple[dict[str, Any], ...] = tuple(
    dict(zip(("method", "precision", "recall", "accuracy", "f1"), row))
    for row in (
        ("B. Wang et al. [100]", 0.48, 0.76, 0.9127, None),
        ("Q. Wang et al. [103]", 0.8366, None, None, None),
        ("thesis", 0.6715, 0.9588, 0.9954, 0.7898),
    )
)
SECTION_4_2_2 = {"single_thread_s": 2.883, "multithread_s": 0.47}
TABLE_4_6: dict[str, dict[str, float]] = {
    "standard": {"Okutama Action": 0.693004, "UMCD": 0.955187},
    "extended": {"Okutama Action": 0.768859, "UMCD": 0.998762},
}

FIGURES = {
    "3.12": "Two mosaics of one flight along a road: (a) by homographies, which widens and bends away in an arc; "
    "(b) by rigid transforms of four degrees of freedom, which stays a straight band.",
    "4.1": "(a) A mosaic at low altitude with three miniatures: a part of the mosaic, the frame it was made of, and "
    "their difference, almost black. (b) A mosaic at high altitude by the thesis's method, and one by Bu et al. "
    "[17], which look alike.",
    "4.2": "Mosaics of dirt and countryside at very low altitudes: clean bands without steps.",
    "4.3": "Three mosaics of urban ground at very low altitudes, with artifacts by parallax and low height.",
    "4.4": "A false positive: a small thing on the ground, seen from another side on the second flight.",
    "4.5": "Four parts of mosaics without elements, and the same with elements detected: people, a car, boxes.",
    "4.6": "Detections in dirt, countryside and urban frames by the extended Faster R-CNN.",
}
"""What the published figures show, in our words; the pictures themselves are the thesis's."""

DIFFERENCES = {
    "table_4_1": (
        "The thesis timed the NPU Drone-Map dataset (300 m high, 12,744 to 19,983 frames, one frame a second at half "
        "HD) on an Intel i7-6700HQ; here the videos of UMCD are mapped, and with --npu those of that dataset, on "
        "another computer. Seconds of processor time for a keyframe can be compared, minutes cannot.",
        "Pix4D, Photoscan and the program of Bu et al. [17] are not run here. Their column is the thesis's.",
    ),
    "section_4_1_1": (
        "Deviation is the mean absolute difference of gray levels over 255, over all pixels of up to 120 keyframes. "
        "The thesis gives 'about 15 %' without its unit.",
        "The correlation is that of our two methods' maps of one flight (eq. 4.1); the thesis's is that of its "
        "mosaics and those of Bu et al. [17], which --npu measures as well.",
    ),
    "tables_4_3_and_4_4": (
        "The thesis compared every frame; here five views a second are compared, since neighbouring frames show the "
        "same again.",
        "Where there are change masks, a frame is positive where any pixel is. Without them the seconds of appearance "
        "in the metadata decide, else those of Table 2.4, less one second around each, since they are rounded.",
        "All methods share one map (method planar) and one alignment, so that only the comparison differs.",
    ),
    "table_4_5": (
        "UMCD has no change masks; the thesis does not state by what its pixels were judged. Ours are strict: the "
        "shadow of a thing is a false pixel.",
        "Without masks only frames that surely show no object are judged: all their changed pixels are false.",
    ),
    "section_4_2_2": (
        "Measured on two frames of the dataset, on another computer; the thesis does not state the size of its "
        "pictures.",
    ),
    "table_4_6": (
        "The thesis trained on a GPU for 2,000 epochs in four steps; here for as many batches as the table names, a "
        "quarter for each step. `--train-steps N` comes closer.",
        "The thesis's mAP is a mean of precisions (eqs 4.3, 4.4): it does not count what was missed. AP50 beside it "
        "does.",
        "UMCD's metadata gives no places in the frames; the thesis's labels of 4,088 frames are not public. Without "
        "places the boxes are those of the comparison (robust) where one object alone is in view.",
    ),
}
"""Why our figures are not the thesis's, by table."""
