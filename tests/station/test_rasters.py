"""Rasters of a site for other programs: OGC tiles by titiler, WMTS, STAC; read as GeoTIFF or not at all."""

import itertools
import xml.etree.ElementTree as ET
from pathlib import Path

import cv2
import numpy as np
import pytest
from shapely.geometry import shape
from starlette.testclient import TestClient

from sorvolo.store.site.archive import Archive

COG = "/api/sites/field/cogs/mosaic"


def corner_tile(client: TestClient, zoom: int = 20) -> str:
    """z/x/y of the tile over the middle of the map."""
    longitude, latitude = client.get("/api/sites/field").json()["center_wgs84"]
    y = (1 - np.arcsinh(np.tan(np.radians(latitude))) / np.pi) / 2
    return f"{zoom}/{int((longitude + 180) / 360 * 2**zoom)}/{int(y * 2**zoom)}"


def test_the_map_as_ogc_tiles(client: TestClient) -> None:
    """By titiler, from mosaic.tif; the same ground as the station's own tiles."""
    (listed,) = client.get("/api/sites/field/cogs").json()
    tilejson = client.get(listed["tilejson"]).json()
    assert tilejson["tiles"][0].startswith("http://127.0.0.1:8750" + COG)
    place = corner_tile(client)
    theirs = client.get(
        f"{COG}/tiles/WebMercatorQuad/{place}.png", params={"resampling": "bilinear"}
    )
    ours = client.get(f"/api/sites/field/tiles/2/{place}.png")
    assert theirs.status_code == ours.status_code == 200
    one, other = (
        cv2.imdecode(np.frombuffer(each.content, np.uint8), -1).astype(int)
        for each in (theirs, ours)
    )
    both = (one[..., 3] == 255) & (other[..., 3] == 255)
    assert both.sum() > 5000 and np.median(np.abs(one - other)[both]) <= 1
    assert "WebMercatorQuad" in client.get(f"{COG}/tiles").text
    assert client.get(f"{COG}/info").json()["driver"] == "GTiff"


@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("tiles/WebMercatorQuad/{}?tilesize=100000", 422),
        ("tiles/WebMercatorQuad/{}?buffer=1000", 422),
        ("tiles/WebMercatorQuad/{}?bidx=99", 400),
        ("tiles/WebMercatorQuad/20/1/1.png", 404),
        ("tiles/WebMercatorQuad/{}?expression=1%2B1", 200),
        ("statistics", 404),
        ("preview", 404),
        ("map.html", 404),
        ("tiles/WebMercatorQuad/{}?algorithm=contours", 422),
        ("tiles/WebMercatorQuad/{}?rescale=x", 422),
    ],
)
def test_what_would_cost_too_much_is_not_there(reader: TestClient, path: str, status: int) -> None:
    """No sizes without bound, no expressions, nothing that reads the whole raster."""
    assert reader.get(f"{COG}/{path.format(corner_tile(reader) + '.png')}").status_code == status


def test_files_come_by_id_and_are_geotiffs(client: TestClient, root: Path, tmp_path: Path) -> None:
    """A path, an address, a VRT named .tif, a link: none is opened."""
    for other in (
        "..%2f..%2fmosaic",
        "http:%2f%2fevil.example%2fx.tif",
        "%2fvsicurl%2fhttp:%2f%2fx",
        "heights:a",
    ):
        assert client.get(f"/api/sites/field/cogs/{other}/info").status_code == 404, other
    assert client.get(f"{COG}/info?url=http://evil.example/x.tif").json()["driver"] == "GTiff"
    mosaic = root / "field/mosaic.tif"
    kept = mosaic.read_bytes()
    # by a stranger, who makes the catalogue, too
    with Archive.open(root / "field", write=True) as site, site.replacing("mosaic.tif"):
        mosaic.write_text(
            '<VRTDataset rasterXSize="9" rasterYSize="9"><VRTRasterBand dataType="Byte" band="1"><SimpleSource>'
            f"<SourceFilename>{tmp_path / 'secret.tif'}</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>"
        )
    (tmp_path / "secret.tif").write_bytes(kept)
    assert client.get(f"{COG}/info").status_code == 400
    mosaic.unlink()
    mosaic.symlink_to(tmp_path / "secret.tif")
    assert client.get(f"{COG}/info").status_code == 409


def test_wmts_names_every_version(client: TestClient) -> None:
    """A program fills the template in and gets the tile."""
    tree = ET.fromstring(client.get("/api/sites/field/WMTSCapabilities.xml").text)
    space = {"w": "http://www.opengis.net/wmts/1.0", "o": "http://www.opengis.net/ows/1.1"}
    layers = {
        each.findtext("o:Identifier", namespaces=space): each.find("w:ResourceURL", space).get(
            "template"
        )  # type: ignore[union-attr]
        for each in tree.findall("w:Contents/w:Layer", space)
    }
    assert list(layers) == ["live", "1", "2"]
    z, x, y = corner_tile(client).split("/")
    template = layers["1"]
    assert template is not None
    address = template.replace("{TileMatrix}", z).replace("{TileCol}", x).replace("{TileRow}", y)
    assert client.get(address).headers["content-type"] == "image/png"
    scales = [float(each.text or 0) for each in tree.iterfind(".//w:ScaleDenominator", space)]
    assert all(abs(one / other - 2) < 1e-12 for one, other in itertools.pairwise(scales))


def test_stac_leads_from_the_station_to_each_version(client: TestClient) -> None:
    """Catalogue, collection, items with their ground, time and tiles."""
    child = next(
        each["href"] for each in client.get("/api/stac").json()["links"] if each["rel"] == "child"
    )
    collection = client.get(child).json()
    assert collection["type"] == "Collection" and collection["stac_version"] == "1.1.0"
    items = [
        client.get(each["href"]).json() for each in collection["links"] if each["rel"] == "item"
    ]
    assert [each["id"] for each in items] == ["field-1", "field-2"]
    for each in items:
        west, south, east, north = each["bbox"]
        ground = shape(each["geometry"])
        assert ground.is_valid and ground.bounds == pytest.approx(each["bbox"])
        assert ground.area == pytest.approx((east - west) * (north - south))
        assert west < 13.25 < east and south < 46.51 and north > 46.49
        assert each["properties"]["datetime"] == "2023-11-14T22:13:20Z"
        assert "{z}" in each["assets"]["tiles"]["href"]
    assert "mosaic" in items[1]["assets"] and "mosaic" not in items[0]["assets"]
    data = items[1]["assets"]["mosaic"]
    assert data["roles"] == ["data"] and data["proj:code"].startswith("EPSG:")
    head = client.head(data["href"])
    assert head.status_code == 200 and not head.content
    part = client.get(data["href"], headers={"range": "bytes=0-3"})
    assert (part.status_code, part.content[:2]) == (206, b"II")  # GDAL reads what it needs
    whole = [each["href"] for row in (collection, *items) for each in row["links"]]
    whole += [each["href"] for row in items for each in row["assets"].values()]
    assert all(each.startswith("http") for each in whole)
    assert (
        client.get("/api/stac/field/9").status_code
        == client.get("/api/stac/nowhere").status_code
        == 404
    )
