"""Points as surfaces: the plane at each of them, and how far other points lie from these planes."""

from __future__ import annotations

import numpy as np
import small_gicp
from numpy.typing import NDArray

Array = NDArray[np.float64]

NEIGHBOURS = 8
"""Points that make a plane."""
SOFT_M = 0.05
"""Residuals beyond this count less (Huber)."""


class Planes:
    """Points (n, 3) m, and the normals (n, 3) of the surface at each; zero where there is no plane."""

    def __init__(self, p: Array, normals: Array) -> None:
        self.p = p
        self._normals, self._tree = normals, small_gicp.KdTree(p)
        self._has_plane = (normals != 0).any(axis=1)

    def near(self, p: Array, within_m: float) -> tuple[Array, Array, Array]:
        """Those of some points (k, 3) within a distance of a surface, its normals there (k, 3), and residuals (k,)."""
        places, squares = (np.asarray(a) for a in self._tree.batch_nearest_neighbor_search(p))
        use = np.flatnonzero((squares < within_m**2) & self._has_plane[places])
        at, n = p[use], self._normals[places[use]]
        return at, n, np.einsum("ij,ij->i", n, at - self.p[places[use]])


def normals_of(p: Array) -> Array:
    """Normals (n, 3) of the surface at points (n, 3) m; zero where there is no plane."""
    cloud = small_gicp.PointCloud(p)
    small_gicp.estimate_normals(cloud, small_gicp.KdTree(cloud), NEIGHBOURS)
    return np.asarray(cloud.normals())[:, :3].copy()


def jacobians(at: Array, n: Array, residuals: Array) -> tuple[Array, Array]:
    """(k, 6) of residuals by a small motion of the points, turn before shift; and the same, weighted by Huber."""
    J = np.hstack([np.cross(at, n), n])
    return J, J * np.minimum(1.0, SOFT_M / np.maximum(np.abs(residuals), 1e-9))[:, None]
