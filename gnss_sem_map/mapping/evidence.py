"""Evidence of a run besides its map: with it, a finished run is refined again without its scans.

evidence/moved/               the voxels of moving points, tile by tile
         moving_points/N.npz  the points that moved in the scans of chunk N
         keyframes/N.npz      its range images for free-space evidence, if the poses of the chunk are sharp enough
"""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.dynamics.image_rows import CELLS, Rows
from gnss_sem_map.dynamics.range_images import WIDTH
from gnss_sem_map.dynamics.visibility import KeyframeScans, are_near
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.archives import Archive, open_archive
from gnss_sem_map.files.untrusted import MOST_BYTES, is_folder, shown
from gnss_sem_map.labels.label_set import LabelSet
from gnss_sem_map.voxels import tiles
from gnss_sem_map.voxels.tiles import TiledMap

if TYPE_CHECKING:
    import pyarrow as pa

FOLDER = "evidence"
MOVED, MOVING_POINTS, KEYFRAMES = "moved", "moving_points", "keyframes"
LIDAR, MOST_NAME_BYTES = "lidar", 1 << 10
MOST_KEYFRAME_BYTES = 10_000 * 70 * WIDTH * 2
"""Packed images of the keyframe scans of one chunk that are read: more than ten thousand of 70 rows."""
MOVED_HELD = 1 << 18
"""Voxels of moving points in memory at a time, 15 MB: a tile is refined with those of its neighbours, too."""
SCANS_AT_ONCE = 32
"""Keyframe scans after which `free_space` asks no more of the voxels that they decide."""
FILES_HELD = 2
"""Files of keyframes in memory at a time, some 5 MB each, still packed."""

PACKING = 2
"""Level of compression: 5 % larger than with zlib's usual 6, in a quarter of its time."""
IMAGE_CODEC, IMAGE_PACKING = "zstd", 3
"""Of images, which are read by every tile around: unpacked in a third of zlib's time, 4 % larger."""


@dataclass(frozen=True, eq=False)
class RunEvidence:
    """The evidence of a run that is not in its tiles, on disk; `read` opens it."""

    moved: TiledMap
    """The map of the moving points, which are not refined."""
    moving_points: Sequence[Path]
    """Files of the points that moved, see `read_moving_points`."""
    keyframes: Sequence[Path]
    """Files of keyframe scans; none of a chunk whose poses are not sharp enough (`dynamics.pose_sharpness`)."""

    def moving(self, lidar: str = "") -> dict[int, NDArray[np.int64]]:
        """Frame number -> indices of the moving points among the usable points of the scan; raises DataError."""
        paths = self.moving_points_of(lidar)
        return {number: found for path in paths for number, found in read_moving_points(path).items()}

    def moving_points_of(self, lidar: str = "") -> list[Path]:
        """The files of one LiDAR; raises DataError."""
        return [path for path in self.moving_points if read_lidar(path) == lidar]

    @cached_property
    def poses(self) -> dict[Path, NDArray[np.float64]]:
        """T_lidar_map (k, 4, 4) of the keyframe scans of every file; raises DataError."""
        return {path: read_poses(path) for path in self.keyframes}

    @cached_property
    def image_digests(self) -> dict[Path, NDArray[np.uint8]]:
        """(k, 32) SHA-256 of what each keyframe scan of every file has seen; raises DataError."""
        return {path: read_digests(path, len(T)) for path, T in self.poses.items()}

    def keyframes_near(self, positions: NDArray[np.float64], reach_m: float) -> NearKeyframes | None:
        """The keyframe scans at most `reach_m` from the bounding box of positions (m, 3) m; None if there are none.

        Reading them raises DataError.
        """
        near = {path: np.flatnonzero(are_near(T, positions, reach_m)) for path, T in self.poses.items()}
        chosen = {path: scans for path, scans in near.items() if len(scans)}
        if not chosen:
            return None
        poses = np.concatenate([self.poses[path][scans] for path, scans in chosen.items()])
        return NearKeyframes(poses, chosen, self._read_keyframes)

    @cached_property
    def _read_keyframes(self) -> Callable[[Path], PackedKeyframes]:
        """Reads files, and holds a few; another run may have files of the same names."""
        return lru_cache(FILES_HELD)(read_packed)


@dataclass(frozen=True, eq=False)
class PackedKeyframes:
    """Keyframe scans of a file, whose images are unpacked when they are needed."""

    path: Path
    packed: NDArray[np.uint8]
    """The images, one after another, each packed for itself."""
    ends: NDArray[np.int64]
    """(k,) where each ends."""
    T_lidar_map: NDArray[np.float64]
    """(k, 4, 4)."""
    rows: Rows

    def scans(self, places: NDArray[np.intp]) -> KeyframeScans:
        """Those at some places; raises DataError when an image is damaged."""
        images = np.empty((len(places), self.rows.count + 1, WIDTH), np.uint16)
        starts, codec = np.append(0, self.ends), _image_codec()
        for image, place in zip(images, places.tolist(), strict=True):
            packed = self.packed[starts[place] : self.ends[place]]
            try:
                image[:] = np.frombuffer(codec.decompress(packed, image.nbytes), np.uint16).reshape(
                    image.shape
                )
            except (OSError, ValueError) as error:
                raise DataError(
                    f"{shown(self.path)}: image {place} is damaged ({error}); make the run again"
                ) from None
        return KeyframeScans(images, self.T_lidar_map[places], self.rows)


@dataclass(frozen=True, eq=False)
class NearKeyframes:
    """Keyframe scans of some files, read when they are needed: those of a tile take a hundred megabytes."""

    T_lidar_map: NDArray[np.float64]
    """(k, 4, 4): poses of all that are meant."""
    chosen: Mapping[Path, NDArray[np.intp]]
    """File -> places of the scans that are meant."""
    read: Callable[[Path], PackedKeyframes]

    def parts(self) -> Iterator[KeyframeScans]:
        """The scans, some of a file at a time; raises DataError."""
        for path, scans in self.chosen.items():
            of_file = self.read(path)
            for start in range(0, len(scans), SCANS_AT_ONCE):
                yield of_file.scans(scans[start : start + SCANS_AT_ONCE])


def write(moving_points: Iterable[bytes], keyframes: Iterable[bytes], run: Path) -> None:
    """Write the files of chunks into the folder `evidence/` of a run, numbered in their order; raises OSError."""
    for name, contents in ((MOVING_POINTS, moving_points), (KEYFRAMES, keyframes)):
        for number, content in enumerate(contents):
            (run / FOLDER / name).mkdir(parents=True, exist_ok=True)
            (run / FOLDER / name / f"{number}.npz").write_bytes(content)


def write_moving_points(
    moving: Mapping[int, NDArray[np.int64]], file: Path | BinaryIO, lidar: str = ""
) -> None:
    """Write the indices of the moving points of every frame, and the name of their LiDAR; raises OSError."""
    frames = sorted(moving)
    indices = [moving[number] for number in frames]
    arrays: dict[str, NDArray[Any]] = {
        "frames": np.array(frames, np.int64),
        "counts": np.array([len(some) for some in indices], np.int64),
        "places": np.concatenate([*indices, np.empty(0, np.int64)]).astype(np.int32),
    }
    _write(file, arrays | ({LIDAR: np.array([lidar])} if lidar else {}))


def write_keyframes(scans: KeyframeScans, file: Path | BinaryIO) -> None:
    """Write range images and poses of keyframe scans; raises OSError."""
    codec = _image_codec()
    packed = [np.frombuffer(codec.compress(image, asbytes=True), np.uint8) for image in scans.images]
    arrays: dict[str, NDArray[Any]] = {
        "packed": np.concatenate(packed),
        "ends": np.cumsum([len(one) for one in packed], dtype=np.int64),
        "digests": _digests(packed, scans.rows),
        "T_lidar_map": scans.T_lidar_map,
        "seen": scans.rows.seen,
    }
    _write(file, arrays, zipfile.ZIP_STORED)


def _digests(packed: Sequence[NDArray[np.uint8]], rows: Rows) -> NDArray[np.uint8]:
    """(k, 32) SHA-256 of packed images and of their rows."""
    found = [hashlib.sha256(rows.seen.tobytes() + image.tobytes()).digest() for image in packed]
    return np.frombuffer(b"".join(found), np.uint8).reshape(-1, 32)


def _image_codec() -> pa.Codec:
    import pyarrow as pa

    return pa.Codec(IMAGE_CODEC, compression_level=IMAGE_PACKING)


def _write(
    file: Path | BinaryIO, arrays: Mapping[str, NDArray[Any]], packing: int = zipfile.ZIP_DEFLATED
) -> None:
    """Write what `np.savez` or `np.savez_compressed` writes, with less effort: raises OSError."""
    with zipfile.ZipFile(file, "w", packing, compresslevel=PACKING) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)


def read(run: Path, label_set: LabelSet) -> RunEvidence:
    """Open the folder `evidence/` of a run folder; raises DataError if something is missing or damaged."""
    folder = run / FOLDER
    if not is_folder(folder / MOVED):
        raise DataError(
            f"{shown(run)}: found no {FOLDER}/ in it, which is needed to refine the map; make the run again"
        )
    moved = tiles.open_map(folder / MOVED, label_set, MOVED_HELD)
    return RunEvidence(moved, _numbered(folder / MOVING_POINTS), _numbered(folder / KEYFRAMES))


def _numbered(folder: Path) -> list[Path]:
    if not is_folder(folder):
        return []
    paths = [path for path in folder.iterdir() if path.suffix == ".npz" and path.stem.isdecimal()]
    return sorted(paths, key=lambda path: int(path.stem))


def read_lidar(path: Path) -> str:
    """The name of the LiDAR of a file of moving points, empty for the only one; raises DataError."""
    with open_archive(path) as archive:
        return str(archive.array(LIDAR, MOST_NAME_BYTES).read()[0]) if LIDAR in archive else ""


def read_moving_points(path: Path) -> dict[int, NDArray[np.int64]]:
    """The indices of the moving points of every frame; raises DataError."""
    with open_archive(path) as archive:
        frames, counts, places = (
            _array(archive, path, name, "iu", 1) for name in ("frames", "counts", "places")
        )
    if len(frames) != len(counts) or (counts < 0).any() or counts.sum() != len(places) or (places < 0).any():
        raise DataError(
            f"{shown(path)}: found counts or numbers that do not fit its {len(places)} points; make the run again"
        )
    parts = np.split(places.astype(np.int64), np.cumsum(counts)[:-1]) if len(frames) else []
    return dict(zip(frames.tolist(), parts, strict=True))


def read_keyframes(path: Path) -> KeyframeScans:
    """Range images and poses of keyframe scans; raises DataError."""
    packed = read_packed(path)
    return packed.scans(np.arange(len(packed.ends)))


def read_packed(path: Path) -> PackedKeyframes:
    """Keyframe scans whose images are unpacked when they are needed; raises DataError."""
    with open_archive(path, MOST_KEYFRAME_BYTES) as archive:
        packed = _array(archive, path, "packed", "u", 1, MOST_KEYFRAME_BYTES)
        ends = _array(archive, path, "ends", "i", 1)
        T, seen = _array(archive, path, "T_lidar_map", "f", 3), _array(archive, path, "seen", "b", 1)
    if seen.shape != (CELLS,):
        raise DataError(f"{shown(path)}: found {seen.shape} cells, expected {(CELLS,)}; make the run again")
    in_order = len(ends) > 0 and (np.diff(ends, prepend=0) > 0).all() and ends[-1] == len(packed)
    if packed.dtype != np.uint8 or not in_order:
        raise DataError(f"{shown(path)}: found images that do not end where they should; make the run again")
    if T.shape != (len(ends), 4, 4) or not np.isfinite(T).all():
        raise DataError(
            f"{shown(path)}: found poses {T.shape}, expected {(len(ends), 4, 4)}; make the run again"
        )
    return PackedKeyframes(path, packed, ends, T.astype(np.float64), Rows(seen))


def read_poses(path: Path) -> NDArray[np.float64]:
    """Poses of keyframe scans (k, 4, 4), without their images; raises DataError."""
    with open_archive(path) as archive:
        T = _array(archive, path, "T_lidar_map", "f", 3)
    if T.shape[1:] != (4, 4):
        raise DataError(f"{shown(path)}: found poses {T.shape}, expected (k, 4, 4); make the run again")
    return T.astype(np.float64)


def read_digests(path: Path, count: int) -> NDArray[np.uint8]:
    """(k, 32) SHA-256 of what each of so many keyframe scans has seen; raises DataError."""
    with open_archive(path) as archive:
        found = _array(archive, path, "digests", "u", 2)
    if found.shape != (count, 32):
        raise DataError(
            f"{shown(path)}: found digests {found.shape}, expected {(count, 32)}; make the run again"
        )
    return found.astype(np.uint8)


def _array(
    archive: Archive, path: Path, name: str, kinds: str, dimensions: int, most_bytes: int = MOST_BYTES
) -> NDArray[Any]:
    found = archive.array(name, most_bytes).read()
    if found.dtype.kind not in kinds or found.ndim != dimensions:
        raise DataError(f"{shown(path)}: {name} is {found.dtype} {found.shape}; make the run again")
    return found
