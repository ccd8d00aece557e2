"""Check of camera pose, time offset and focal length: the change for which depth edges and image edges agree best.

Every kind of mistake is a family of changes: a turn about an axis, another moment, another focal length. Tried one
family at a time, the one that makes the edges agree names the mistake; gains are paired over the images.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gnss_sem_map.preflight.camera_sample import CameraSample
from gnss_sem_map.preflight.depth_edges import Change, Edges
from gnss_sem_map.preflight.findings import Finding, amber, green, red
from gnss_sem_map.scans.projection import NEAREST_DEPTH_M, exposure_offset_s

Array = NDArray[np.float64]
NAME = "camera against LiDAR"
LEAST_VIEWS, LEAST_EDGES = 4, 150
"""Depth edges of a sweep, all around: with fewer an image shows a handful (town: 400 to 800)."""
SURE, LEAST_BEST = 3.0, 1.25
"""Standard errors of a gain, over the images, and how strong edges must then be: a hundred changes are tried, of which
chance lifts one by three standard errors, but to no more than 1.1 (good drives: 1.4 to 1.9)."""
SUSPECT, SHARED = 1.0, 2.0
"""Standard errors that make other images be asked, and that these must find: one change is tried there, so chance finds
it in one of forty drives of those that are under suspicion."""
FAR_DEG, FINE_NOISE = 3.5, 1.5
"""Turned so far, edges agree by chance only; and by how much more finer edges scatter than coarse ones."""
LEAST_GAIN = 0.03
"""And by this part: gains of 1 to 2 % are of the calibration's last tenth of a degree."""
NEARBY_DEG = np.arange(-1.6, 1.7, 0.4)
"""Turns that are tried about a camera that looks elsewhere."""
LEAST_COMMON, COMMON_SURE = 0.03, 2.5
"""What an image and its own depth edges must have in common beyond other images of the drive (good drives: 0.15 up)."""


@dataclass(frozen=True)
class Family:
    """Changes of one kind."""

    name: str
    of: Callable[[float], Change]
    reach: tuple[float, ...]
    """Candidate changes."""
    same: float
    """Differences below this give no warning."""


def _about(axis: int) -> Callable[[float], Change]:
    def of(angle: float) -> Change:
        x, y, z = (angle * np.eye(3)[axis]).tolist()
        return Change(rotation_deg=(x, y, z))

    return of


def _steps(reach: float, step: float) -> tuple[float, ...]:
    return tuple(np.arange(-reach, reach + step / 2, step).tolist())


TURNS = tuple(
    Family(name, _about(axis), _steps(8.0, step), same)
    for name, axis, step, same in (("y", 1, 0.8, 0.6), ("x", 0, 1.0, 1.2), ("z", 2, 1.6, 1.6))
)
TIME = Family("time", lambda s: Change(time_s=s), _steps(0.3, 0.03), 0.035)
FOCAL = Family("focal", lambda x: Change(focal=float(np.exp(x))), _steps(0.8, 0.05), 0.05)
SIZE = Family("size", lambda x: Change(size=float(np.exp(x))), _steps(0.8, 0.05), 0.05)
FAMILIES = (*TURNS, TIME, FOCAL, SIZE)


@dataclass(frozen=True)
class Best:
    """The best change of a family, and the gain in agreement (k,) of each image."""

    family: Family
    value: float
    gains: Array
    agreement: float = 0.0
    """Mean strength of the edges so, fine."""
    noise: float = np.inf
    """Standard deviation of a gain in one image by chance, from changes that are far off."""

    @property
    def gain(self) -> float:
        """Mean over the images."""
        return float(self.gains.mean()) if len(self.gains) else 0.0

    @property
    def sigmas(self) -> float:
        """The gain in standard errors, of its scatter or of chance; 0 where too few images tell.

        A wrong time moves the edges of near things in fast images most: such gains scatter, and are sure all the same.
        """
        if len(self.gains) < LEAST_VIEWS:
            return 0.0
        return max(in_errors(self.gains), self.gain / self.noise * float(np.sqrt(len(self.gains))))


def in_errors(gains: Array) -> float:
    """A mean in its standard errors; 0 for less than four values."""
    if len(gains) < LEAST_VIEWS:
        return 0.0
    error = max(float(gains.std(ddof=1)), 0.01) / np.sqrt(len(gains))
    return float(gains.mean() / error)


def best_change(edges: Edges, families: tuple[Family, ...] = FAMILIES) -> Best:
    """The change of all families that makes edges agree best: coarse over the whole reach, then fine around it."""
    given = edges.agreement()
    found, noise = [], np.inf
    for family in families:
        tried = np.array([edges.agreement(family.of(value)) for value in family.reach])
        if family is TURNS[0]:
            noise = _noise(tried[np.abs(family.reach) > FAR_DEG])
        means = _means(tried, given)
        found.append((float(means.max()), family, family.reach[int(means.argmax())]))
    # blurred, a change of another kind may come near: the best two are looked at closely
    nearest = sorted(found, key=lambda item: -item[0])[:2]
    return max(
        (_refined(edges, family, value, noise) for _, family, value in nearest), key=lambda best: best.gain
    )


def _refined(edges: Edges, family: Family, value: float, noise: float) -> Best:
    step = family.reach[1] - family.reach[0]
    values = value + step * np.arange(-1.0, 1.01, 0.25)
    fine = np.array([edges.agreement(family.of(float(v)), fine=True) for v in values])
    place = int(_means(fine, edges.agreement(fine=True)).argmax())
    return _best(edges, family, float(values[place]), noise)


def _best(edges: Edges, family: Family, value: float, noise: float) -> Best:
    """What one change gains."""
    changed, given = edges.agreement(family.of(value), fine=True), edges.agreement(fine=True)
    gains = changed - np.where(np.isfinite(given), given, 1.0)  # 1: what points anywhere would have
    seen = np.isfinite(gains)
    return Best(family, value, gains[seen], float(changed[seen].mean()) if seen.any() else 0.0, noise)


def _noise(tried: Array) -> float:
    """Of the difference of two agreements of one image: those of changes that are far off (n, k), less their mean."""
    seen = tried[np.isfinite(tried)]
    return FINE_NOISE * float(np.sqrt(2.0) * seen.std()) if len(seen) > LEAST_VIEWS else float("inf")


def _means(tried: Array, given: Array) -> Array:
    """Mean gain of each change (n, k) over the images that it leaves in view; half of them at least."""
    base = np.where(np.isfinite(given), given, 1.0)
    counts = np.isfinite(tried).sum(axis=1)
    gains = np.where(np.isfinite(tried), tried - base, 0.0).sum(axis=1) / np.maximum(counts, 1)
    return np.where(counts >= max(LEAST_VIEWS, tried.shape[1] / 2), gains, -np.inf)


def check(sample: CameraSample) -> Iterator[Finding]:
    """Turned, late, inverted, of another lens: or fine."""
    if _all_behind(sample):
        yield red(
            NAME,
            "all points of a scan lie behind the camera",
            "T_camera_lidar is inverted, or of another camera",
            "check T_camera_lidar: it takes points from the LiDAR to the camera, x right, y down, z forward",
        )
        return
    edges = sample.edges
    if edges is None or len(edges.views) < LEAST_VIEWS:
        yield green(NAME, "not observable: too few scans with an image and depth edges (points ring by ring)")
        return
    if np.median([len(view.p_map) for view in edges.views]) < LEAST_EDGES:
        yield green(NAME, "not observable: too few depth edges (points ring by ring)")
        return
    yield _pose(sample, edges)


def _all_behind(sample: CameraSample) -> bool:
    """Whether the first scan that can be read has nothing in front of the camera."""
    T_camera_lidar, first = sample.camera.T_camera_lidar, sample.drive.first_points
    if first is None:
        return False
    xyz = first[0].xyz
    xyz = xyz[np.isfinite(xyz).all(axis=1) & xyz.any(axis=1)]
    return len(xyz) > 0 and bool(
        (xyz @ T_camera_lidar[2, :3] + T_camera_lidar[2, 3] <= NEAREST_DEPTH_M).all()
    )


def _pose(sample: CameraSample, edges: Edges) -> Finding:
    given, fine = edges.agreement(), edges.agreement(fine=True)
    seen = float(np.nanmean(fine)) if np.isfinite(fine).any() else float("nan")
    found = (
        f"depth edges of {len(edges.views)} scans: images are {seen:.2f} times as strong there as elsewhere"
    )
    best = best_change(edges)
    is_better = best.agreement > LEAST_BEST and best.gain > LEAST_GAIN * (seen if np.isfinite(seen) else 1.0)
    if not seen > LEAST_BEST:
        elsewhere = _elsewhere(edges)
        if elsewhere is not None and elsewhere[1].gain > best.gain and elsewhere[1].sigmas > SURE:
            return red(
                NAME,
                f"{found}; {elsewhere[1].agreement:.2f} times if so",
                f"T_camera_lidar is {elsewhere[0]}",
                "correct T_camera_lidar (KITTI: calib_velo_to_cam.txt)",
            )
    if is_better and abs(best.value) > best.family.same:
        if best.sigmas > SURE:
            return _named(sample, best, found)
        if best.sigmas > SUSPECT:
            again, images = _on_other_images(sample, best)
            if again is not None:
                return _named(sample, again, f"{found}, tested on {images} others")
    common = (given - edges.others())[np.isfinite(given)]
    if len(common) < LEAST_VIEWS:
        return red(
            NAME,
            f"{found}; {len(common)} of {len(edges.views)} images show enough depth edges",
            "hardly any point lies in the images: T_camera_lidar is inverted, turned, or of another camera",
            "check T_camera_lidar: it takes points from the LiDAR to the camera, x right, y down, z forward",
        )
    if common.mean() < LEAST_COMMON or in_errors(common) < COMMON_SURE:
        if not sample.drive.is_moving:
            return green(NAME, f"{found}; not observable further: the vehicle stands")
        return amber(
            NAME,
            f"{found}, only {common.mean():.2f} more than in other images of the drive",
            "images and scans have nothing in common: another drive, clock or camera, or T_camera_lidar far off",
            "check the stamps of the images, T_camera_lidar and K",
        )
    return green(NAME, f"{found}; the best {best.family.name} is {best.value:+.2f} off")


def _on_other_images(sample: CameraSample, best: Best) -> tuple[Best | None, int]:
    """A suspicion of a few images, that nothing else was looked for in, on all; None where others do not share it."""
    if sample.other_edges is None:
        return None, 0
    other = _best(sample.other_edges, best.family, best.value, best.noise)
    if other.sigmas < SHARED or other.agreement < LEAST_BEST:
        return None, len(other.gains)
    gains = np.concatenate([best.gains, other.gains])
    return replace(best, gains=gains), len(other.gains)


def _elsewhere(edges: Edges) -> tuple[str, Best] | None:
    """A camera that looks quite elsewhere: inverted, or turned by quarters."""
    T = edges.camera.T_camera_lidar
    given = edges.agreement(fine=True)
    base = np.where(np.isfinite(given), given, 1.0)
    tried = {"inverted: T_lidar_camera was given": np.asarray(np.linalg.inv(T))}
    for axis, name in enumerate("xyz"):
        for quarter in (90, 180, 270):
            turned = T.copy()
            turned[:3] = _turn(axis, quarter) @ T[:3]
            tried[f"turned by {quarter} deg about {name}: the camera looks elsewhere"] = turned
    found = []
    for name, camera in tried.items():
        reached = _reached(edges.with_camera(camera))
        seen = np.isfinite(reached)
        if seen.sum() >= LEAST_VIEWS and reached[seen].mean() > LEAST_BEST:
            found.append((name, Best(TIME, 0.0, (reached - base)[seen], float(reached[seen].mean()))))
    return max(found, key=lambda item: item[1].gain, default=None)


def _turn(axis: int, angle_deg: float) -> Array:
    return np.asarray(Rotation.from_rotvec(angle_deg * np.eye(3)[axis], degrees=True).as_matrix())


def _reached(edges: Edges) -> Array:
    """Agreement (k,), fine, of a camera that is about right: a rectification turned the wrong way is some degrees."""
    turn = np.zeros(3)
    for axis in (1, 0, 2, 1):
        tried = turn + NEARBY_DEG[:, None] * np.eye(3)[axis]
        changes = [Change(rotation_deg=(float(x), float(y), float(z))) for x, y, z in tried]
        means = _means(np.array([edges.agreement(change) for change in changes]), np.ones(len(edges.views)))
        turn = tried[int(means.argmax())]
    x, y, z = turn.tolist()
    return edges.agreement(Change(rotation_deg=(x, y, z)), fine=True)


def _named(sample: CameraSample, best: Best, found: str) -> Finding:
    family, value = best.family, best.value
    level = red if abs(value) > 2 * family.same and best.sigmas > SURE else amber
    found += f", {best.gain:.2f} more with the change (+- {best.gain / best.sigmas:.2f})"
    if family is TIME:
        word = "late" if value < 0 else "early"
        offset = exposure_offset_s(sample.camera, sample.drive.settings.labelling) + value
        setting = (
            f"time_offset_s of {sample.camera.name}"
            if sample.camera.name
            else "labelling.camera_time_offset_s"
        )
        return level(
            NAME,
            found,
            f"image stamps are {abs(value):.2f} s {word}",
            f"set {setting}: {offset:.3f}",
        )
    factor = float(np.exp(value))
    if family is FOCAL:
        return level(
            NAME,
            found,
            f"the focal length is {1 / factor:.2f} times what it should be",
            f"multiply fx and fy of K by {factor:.2f}",
        )
    if family is SIZE:
        return level(
            NAME,
            found,
            f"K is of images {1 / factor:.2f} times as large as these",
            f"multiply fx, fy, cx and cy of K by {factor:.2f}",
        )
    return level(
        NAME,
        found,
        f"the camera is turned by {abs(value):.1f} deg about its {family.name} axis against T_camera_lidar",
        f"turn T_camera_lidar by {value:+.1f} deg about the camera's {family.name} axis (KITTI: calib_velo_to_cam.txt)",
    )
