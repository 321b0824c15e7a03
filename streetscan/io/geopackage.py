"""Map layers as GeoPackage."""

from pathlib import Path

import geopandas
import pyogrio

from streetscan.io.atomic import atomic_path


def write_layer(path: str | Path, frame: geopandas.GeoDataFrame, layer: str) -> None:
    """Write a table with geometries, empty or not, as the only layer of a GeoPackage; equal tables give equal files."""
    # GDAL stamps the file with this time instead of the clock's.
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": "2000-01-01T00:00:00.000Z"})
    try:
        with atomic_path(path) as partial:
            # Without a geometry GDAL cannot tell the type of an empty layer.
            frame.to_file(partial, layer=layer, driver="GPKG", engine="pyogrio", **({} if len(frame) else {"geometry_type": "Polygon"}))
    finally:
        pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": None})
