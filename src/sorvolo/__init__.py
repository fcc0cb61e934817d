"""Sorvolo: geo-referenced maps from small drones while they fly, and what changed on the ground since.

What the commands do is here under the names in `__all__` (docs/python.md shows each); a name is loaded when
it is first used, so that `import sorvolo` alone is quick.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from sorvolo.build import VERSION

if TYPE_CHECKING:
    from sorvolo.capture.areas import read_area
    from sorvolo.capture.live.reconnect import LiveSettings
    from sorvolo.change.compare import Comparison, compare_images
    from sorvolo.change.robust import RobustSettings
    from sorvolo.detection.contract import ModelInfo
    from sorvolo.detection.detector import Detector
    from sorvolo.errors import GeometryError, InputError, SettingsError, SorvoloError, StoreError
    from sorvolo.geometry.geodesy import LocalFrame
    from sorvolo.lab.datasets import read_dataset
    from sorvolo.lab.evaluation.changes import evaluate_changes
    from sorvolo.lab.evaluation.detector import (
        EvaluationSettings,
        evaluate_detector,
        read_sets,
        write_evaluation,
    )
    from sorvolo.lab.evaluation.mosaic import evaluate_mosaic
    from sorvolo.lab.simulation.pictures import PictureSettings, simulate_pictures
    from sorvolo.lab.simulation.presets import preset, preset_names
    from sorvolo.lab.simulation.settings import SimulationSettings
    from sorvolo.lab.simulation.site import simulate_site
    from sorvolo.lab.thesis.changes import (
        ThesisSettings,
        compare_thesis,
        prepare_reference,
        thesis_steps,
    )
    from sorvolo.lab.training.detector import train_detector
    from sorvolo.lab.training.sets import DataOptions
    from sorvolo.lab.training.settings import TrainSettings
    from sorvolo.missions.calibrate_camera import (
        calibrate_camera,
        find_views,
        parse_board,
        write_calibration,
    )
    from sorvolo.missions.compare.flights import compare_flights
    from sorvolo.missions.flight.detector_protocol import FindsObjects
    from sorvolo.missions.flight.request import AlreadyDone
    from sorvolo.missions.flight.settings import CompareSettings, MapSettings
    from sorvolo.missions.heights.measure import measure_profile, measure_volume, write_contours
    from sorvolo.missions.heights.run import HeightsUpdate, make_heights
    from sorvolo.missions.inspect import inspect_input
    from sorvolo.missions.map.flights import map_flights
    from sorvolo.missions.plan_flight import (
        PlanSettings,
        answer_questions,
        camera_to_plan_with,
        plan_over,
        write_plan,
    )
    from sorvolo.missions.search.flights import search_site
    from sorvolo.missions.search.settings import SearchOutputs, SearchSettings
    from sorvolo.missions.telemetry.doctor import CotReceiver, correct_telemetry
    from sorvolo.missions.watch.cot_sender import CotPlace, CotTls
    from sorvolo.missions.watch.flights import watch
    from sorvolo.missions.watch.run import WatchUpdate
    from sorvolo.missions.watch.settings import WatchOutputs, WatchSettings
    from sorvolo.store.site.archive import Archive
    from sorvolo.store.site.change_records import StoredChange
    from sorvolo.survey.area import Area
    from sorvolo.survey.findings import Change, ChangeKind, CompareUpdate, Verdict
    from sorvolo.survey.flight import CameraModel, Frame, Notice, Site, Telemetry
    from sorvolo.survey.map_objects import MapObject
    from sorvolo.survey.mosaic import MosaicUpdate, Status
    from sorvolo.survey.objects import Detections, Track

__version__ = VERSION

__all__ = [
    "AlreadyDone",
    "Archive",
    "Area",
    "CameraModel",
    "Change",
    "ChangeKind",
    "CompareSettings",
    "CompareUpdate",
    "Comparison",
    "CotPlace",
    "CotReceiver",
    "CotTls",
    "DataOptions",
    "Detections",
    "Detector",
    "EvaluationSettings",
    "FindsObjects",
    "Frame",
    "GeometryError",
    "HeightsUpdate",
    "InputError",
    "LiveSettings",
    "LocalFrame",
    "MapObject",
    "MapSettings",
    "ModelInfo",
    "MosaicUpdate",
    "Notice",
    "PictureSettings",
    "PlanSettings",
    "RobustSettings",
    "SearchOutputs",
    "SearchSettings",
    "SettingsError",
    "SimulationSettings",
    "Site",
    "SorvoloError",
    "Status",
    "StoreError",
    "StoredChange",
    "Telemetry",
    "ThesisSettings",
    "Track",
    "TrainSettings",
    "Verdict",
    "WatchOutputs",
    "WatchSettings",
    "WatchUpdate",
    "__version__",
    "answer_questions",
    "calibrate_camera",
    "camera_to_plan_with",
    "compare_flights",
    "compare_images",
    "compare_thesis",
    "correct_telemetry",
    "evaluate_changes",
    "evaluate_detector",
    "evaluate_mosaic",
    "find_views",
    "inspect_input",
    "make_heights",
    "map_flights",
    "measure_profile",
    "measure_volume",
    "parse_board",
    "plan_over",
    "prepare_reference",
    "preset",
    "preset_names",
    "read_area",
    "read_dataset",
    "read_sets",
    "search_site",
    "simulate_pictures",
    "simulate_site",
    "thesis_steps",
    "train_detector",
    "watch",
    "write_calibration",
    "write_contours",
    "write_evaluation",
    "write_plan",
]

_HOMES = {
    "survey.mosaic": (
        "MosaicUpdate",
        "Status",
    ),
    "survey.map_objects": ("MapObject",),
    "survey.flight": (
        "CameraModel",
        "Frame",
        "Notice",
        "Site",
        "Telemetry",
    ),
    "survey.area": ("Area",),
    "store.site.change_records": ("StoredChange",),
    "missions.watch.cot_sender": (
        "CotPlace",
        "CotTls",
    ),
    "missions.heights.measure": ("measure_profile", "measure_volume", "write_contours"),
    "missions.flight.request": ("AlreadyDone",),
    "missions.flight.detector_protocol": ("FindsObjects",),
    "geometry.geodesy": ("LocalFrame",),
    "detection.contract": ("ModelInfo",),
    "capture.live.reconnect": ("LiveSettings",),
    "capture.areas": ("read_area",),
    "change.compare": ("Comparison", "compare_images"),
    "change.robust": ("RobustSettings",),
    "detection.detector": ("Detector",),
    "errors": ("GeometryError", "InputError", "SettingsError", "SorvoloError", "StoreError"),
    "lab.datasets": ("read_dataset",),
    "lab.evaluation.changes": ("evaluate_changes",),
    "lab.evaluation.detector": (
        "EvaluationSettings",
        "evaluate_detector",
        "read_sets",
        "write_evaluation",
    ),
    "lab.evaluation.mosaic": ("evaluate_mosaic",),
    "lab.simulation.site": ("simulate_site",),
    "lab.simulation.pictures": ("PictureSettings", "simulate_pictures"),
    "lab.simulation.presets": ("preset", "preset_names"),
    "lab.simulation.settings": ("SimulationSettings",),
    "lab.thesis.changes": (
        "ThesisSettings",
        "compare_thesis",
        "prepare_reference",
        "thesis_steps",
    ),
    "lab.training.detector": ("train_detector",),
    "lab.training.sets": ("DataOptions",),
    "lab.training.settings": ("TrainSettings",),
    "missions.calibrate_camera": (
        "calibrate_camera",
        "find_views",
        "parse_board",
        "write_calibration",
    ),
    "missions.compare.flights": ("compare_flights",),
    "missions.flight.settings": ("CompareSettings", "MapSettings"),
    "missions.heights.run": ("HeightsUpdate", "make_heights"),
    "missions.inspect": ("inspect_input",),
    "missions.map.flights": ("map_flights",),
    "missions.plan_flight": (
        "PlanSettings",
        "answer_questions",
        "camera_to_plan_with",
        "plan_over",
        "write_plan",
    ),
    "missions.search.flights": ("search_site",),
    "missions.search.settings": ("SearchOutputs", "SearchSettings"),
    "missions.telemetry.doctor": ("CotReceiver", "correct_telemetry"),
    "missions.watch.flights": ("watch",),
    "missions.watch.run": ("WatchUpdate",),
    "missions.watch.settings": ("WatchOutputs", "WatchSettings"),
    "store.site.archive": ("Archive",),
    "survey.findings": (
        "Change",
        "ChangeKind",
        "CompareUpdate",
        "Verdict",
    ),
    "survey.objects": (
        "Track",
        "Detections",
    ),
}


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            return getattr(import_module(f"{__name__}.{home}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
