import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import Transformer

from factor_graphs.errors import MeasurementError
from factor_graphs.geodesy import LocalFrame

LATITUDES, LONGITUDES = st.floats(-85.0, 85.0), st.floats(-179.0, 179.0)


@given(LATITUDES, LONGITUDES, st.floats(-100.0, 4000.0), st.integers(0, 2**31))
def test_there_and_back_is_the_same_point(lat, lon, alt, seed):
    frame = LocalFrame(lat, lon, alt)
    points = np.random.default_rng(seed).uniform(-5000, 5000, (5, 3))
    np.testing.assert_allclose(frame.to_map(*frame.to_geodetic(points)), points, atol=1e-6)


@given(LATITUDES, LONGITUDES)
def test_distances_and_directions_are_those_of_the_earth_centred_frame(lat, lon):
    frame = LocalFrame(lat, lon, 100.0)
    to_ecef = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    points = np.array([[0.0, 0.0, 0.0], [1000.0, 0.0, 0.0], [0.0, 2000.0, 0.0], [0.0, 0.0, 50.0]])
    lats, lons, alts = frame.to_geodetic(points)
    ecef = np.stack(to_ecef.transform(lons, lats, alts), axis=1)
    phi, lam = np.radians([lat, lon])
    east = [-np.sin(lam), np.cos(lam), 0]
    north = [-np.sin(phi) * np.cos(lam), -np.sin(phi) * np.sin(lam), np.cos(phi)]
    up = [np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)]
    np.testing.assert_allclose((ecef - ecef[0]) @ np.array([east, north, up]).T, points, atol=1e-6)


@pytest.mark.parametrize(("lat", "gravity"), [(0.0, 9.7803253359), (90.0, 9.8321849379)])  # NIMA TR8350.2
def test_normal_gravity_is_that_of_wgs84_and_falls_with_height(lat, gravity):
    assert LocalFrame(lat, 0.0, 0.0).gravity == pytest.approx(gravity, abs=1e-8)
    falls = LocalFrame(lat, 0.0, 0.0).gravity - LocalFrame(lat, 0.0, 1000.0).gravity
    assert falls == pytest.approx(3.086e-3, rel=2e-3)  # free-air gradient


def test_the_mean_of_normal_gravity_over_the_ellipsoid_is_that_of_wgs84():
    lat = np.radians(np.linspace(-90, 90, 1801))
    e2 = 0.00669437999014
    area = np.cos(lat) / (1 - e2 * np.sin(lat) ** 2) ** 2
    gravity = [LocalFrame(float(np.degrees(x)), 0.0, 0.0).gravity for x in lat]
    assert np.average(gravity, weights=area) == pytest.approx(9.7976432222, abs=1e-6)  # NIMA TR8350.2


def test_the_earth_turns_eastwards_and_once_a_sidereal_day():
    rate = LocalFrame(49.0, 8.4, 115.0).earth_rate
    assert 2 * np.pi / np.linalg.norm(rate) == pytest.approx(86164.1, abs=0.1)
    assert rate[0] == 0
    assert rate[1] > 0
    assert LocalFrame(-30.0, 0.0, 0.0).earth_rate[2] < 0


@pytest.mark.parametrize(
    ("lat", "lon", "epsg"), [(49.0, 8.4, 32632), (-33.9, 151.2, 32756), (0.0, -180.0, 32601)]
)
def test_the_utm_zone_is_that_of_the_longitude(lat, lon, epsg):
    assert LocalFrame(lat, lon, 0.0).utm_epsg == epsg


@pytest.mark.parametrize("place", [(91.0, 0.0, 0.0), (0.0, 400.0, 0.0), (float("nan"), 0.0, 0.0)])
def test_a_place_off_the_earth_is_refused(place):
    with pytest.raises(MeasurementError, match="LocalFrame at"):
        LocalFrame(*place)


@given(LATITUDES, LONGITUDES, st.floats(-100.0, 4000.0), st.integers(0, 2**31))
def test_the_transform_between_two_frames_is_rigid_and_that_of_the_earth(lat, lon, alt, seed):
    """Within 10 km of both origins, against the way over the ellipsoid."""
    rng = np.random.default_rng(seed)
    here = LocalFrame(lat, lon, alt)
    [lat], [lon], [alt] = here.to_geodetic(rng.uniform(-7000, 7000, (1, 3)) * [1, 1, 0.02])
    there = LocalFrame(float(lat), float(lon), float(alt))
    T_here_there = here.pose_of(there)
    points = rng.uniform(-7000, 7000, (5, 3)) * [1, 1, 0.02]
    over_earth = here.to_map(*there.to_geodetic(points))
    np.testing.assert_allclose(points @ T_here_there[:3, :3].T + T_here_there[:3, 3], over_earth, atol=1e-6)
    np.testing.assert_allclose(T_here_there[:3, :3] @ T_here_there[:3, :3].T, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(there.pose_of(here) @ T_here_there, np.eye(4), atol=1e-6)
    np.testing.assert_allclose(here.pose_of(here), np.eye(4), atol=1e-6)


def test_gravity_elsewhere_is_that_of_a_frame_there():
    frame = LocalFrame(-33.2, 179.9, 120.0)
    points = np.random.default_rng(0).uniform(-5e4, 5e4, (20, 3)) * [1.0, 1.0, 0.05]
    for gravity, *place in zip(frame.gravity_at(points), *frame.to_geodetic(points), strict=True):
        there = LocalFrame(*map(float, place))
        np.testing.assert_allclose(gravity, -there.gravity * frame.pose_of(there)[:3, 2], atol=1e-7)
