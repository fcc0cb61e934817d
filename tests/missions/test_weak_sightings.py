"""What a detector saw too weakly to report is evidence for the objects on the map, and no sighting."""

import numpy as np

from sorvolo.detection.contract import ModelInfo
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.ground import footprint
from sorvolo.geometry.homography import site_from_image_homography
from sorvolo.geometry.pose import Pose, site_from_gimbal_rotation
from sorvolo.missions.flight.map_objects import FrameDetections, ObjectFinder
from sorvolo.survey.mosaic import PlacedFrame, Status
from sorvolo.survey.objects import CLASSES, Detections

CAMERA = Camera(960, 540, 800.0, 800.0, 479.5, 269.5)
LEAST = {"person": 0.7, "car": 0.7, "small object": 0.7}


class Silent:
    """A detector that is asked nothing."""

    classes, provider, notices = CLASSES, "none", ()
    info = ModelInfo("silent", CLASSES, LEAST, dict.fromkeys(CLASSES, (4.0, 400.0)))


def placed(index: int) -> PlacedFrame:
    """One of several frames from the same place, 30 m up."""
    pose = Pose(site_from_gimbal_rotation(90.0, -90.0, 0.0), np.array([0.0, 0.0, 30.0]))
    return PlacedFrame(
        str(index),
        index,
        index * 10**9,
        Status.VISION,
        "",
        CAMERA,
        pose,
        site_from_image_homography(CAMERA, pose),
        footprint(CAMERA, pose),
        0.2,
        0.5,
    )


def searched(scores: list[float]) -> ObjectFinder:
    """A finder whose frames each saw one person in one place, with these scores."""
    finder = ObjectFinder(Silent(), CAMERA)  # type: ignore[arg-type]
    for index, score in enumerate(scores):
        seen = Detections(
            np.array([[470.0, 260.0, 486.0, 274.0]]), np.array([score]), np.array([0]), CLASSES
        )
        finder._seen[index] = FrameDetections(index, seen, (b"",), 0.1, LEAST)
    return finder


def test_weak_sightings_decide_and_are_not_counted() -> None:
    """Of four views two report a person: with 0.65 in the others it stands there, with 0.06 it does not."""
    for others, count in ((0.65, 1), (0.06, 0)):
        finder = searched([0.7, others, 0.7, others])
        search = finder.conclude([placed(k) for k in range(4)], "flight1", has_metres=True)
        assert len(search.objects) == count
        assert search.sightings == 2 and search.dropped == 2 - 2 * count
        assert [each.score for each in finder.sightings] == [0.7, 0.7]
        finder.close()
