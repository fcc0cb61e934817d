"""GeoTIFFs, the only files that GDAL opens: the map written, reference maps and height models read."""
