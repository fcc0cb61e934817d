"""WMTS 1.0.0 of a site: each version of its map as a layer, for QGIS and other programs that read capabilities."""

from urllib.parse import quote
from xml.sax.saxutils import escape, quoteattr

from fastapi import APIRouter, Depends, Request, Response

from sorvolo.station.security import needs
from sorvolo.station.sites import SiteShelf, bounds_lonlat
from sorvolo.station.tiles import TILE_PX
from sorvolo.station.tokens import Role
from sorvolo.store.site.archive import Archive

_FIRST_SCALE = (
    559082264.0287178  # of zoom 0 at 0.28 mm a pixel: WMTS 1.0.0, annex E.4 (GoogleMapsCompatible)
)
_EDGE_M = 20037508.342789244  # half of the equator's length on the sphere of web maps (EPSG:3857)
_ZOOMS = range(8, 25)
_SET = "GoogleMapsCompatible"


class XmlResponse(Response):
    """An XML document."""

    media_type = "application/xml"


def wmts_routes(shelf: SiteShelf) -> APIRouter:
    """The capabilities of each site's tiles."""
    router = APIRouter(
        prefix="/api/sites/{site}", tags=["rasters"], dependencies=[Depends(needs(Role.VIEW))]
    )

    @router.get("/WMTSCapabilities.xml", response_class=XmlResponse)
    def capabilities(request: Request, site: str) -> XmlResponse:
        """Layers of a WMTS: every version of the map, and the growing one (`live`)."""
        base = f"{str(request.base_url).rstrip('/')}/api/sites/{quote(site)}"
        return XmlResponse(document(shelf.open(site), base))

    return router


def document(archive: Archive, base: str) -> str:
    """The capabilities of a site whose address is `base`."""
    layers = []
    if archive.has_site:
        names = {
            str(
                each.id
            ): f"version {each.id}, {each.flown_utc or each.created_utc}, {each.flight_id}"
            for each in archive.versions()
            if each.complete
        }
        bounds = bounds_lonlat(list(archive.live_tiles()), archive.site_grid())
        layers = [
            _layer(name, title, bounds, base)
            for name, title in {"live": "the newest map", **names}.items()
        ]
    name = archive.site().name if archive.has_site else archive.folder.name
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<Capabilities xmlns="http://www.opengis.net/wmts/1.0" xmlns:ows="http://www.opengis.net/ows/1.1" '
        'xmlns:xlink="http://www.w3.org/1999/xlink" version="1.0.0">\n'
        f"<ows:ServiceIdentification><ows:Title>{escape(name)}</ows:Title><ows:ServiceType>OGC WMTS</ows:ServiceType>"
        "<ows:ServiceTypeVersion>1.0.0</ows:ServiceTypeVersion></ows:ServiceIdentification>\n"
        f"<Contents>\n{''.join(layers)}{_matrix_set()}</Contents>\n"
        f"<ServiceMetadataURL xlink:href={quoteattr(base + '/WMTSCapabilities.xml')}/>\n</Capabilities>\n"
    )


def _layer(name: str, title: str, bounds: list[float] | None, base: str) -> str:
    corners = ""
    if bounds is not None:
        corners = (
            f"<ows:WGS84BoundingBox><ows:LowerCorner>{bounds[0]} {bounds[1]}</ows:LowerCorner>"
            f"<ows:UpperCorner>{bounds[2]} {bounds[3]}</ows:UpperCorner></ows:WGS84BoundingBox>"
        )
    template = f"{base}/tiles/{name}/{{TileMatrix}}/{{TileCol}}/{{TileRow}}.png"
    return (
        f"<Layer><ows:Title>{escape(title)}</ows:Title>{corners}<ows:Identifier>{name}</ows:Identifier>"
        '<Style isDefault="true"><ows:Identifier>default</ows:Identifier></Style><Format>image/png</Format>'
        f"<TileMatrixSetLink><TileMatrixSet>{_SET}</TileMatrixSet></TileMatrixSetLink>"
        f'<ResourceURL format="image/png" resourceType="tile" template={quoteattr(template)}/></Layer>\n'
    )


def _matrix_set() -> str:
    matrices = "".join(
        f"<TileMatrix><ows:Identifier>{zoom}</ows:Identifier><ScaleDenominator>{_FIRST_SCALE / 2**zoom!r}"
        f"</ScaleDenominator><TopLeftCorner>-{_EDGE_M!r} {_EDGE_M!r}</TopLeftCorner><TileWidth>{TILE_PX}</TileWidth>"
        f"<TileHeight>{TILE_PX}</TileHeight><MatrixWidth>{2**zoom}</MatrixWidth><MatrixHeight>{2**zoom}"
        "</MatrixHeight></TileMatrix>\n"
        for zoom in _ZOOMS
    )
    return (
        f"<TileMatrixSet><ows:Identifier>{_SET}</ows:Identifier>"
        "<ows:SupportedCRS>urn:ogc:def:crs:EPSG::3857</ows:SupportedCRS>"
        f"<WellKnownScaleSet>urn:ogc:def:wkss:OGC:1.0:{_SET}</WellKnownScaleSet>\n{matrices}</TileMatrixSet>\n"
    )
