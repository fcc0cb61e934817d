"""`sorvolo calibrate`: a camera file from pictures of a checkerboard."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

if TYPE_CHECKING:
    from sorvolo.capture.checkerboard import Calibration


def calibrate(
    inputs: Annotated[list[Path], typer.Argument(help="Photos, a folder of them, or a video of the board.")],
    board: Annotated[str, typer.Option(help="Inner corners, such as 9x6 for a board of 10 x 7 squares.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Camera file to write.")] = Path("camera.xml"),
    square: Annotated[float, typer.Option(help="Side of a square, mm.")] = 25.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Make a camera file from pictures of a checkerboard, in the mode (size, zoom) that will fly.

    Example: sorvolo calibrate board_video.mp4 --board 9x6 -o camera.xml
    """
    from sorvolo.capture.checkerboard import BoardView
    from sorvolo.missions.calibrate_camera import calibrate_camera, find_views, parse_board, write_calibration

    chessboard = parse_board(board, square)
    looked = []
    with Console(stderr=True).status("looking for the board") as status:
        for each in find_views(inputs, chessboard):
            looked.append(each)
            found = sum(isinstance(view.view, BoardView) for view in looked)
            status.update(f"board found in {found} of {len(looked)} pictures")
        status.update("solving for the camera")
        result = calibrate_camera(looked, chessboard)
    write_calibration(out, result)
    if as_json:
        typer.echo(json.dumps(_as_json(result, out), indent=1))
    else:
        _show(result, out)


def _show(result: "Calibration", out: Path) -> None:
    camera, table = result.camera, Table("view", "error, px", title="Reprojection error")
    for name, error_px in result.view_errors_px.items():
        table.add_row(name, f"{error_px:.3f}")
    for name in result.dropped:
        table.add_row(name, "left out: does not fit the others")
    console = Console()
    console.print(table)
    k1, k2, p1, p2, k3 = camera.distortion
    console.print(
        f"{out}: {camera.width_px}x{camera.height_px}, focal length {camera.fx_px:.1f} x "
        f"{camera.fy_px:.1f} px "
        f"(good to {result.focal_sigma:.2%}), centre {camera.cx_px:.1f}, {camera.cy_px:.1f}\n"
        f"k1 {k1:.5f}  k2 {k2:.5f}  p1 {p1:.5f}  p2 {p2:.5f}  k3 {k3:.5f}\n"
        f"{result.reprojection_error_px:.3f} px rms over {len(result.view_errors_px)} views, tilts up to "
        f"{result.tilt_spread_deg:.0f} deg apart, {result.coverage:.0%} of the picture covered"
    )


def _as_json(result: "Calibration", out: Path) -> dict[str, object]:
    camera = result.camera
    return {
        "written": str(out),
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "camera_matrix": camera.matrix.tolist(),
        "distortion": dict(zip(("k1", "k2", "p1", "p2", "k3"), camera.distortion.tolist())),
        "reprojection_error_px": result.reprojection_error_px,
        "focal_sigma": result.focal_sigma,
        "view_errors_px": result.view_errors_px,
        "dropped": list(result.dropped),
        "tilt_spread_deg": result.tilt_spread_deg,
        "coverage": result.coverage,
    }
