"""The map frame on the Earth: east, north, up at a point of WGS 84, with its gravity and rotation."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from factor_graphs.errors import MeasurementError

Array = NDArray[np.float64]

# WGS 84 (NIMA TR8350.2): semi-major axis m, flattening, GM m³/s², rotation rad/s
SEMI_MAJOR_AXIS = 6378137.0
FLATTENING = 1 / 298.257223563
GRAVITATIONAL_CONSTANT = 3.986004418e14
EARTH_RATE = 7.292115e-5
# Somigliana's formula: normal gravity at the equator m/s², and its growth towards the pole
EQUATORIAL_GRAVITY = 9.7803253359
SOMIGLIANA_K = 0.00193185265241
ARM_M = 10_000.0
"""Rotations between frames are taken from points this far away: coordinates are known to 0.1 um."""


@dataclass(frozen=True)
class LocalFrame:
    """The map frame: axes east, north, up, origin at a point of WGS 84 (height above the ellipsoid).

    Raises MeasurementError for a point that is not on Earth.
    """

    lat_deg: float
    lon_deg: float
    alt_m: float

    def __post_init__(self) -> None:
        values = (self.lat_deg, self.lon_deg, self.alt_m)
        if not np.isfinite(values).all() or abs(self.lat_deg) > 90 or abs(self.lon_deg) > 360:
            raise MeasurementError(
                f"LocalFrame at lat {self.lat_deg}°, lon {self.lon_deg}°, alt {self.alt_m} m; "
                "expected |lat| <= 90, |lon| <= 360, all finite"
            )

    def to_map(self, lat_deg: ArrayLike, lon_deg: ArrayLike, alt_m: ArrayLike) -> Array:
        """Geodetic coordinates, each (n,), -> points in the map frame (n, 3) m."""
        lon, lat, alt = np.broadcast_arrays(*(np.asarray(c, np.float64) for c in (lon_deg, lat_deg, alt_m)))
        return np.stack(_to_map(self).transform(lon, lat, alt), axis=-1)

    def to_geodetic(self, points: ArrayLike) -> tuple[Array, Array, Array]:
        """Points in the map frame (n, 3) m -> lat_deg, lon_deg, alt_m, each (n,)."""
        east, north, up = np.moveaxis(np.asarray(points, np.float64), -1, 0)
        lon, lat, alt = _to_map(self).transform(east, north, up, direction="INVERSE")
        return lat, lon, alt

    def pose_of(self, other: "LocalFrame") -> Array:
        """T_self_other (4, 4): both are frames of one ellipsoid, so the transform between them is rigid."""
        corners = self.to_map(*other.to_geodetic(np.vstack([np.zeros(3), ARM_M * np.eye(3)])))
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = (corners[1:] - corners[0]).T / ARM_M, corners[0]
        return T

    @property
    def gravity(self) -> float:
        """Normal gravity, m/s², at the origin."""
        return float(_normal_gravity(np.radians(self.lat_deg), np.array(self.alt_m)))

    def gravity_at(self, points: ArrayLike) -> Array:
        """Normal gravity at points in the map frame (n, 3) m, in its axes, (n, 3) m/s².

        It turns with the curved Earth: 10 km from the origin by 0.09°.
        """
        lat_deg, lon_deg, alt_m = self.to_geodetic(points)
        lat, lon = np.radians(lat_deg), np.radians(lon_deg - self.lon_deg)
        origin = np.radians(self.lat_deg)
        outwards = np.cos(lat) * np.cos(lon)
        up = np.column_stack([
            np.cos(lat) * np.sin(lon),
            np.cos(origin) * np.sin(lat) - np.sin(origin) * outwards,
            np.sin(origin) * np.sin(lat) + np.cos(origin) * outwards,
        ])  # fmt: skip
        return np.asarray(-_normal_gravity(lat, alt_m)[:, None] * up)

    def axes_at(self, points: ArrayLike) -> Array:
        """Axes east, north, up at points in the map frame (n, 3) m, in the map's axes: R_map_local (n, 3, 3).

        A receiver's velocity and heading are in these: at 49° latitude, 10 km east of the origin north turns by 0.1°.
        """
        lat_deg, lon_deg, _ = self.to_geodetic(points)
        R_earth_local = Rotation.from_euler("ZX", np.column_stack([lon_deg + 90, 90 - lat_deg]), degrees=True)
        R_earth_map = Rotation.from_euler("ZX", [self.lon_deg + 90, 90 - self.lat_deg], degrees=True)
        return np.asarray((R_earth_map.inv() * R_earth_local).as_matrix())

    @property
    def earth_rate(self) -> Array:
        """Rotation of the Earth, rad/s, in the map frame: (3,)."""
        lat = np.radians(self.lat_deg)
        return EARTH_RATE * np.array([0.0, np.cos(lat), np.sin(lat)])

    @property
    def utm_epsg(self) -> int:
        """EPSG code of the UTM zone (WGS 84) that the origin's longitude lies in."""
        zone = int((self.lon_deg + 180) % 360 // 6) + 1
        return (32600 if self.lat_deg >= 0 else 32700) + zone


def _normal_gravity(lat: Array, alt_m: Array) -> Array:
    """Normal gravity, m/s², at latitudes in rad and heights: Somigliana's formula, second order in height."""
    sin2, h = np.sin(lat) ** 2, alt_m / SEMI_MAJOR_AXIS
    e2, f = FLATTENING * (2 - FLATTENING), FLATTENING
    on_ellipsoid = EQUATORIAL_GRAVITY * (1 + SOMIGLIANA_K * sin2) / np.sqrt(1 - e2 * sin2)
    m = EARTH_RATE**2 * SEMI_MAJOR_AXIS**3 * (1 - f) / GRAVITATIONAL_CONSTANT
    return np.asarray(on_ellipsoid * (1 - 2 * (1 + f + m - 2 * f * sin2) * h + 3 * h**2))


@lru_cache(maxsize=16)
def _to_map(frame: LocalFrame) -> Transformer:
    return Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
        "+step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84 "
        f"+lat_0={frame.lat_deg:.12f} +lon_0={frame.lon_deg:.12f} +h_0={frame.alt_m:.6f}"
    )
