"""A site renamed, or deleted for good: what would be lost with it, what stands against it, and its folder gone at once."""

import errno
import hashlib
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Header, Response
from pydantic import Field

from sorvolo.errors import StoreError
from sorvolo.paths import Json
from sorvolo.station.orders import Wish
from sorvolo.station.problems import Problem
from sorvolo.station.reviews import Drawings, Reviews
from sorvolo.station.runs import Runs
from sorvolo.station.security import FOR_OPERATORS
from sorvolo.station.sites import SiteShelf
from sorvolo.store.atomic import writing
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue_place import CATALOGUE, catalogue_file
from sorvolo.store.site.files import COPYING, ORIGIN, BusyError, lock_folder


class SiteDeletion:
    """Deletes sites. A folder that goes is moved into `bin_folder` first, so that nobody ever sees half a site."""

    def __init__(
        self,
        shelf: SiteShelf,
        runs: Runs,
        reviews: Reviews,
        drawings: Drawings,
        bin_folder: Path,
    ) -> None:
        self._shelf, self._runs, self._reviews, self._drawings = shelf, runs, reviews, drawings
        self._bin = bin_folder

    def loss(self, site_id: str) -> Json:
        """What would be lost: the site's folder with all that lies in it, and what the station keeps of it.

        `etag` is the mark of what was counted, with which it can be deleted; `flights` and `versions` are None for a
        site that cannot be read; `missions` are records of missions that are over, with what watches found.
        Raises Problem: 404, 409 where it cannot be deleted now, with the reason.
        """
        with self._free(site_id) as folder:
            flights, versions, mark = self._known(site_id, folder)
        # every file of the folder, links as they are and not followed
        sizes = [
            Path(place, name).lstat().st_size
            for place, _, names in os.walk(folder)
            for name in names
        ]
        return {
            "site": site_id,
            "flights": flights,
            "versions": versions,
            "files": len(sizes),
            "bytes": sum(sizes),
            "missions": len(self._runs.of_site(site_id)),
            "etag": f'"{mark}"',
        }

    def rename(self, site_id: str, name: str) -> None:
        """Give the site another name. Raises Problem: 404, 409 as `loss`."""
        with (
            self._runs.unused_site(site_id),
            Archive.open(self._shelf.folder(site_id), write=True) as archive,
        ):
            archive.rename(name)

    def delete(self, site_id: str, mark: str) -> None:
        """Delete the site as `loss` counted it.

        Raises Problem: 404, 409 as `loss`, 412 where it was given flights since; StoreError where its folder cannot
        be moved.
        """
        with self._free(site_id) as folder:
            if mark != self._known(site_id, folder)[2]:
                raise Problem(
                    412, f"the site {site_id!r} has changed since; look again at what would be lost"
                )
            # where the folder lies now, unseen. Raises StoreError where it cannot be moved:
            # the site is as it was
            gone = self._bin / secrets.token_hex(8)
            with writing(self._bin):
                self._bin.mkdir(mode=0o700, exist_ok=True)
            try:
                folder.rename(gone)
            except OSError as error:
                words = (
                    "it lies on another disk than the station's own"
                    if error.errno == errno.EXDEV
                    else error.strerror
                )
                raise StoreError(
                    f"cannot delete {folder} ({words}); delete the folder itself"
                ) from error
            try:
                # drop what the station keeps of a site whose folder is gone
                self._shelf.forget(site_id)
                for run in self._runs.of_site(site_id):
                    self._runs.delete(run.id)
                self._reviews.forget(site_id)
                self._drawings.forget(site_id)
            finally:
                shutil.rmtree(gone, ignore_errors=True)

    def clear(self) -> None:
        """Remove what a killed station had moved away and not yet removed."""
        if self._bin.is_dir() and not self._bin.is_symlink():
            shutil.rmtree(self._bin, ignore_errors=True)

    # ---- inside -----------------------------------------------------------------------------------------------

    @contextmanager
    def _free(self, site_id: str) -> Iterator[Path]:
        """The site's folder, while no mission begins on it and no other program writes it."""
        with self._runs.unused_site(site_id):
            folder = self._shelf.folder(site_id)
            # raise Problem (409) for a site of which the folder is not the whole, or more
            file = catalogue_file(folder)
            reasons = {
                "is the folder that the station serves; end it, and delete that": folder
                == self._shelf.root,
                "has its catalogue in PostgreSQL; drop its schema, delete its folder": file is None
                or file.name != CATALOGUE,
                "is a working copy of a site in a store, and would come back; delete that": (
                    folder / ORIGIN
                ).exists(),
                "is being copied; finish that with the same `sorvolo site copy`": (
                    folder / COPYING
                ).exists(),
            }
            for why, is_so in reasons.items():
                if is_so:
                    raise Problem(409, f"the site {site_id!r} {why}")
            try:
                lock = lock_folder(folder)
            except BusyError as error:
                raise Problem(
                    409, f"another program writes the site {site_id!r}; wait until it is done"
                ) from error
            try:
                yield folder
            finally:
                os.close(lock)

    def _known(self, site_id: str, folder: Path) -> tuple[int | None, int | None, str]:
        """Flights and versions of the site's catalogue, None where it cannot be read; another mark after each flight.

        Raises Problem (410) where the folder goes meanwhile.
        """
        try:
            about = (folder / CATALOGUE).stat()
        except OSError as error:
            raise Problem(
                410, f"the site {site_id!r} was deleted meanwhile; /api/sites lists the others"
            ) from error
        try:
            complete = self._shelf.open(site_id).versions()
        except (
            StoreError,
            Problem,
        ):
            # damaged, or a stranger's with links in it: all the more it may go
            return None, None, _mark(about.st_dev, about.st_ino)
        flights = len({each.flight_id for each in complete})
        newest = max((each.id for each in complete), default=0)
        return flights, len(complete), _mark(about.st_dev, about.st_ino, flights, newest)


class NameWish(Wish):
    """What a site shall be called."""

    name: Annotated[str, Field(min_length=1, max_length=80, pattern=r"\S")]


def site_deletion_routes(deletion: SiteDeletion) -> APIRouter:
    """What a site's deletion would take, and the deletion itself."""
    router = APIRouter(prefix="/api/sites", tags=["sites"], dependencies=FOR_OPERATORS)

    @router.get("/{site}/deletion")
    def loss(site: str, response: Response) -> Json:
        """What would be lost with the site; `etag`, the answer's ETag, is what its deletion needs. 409: why it cannot
        be deleted now."""
        found = deletion.loss(site)
        response.headers["etag"] = found["etag"]
        return found

    @router.put("/{site}/name", status_code=204)
    def rename(site: str, wish: NameWish) -> None:
        """Give a site another name; its folder and addresses stay. 409 while a mission runs on it."""
        deletion.rename(site, wish.name)

    @router.delete("/{site}", status_code=204)
    def delete(site: str, if_match: Annotated[str, Header(max_length=100)] = "") -> Response:
        """Delete a site for good: its folder, verdicts, drawings, and the records of its missions with what watches
        found. Recordings and uploads stay. If-Match is the ETag of `/deletion` (428 without, 412 where a flight came
        since); 409 while a mission runs on it, or another program writes it."""
        if not if_match:
            raise Problem(
                428, "send the ETag of what would be lost (GET below it: /deletion) as If-Match"
            )
        deletion.delete(site, if_match.removeprefix("W/").strip('"'))
        return Response(status_code=204)

    return router


def _mark(*parts: int) -> str:
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:16]
