"""The camera as an earlier flight over the site estimated it: better than a guess before a flight."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from sorvolo.registration.lens import refined_camera
from sorvolo.store.site.archive import Archive
from sorvolo.survey.flight import CameraModel

_CALIBRATED = 0.005  # relative: a focal length known so well is no guess
_SURER = 0.5  # times the guess's sigma, at most: a preset that is hardly less sure is left as it is
_UNSURE = 0.1  # relative: so bad a guess is warned of, and a camera that was given for other flights is worth a look
_GIVEN = 0.03  # relative: a camera that a person gave is known so well
_BETWEEN_CAMERAS = 0.01  # relative: another specimen of the same model, or another focus


def known_camera(guess: CameraModel, archive: Archive) -> CameraModel:
    """The guess with the focal length and distortion that mapping this site found for the same camera.

    Cameras match if make, model, lens and picture size do. Of several flights the surest counts. A calibrated camera, and one that no flight knows much
    better, comes back as it is. Where nothing at all is known of the camera and an earlier flight was given one for
    pictures of the same size, the words name it: nothing shows that it is the same, so a person has to decide.
    """
    if guess.focal_sigma <= _CALIBRATED:
        return guess
    best, limit = guess, _SURER * guess.focal_sigma
    reported = {flight.id: archive.report(flight.id).get("camera") for flight in archive.flights()}
    for flight_id, camera in reported.items():
        found = _found(guess, flight_id, camera)
        if found is not None and found.focal_sigma < limit:
            best, limit = found, found.focal_sigma
    if best is guess and guess.focal_sigma > _UNSURE:
        return replace(guess, origin=guess.origin + _given_before(guess, reported))
    return best


def _given_before(guess: CameraModel, reported: Mapping[str, Any]) -> str:
    """Which flight was given a camera for pictures of the same size, the surest of them, in words; "" for none."""
    size = guess.camera.width_px, guess.camera.height_px
    given = [
        (float(camera.get("focal_sigma_relative") or 1.0), flight_id, camera.get("origin"))
        for flight_id, camera in reported.items()
        if isinstance(camera, dict) and (camera.get("width_px"), camera.get("height_px")) == size
    ]
    sigma, flight_id, origin = min(given, default=(1.0, "", ""))
    if sigma > _GIVEN:
        return ""
    return (
        f"; flight {flight_id} of this site had one for pictures of this size ({origin}): if this flight's is the same "
        "camera, give it again with --camera"
    )


def _found(guess: CameraModel, flight_id: str, reported: Any) -> CameraModel | None:
    """This camera by a report's part on the camera; None where it is another or was not estimated."""
    camera = guess.camera
    same = {"origin": guess.origin, "width_px": camera.width_px, "height_px": camera.height_px}
    if not isinstance(reported, dict) or any(
        reported.get(key) != value for key, value in same.items()
    ):
        return None
    focal_px, sigma = reported.get("focal_found_px"), reported.get("focal_found_sigma_relative")
    if not focal_px or not sigma:
        return None
    refined = refined_camera(camera, focal_px / camera.fx_px, reported.get("radial_found") or 0.0)
    words = f"as flight {flight_id} of this site found it: {focal_px:.0f} px; before that {guess.origin}"
    return CameraModel(refined, words, max(float(sigma), _BETWEEN_CAMERAS))
