"""A process that cuts a piece out of one frame of a video, within limits of memory and time."""

import json
import sys

import av
import cv2
import numpy as np

from sorvolo.capture.video_stream import ONE_FILE
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.station.check_upload import limit_process
from sorvolo.store.images import jpeg_from_image

_CPU_S = 25  # within the 30 s that the station waits
_MOST_FRAMES = 2000  # decoded after the nearest key frame: some pictures apart in what drones write


def frame_of(path: str, number: int) -> ImageRGB:
    """(H, W, 3) the frame of a number, counted from 0 by the video's rate. Raises ValueError where there is none."""
    with av.open(path, options=ONE_FILE) as video:
        stream = video.streams.video[0]
        rate, base = stream.average_rate or stream.guessed_rate, stream.time_base
        if rate is None or base is None:
            raise ValueError("the video states no rate")
        wanted = (stream.start_time or 0) + int(number / rate / base)
        half = int(0.5 / rate / base)
        video.seek(max(wanted - half, 0), stream=stream)
        for count, frame in enumerate(video.decode(stream)):
            if frame.pts is not None and frame.pts >= wanted - half:
                return np.asarray(frame.to_ndarray(format="rgb24"), np.uint8)
            if count > _MOST_FRAMES:
                break
    raise ValueError(f"no frame {number}")


def main() -> None:
    """Read an order from stdin, write a JPEG to stdout."""
    limit_process(_CPU_S)
    order = json.load(sys.stdin)
    image, side = frame_of(order["path"], int(order["frame"])), int(order["side_px"])
    height, width = image.shape[:2]
    corners = (np.array(order["corners"]) * [width, height] - 0.5).astype(np.float32)
    square = (np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * side - 0.5).astype(np.float32)
    crop_from_image = cv2.getPerspectiveTransform(corners, square)
    crop = cv2.warpPerspective(
        image, crop_from_image, (side, side), flags=cv2.INTER_LINEAR, borderValue=(127,) * 3
    )
    sys.stdout.buffer.write(jpeg_from_image(np.asarray(crop, np.uint8)))


if __name__ == "__main__":
    main()
