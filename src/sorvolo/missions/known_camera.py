"""The camera as an earlier flight over the site got to know it: better than what is guessed of it before a flight."""

from typing import Any

from sorvolo.mosaic.lens import refined_camera
from sorvolo.store.archive import Archive
from sorvolo.survey.flight import CameraModel

_CALIBRATED = 0.005  # relative: a focal length known so well is no guess
_SURER = 0.5  # times the guess's sigma, at most: a preset that is hardly less sure is left as it is
_BETWEEN_CAMERAS = 0.01  # relative: another specimen of the same model, or another focus


def known_camera(guess: CameraModel, archive: Archive) -> CameraModel:
    """The guess with the focal length and distortion that mapping this site found for the same camera.

    The same camera is one whose numbers come from the same words (make, model and lens are in them) for pictures of
    the same size. Of several flights the surest counts. A calibrated camera, and one that no flight knows much
    better, comes back as it is.
    """
    if guess.focal_sigma <= _CALIBRATED:
        return guess
    best, limit = guess, _SURER * guess.focal_sigma
    for flight in archive.flights():
        found = _found(guess, flight.id, archive.report(flight.id).get("camera"))
        if found is not None and found.focal_sigma < limit:
            best, limit = found, found.focal_sigma
    return best


def _found(guess: CameraModel, flight_id: str, told: Any) -> CameraModel | None:
    """What a report's part on the camera says of this one; None where it is another or was not sought."""
    camera = guess.camera
    same = {"origin": guess.origin, "width_px": camera.width_px, "height_px": camera.height_px}
    if not isinstance(told, dict) or any(told.get(key) != value for key, value in same.items()):
        return None
    focal_px, sigma = told.get("focal_found_px"), told.get("focal_found_sigma_relative")
    if not focal_px or not sigma:
        return None
    refined = refined_camera(camera, focal_px / camera.fx_px, told.get("radial_found") or 0.0)
    words = f"as flight {flight_id} of this site found it: {focal_px:.0f} px; before that {guess.origin}"
    return CameraModel(refined, words, max(float(sigma), _BETWEEN_CAMERAS))
