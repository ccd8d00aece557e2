"""Where the map lies on Earth, as polynomials that a page evaluates without a library of projections."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gnss_sem_map.errors import ConfigError
from gnss_sem_map.export.georeference import Georeference
from gnss_sem_map.export.longitudes import near

ORDER = 3
"""Of the map plane: 10 km from the centre of a map, what it leaves out is below 1 mm. Heights enter linearly."""
SAMPLES = 7
"""Places along each horizontal axis at which the polynomials are fitted."""
POWERS = [(i, j, k) for k in (0, 1) for i in range(ORDER + 1) for j in range(ORDER + 1 - i)]


def fitted_placing(georeference: Georeference, low: ArrayLike, high: ArrayLike) -> dict[str, Any] | None:
    """Easting, northing, height (m), latitude and longitude (degrees) in the box between two corners (3,) m of the map.

    `coefficients` has a row for each of the five: the value is the sum of its numbers times x^i y^j z^k, with i, j, k
    from `powers` and x, y, z from `centre` in units of `half`. Longitudes go on beyond 180 degrees. None where CRS or
    geoid do not cover the box.
    """
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    centre, half = (low + high) / 2, np.maximum((high - low) / 2, 1.0)
    steps = np.linspace(-1, 1, SAMPLES)
    unit = np.stack(np.meshgrid(steps, steps, [-1.0, 1.0], indexing="ij"), axis=-1).reshape(-1, 3)
    p_map = centre + unit * half
    lat_deg, lon_deg, _ = georeference.frame.to_geodetic(p_map)
    lon_deg = near(lon_deg, georeference.frame.lon_deg)
    try:
        places = np.column_stack([georeference.from_map(p_map), lat_deg, lon_deg])
    except ConfigError:
        return None
    means = places.mean(axis=0)
    coefficients = np.linalg.lstsq(terms(unit), places - means)[0].T
    coefficients[:, POWERS.index((0, 0, 0))] += means
    return {
        "crs": f"{georeference.name} (EPSG:{georeference.horizontal_epsg})",
        "heights": georeference.heights,
        "centre": centre.tolist(),
        "half": half.tolist(),
        "powers": POWERS,
        "coefficients": coefficients.tolist(),
    }


def terms(unit: NDArray[np.float64]) -> NDArray[np.float64]:
    """Products (n, t) of powers of places (n, 3)."""
    return np.stack([np.prod(unit**power, axis=1) for power in np.array(POWERS)], axis=1)
