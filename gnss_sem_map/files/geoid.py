"""Heights above a geoid and above the ellipsoid: a grid tells how far apart they are at a place."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from pyproj import Transformer
from pyproj.exceptions import ProjError

from gnss_sem_map.errors import ConfigError


@lru_cache(maxsize=16)
def undulation(geoid: Path, key: str = "delivery.geoid") -> Transformer:
    """Longitude and latitude °, height above the ellipsoid m, to that above the geoid; raises ConfigError."""
    try:
        return Transformer.from_pipeline(
            "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad"
            f' +step +proj=vgridshift +grids="{geoid.resolve()}" +multiplier=-1'
            " +step +proj=unitconvert +xy_in=rad +xy_out=deg"
        )
    except ProjError:
        raise ConfigError(
            f"{key}: {geoid}: expected a grid of geoid heights as PROJ reads them (.tif, .gtx),"
            " in a path without quotes and commas"
        ) from None
