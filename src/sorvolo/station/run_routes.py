"""The routes of missions: what they can be started on, started, looked at, stopped, taken away."""

from typing import Any

from fastapi import APIRouter, Depends, Query

from sorvolo.station.ingest import Ingest
from sorvolo.station.inputs import Inputs, input_row
from sorvolo.station.orders import RunWish
from sorvolo.station.runs import Runs, run_row
from sorvolo.station.security import needs
from sorvolo.station.tokens import Holder, Role


def run_routes(runs: Runs, inputs: Inputs, ingest: Ingest) -> APIRouter:
    """Missions by the API, as from the command line."""
    router = APIRouter(tags=["runs"])

    @router.get("/api/inputs", dependencies=[Depends(needs(Role.VIEW))])
    def list_inputs() -> list[dict[str, Any]]:
        """Videos, folders of photos, telemetry and camera files below the station's folder."""
        return [input_row(each) for each in inputs.all()]

    @router.get("/api/runs", dependencies=[Depends(needs(Role.VIEW))])
    def all_runs(
        site: str = Query("", max_length=200),
        limit: int = Query(200, ge=1, le=1000),
    ) -> list[dict[str, Any]]:
        """The newest missions first, of all sites or of one."""
        return [run_row(each) for each in runs.all(limit, site)]

    @router.post("/api/runs", status_code=201)
    def start(wish: RunWish, holder: Holder = Depends(needs(Role.OPERATE))) -> dict[str, Any]:
        """Start a mission: map, compare, watch or search. 409 while another one writes into the site."""
        return run_row(runs.start(wish, holder.name))

    @router.get("/api/runs/{run_id}", dependencies=[Depends(needs(Role.VIEW))])
    def one(run_id: str) -> dict[str, Any]:
        """A mission: its state (running, finished, incomplete, failed, stopped, lost), how far it is, how it ended."""
        return run_row(runs.get(run_id))

    @router.post("/api/runs/{run_id}/stop", dependencies=[Depends(needs(Role.OPERATE))])
    def stop(run_id: str) -> dict[str, Any]:
        """Ask it to end: a live flight is finished and kept, a recorded one is left out."""
        return run_row(runs.stop(run_id))

    @router.delete(
        "/api/runs/{run_id}", status_code=204, dependencies=[Depends(needs(Role.OPERATE))]
    )
    async def delete(run_id: str) -> None:
        """Take a mission that is over away: its record, what a watch found, the recording of its camera. The map that
        it made stays. 409 while it runs, 423 while another mission reads the recording."""
        stream = runs.stream_of(run_id)
        with runs.unused_stream(stream, but=run_id):
            runs.delete(run_id)
            if stream and ingest.newest(stream) is not None:
                ingest.delete(stream)

    return router
