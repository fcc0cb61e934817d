"""`sorvolo calibrate`: a camera file from pictures of a checkerboard."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.table import Table

from sorvolo.cli.options import AsJson, OutFile, argument, option
from sorvolo.cli.printing import Console, print_json
from sorvolo.survey.wording import counted

if TYPE_CHECKING:
    pass


def calibrate(
    inputs: Annotated[list[Path], argument("Photos of the board, a folder of photos, or a video.")],
    board: Annotated[str, option("Inner corners of the board, such as 9x6 for 10 x 7 squares.")],
    out: OutFile = Path("camera.xml"),
    as_json: AsJson = False,
) -> None:
    """Make a camera file from pictures of a checkerboard, taken with the size and zoom that will fly.

    Example: sorvolo calibrate board_video.mp4 --board 9x6 --out camera.xml
    """
    from sorvolo.capture.checkerboard import BoardView
    from sorvolo.missions.calibrate_camera import (
        calibrate_camera,
        find_views,
        parse_board,
        write_calibration,
    )

    chessboard = parse_board(board)
    looked = []
    with Console(stderr=True).status("searching for the board") as status:
        for picture in find_views(inputs, chessboard):
            looked.append(picture)
            found = sum(isinstance(view.view, BoardView) for view in looked)
            status.update(f"board found in {found} of {counted(len(looked), 'picture')}")
        status.update("computing the camera")
        result = calibrate_camera(looked, chessboard)
    write_calibration(out, result)
    if as_json:
        print_json(
            {
                "written": str(out),
                "width_px": result.camera.width_px,
                "height_px": result.camera.height_px,
                "camera_matrix": result.camera.matrix.tolist(),
                "distortion": dict(
                    zip(("k1", "k2", "p1", "p2", "k3"), result.camera.distortion.tolist())
                ),
                "reprojection_error_px": result.reprojection_error_px,
                "focal_sigma": result.focal_sigma,
                "view_errors_px": result.view_errors_px,
                "dropped": list(result.dropped),
                "tilt_spread_deg": result.tilt_spread_deg,
                "coverage": result.coverage,
            }
        )
    else:
        camera, table = result.camera, Table("view", "error, px", title="Reprojection error")
        for name, error_px in result.view_errors_px.items():
            table.add_row(name, f"{error_px:.3f}")
        for name in result.dropped:
            table.add_row(name, "left out: contradicts the others")
        console = Console()
        console.print(table)
        k1, k2, p1, p2, k3 = camera.distortion
        console.print(
            f"{out}: {camera.width_px}x{camera.height_px}, focal length {camera.fx_px:.1f} x "
            f"{camera.fy_px:.1f} px "
            f"(1 sigma {result.focal_sigma:.2%}), centre {camera.cx_px:.1f}, {camera.cy_px:.1f}\n"
            f"k1 {k1:.5f}  k2 {k2:.5f}  p1 {p1:.5f}  p2 {p2:.5f}  k3 {k3:.5f}\n"
            f"reprojection error {result.reprojection_error_px:.3f} px rms over {len(result.view_errors_px)} views; tilts "
            f"differ by up to {result.tilt_spread_deg:.0f} deg; {result.coverage:.0%} of the picture covered"
        )
