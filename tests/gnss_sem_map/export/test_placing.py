"""Polynomials that place the map on Earth, against pyproj."""

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.export.georeference import Georeference
from gnss_sem_map.export.longitudes import near
from gnss_sem_map.export.placing import fitted_placing, terms


@example(lat_deg=-17.0, lon_deg=179.9995, half_km=1.0, unit=[0.5, 0.5, 0.0])
@given(
    st.floats(-70, 80),
    st.floats(-180, 180),
    st.floats(0.1, 10),
    st.lists(st.floats(-1, 1), min_size=3, max_size=3),
)
def test_within_ten_kilometres_the_polynomials_are_a_millimetre_from_pyproj(
    lat_deg: float, lon_deg: float, half_km: float, unit: list[float]
) -> None:
    georeference = Georeference(LocalFrame(lat_deg, lon_deg, 100.0))
    half = np.array([1000 * half_km, 1000 * half_km, 100.0])
    placing = fitted_placing(georeference, -half, half)
    assert placing is not None
    found = np.array(placing["coefficients"]) @ terms(np.array([unit]))[0]
    p_map = (placing["centre"] + np.array(unit) * placing["half"])[None]
    np.testing.assert_allclose(found[:3], georeference.from_map(p_map)[0], atol=1e-3)
    lat, lon, _ = georeference.frame.to_geodetic(p_map)
    np.testing.assert_allclose(
        found[3:], [lat[0], near(lon[0], lon_deg)], atol=1e-8 / np.cos(np.radians(lat_deg))
    )


def test_the_words_are_those_of_the_files() -> None:
    georeference = Georeference(LocalFrame(49.0, 8.4, 100.0), epsg=25832)
    placing = fitted_placing(georeference, [0, 0, 0], [100, 100, 10])
    assert placing is not None
    assert (placing["crs"], placing["heights"]) == (
        "ETRS89 / UTM zone 32N (EPSG:25832)",
        georeference.heights,
    )
