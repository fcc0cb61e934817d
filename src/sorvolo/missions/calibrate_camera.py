"""A calibration file from pictures of a checkerboard."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from sorvolo.capture.calibration import camera_xml
from sorvolo.capture.checkerboard import (
    Board,
    BoardView,
    Calibration,
    NoBoard,
    calibrate,
    find_board,
)
from sorvolo.capture.source import open_sources
from sorvolo.errors import InputError, SettingsError
from sorvolo.paths import AnyPath, Inputs, listed
from sorvolo.store.atomic import atomic_write_bytes
from sorvolo.survey.flight import LostFrame

_MOST_LOOKED_AT = 200  # frames of a video, which bounds the time
_LOOKS_PER_S = 3.0  # of a board that a hand turns


@dataclass(frozen=True)
class Looked:
    """One picture was searched for the board."""

    view: BoardView | NoBoard
    width_px: int
    height_px: int


def parse_board(text: str) -> Board:
    """The board of "9x6", counted in inner corners. Raises SettingsError for anything else."""
    columns, _, rows = text.lower().partition("x")
    if not (columns.isdecimal() and rows.isdecimal()):
        raise SettingsError(
            f"--board {text!r}: give the inner corners a row and a column, such as 9x6"
        )
    return Board(int(columns), int(rows))


def find_views(inputs: Inputs, board: Board) -> Iterator[Looked]:
    """Search photos, or some three frames a second of videos, for the board; one record a picture.

    Raises InputError for inputs that cannot be read or whose pictures differ in size.
    """
    files = [Path(each) for each in listed(inputs)]
    size_px = (0, 0)
    for source in open_sources(files):
        step = 1  # every photo is looked at
        if source.kind != "photos":
            step = max(
                1, round(source.frame_rate_hz / _LOOKS_PER_S), source.frame_count // _MOST_LOOKED_AT
            )
        for frame in source.frames(lambda index, _, step=step: index % step == 0):  # type: ignore[misc]
            if isinstance(frame, LostFrame):
                continue
            height_px, width_px = frame.image.shape[:2]
            if size_px not in ((0, 0), (width_px, height_px)):
                raise InputError(
                    f"{frame.name}: {width_px}x{height_px}, but the pictures before it are "
                    f"{size_px[0]}x{size_px[1]}; one camera in one mode is calibrated at a time"
                )
            size_px = (width_px, height_px)
            yield Looked(find_board(frame.name, frame.image, board), width_px, height_px)


def calibrate_camera(looked: Sequence[Looked], board: Board) -> Calibration:
    """The camera from all pictures that were searched. Raises InputError for too few or too similar views."""
    views = [each.view for each in looked if isinstance(each.view, BoardView)]
    if not views:
        raise InputError(
            f"no board of {board.columns}x{board.rows} inner corners in any of {len(looked)} pictures; "
            "count the "
            "corners where four squares meet, not the squares, and keep the whole board with its white "
            "rim in view"
        )
    return calibrate(views, board, looked[0].width_px, looked[0].height_px)


def write_calibration(path: AnyPath, calibration: Calibration) -> None:
    """Write the camera file, whole or not at all. Raises StoreError when it cannot be written."""
    path = Path(path)
    text = camera_xml(
        calibration.camera,
        reprojection_error_px=calibration.reprojection_error_px,
        views=len(calibration.view_errors_px),
        focal_sigma=calibration.focal_sigma,
    )
    atomic_write_bytes(path, text.encode())
