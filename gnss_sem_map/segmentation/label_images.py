"""Label images of any data set: names, colours and ids of the whole folder show what their values mean."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.errors import ConfigError, DataError
from gnss_sem_map.files.pictures import LabelPixels, read_labels
from gnss_sem_map.files.untrusted import refused, shown
from gnss_sem_map.labels.label_set import UNLABELLED, LabelSet, Taxonomy, shipped_taxonomies, taxonomy

USUAL = "cityscapes"
COLOUR = "colour"
MARKS = {"labelTrainIds": "train_id", "labelIds": "label_id", "color": COLOUR, "instanceIds": "label_id"}
"""What the names of Cityscapes' files say, and so those of tools that follow it; the best one first."""

TIME = re.compile(r"\d{9,}\.\d+")
"""A name that is Unix time, s."""
VOID, UNKNOWN = 255, 254
"""Codes of pixels without a class, and of values that nobody knows; other codes are columns of the evidence."""
ENOUGH = 0.1
"""Ids that fit two kinds are of the one that gives so much more of the pixels a class of the map."""
ROAD = "road"
LEAST_ROAD, LOWEST_ROAD = 0.005, 0.4
"""Of the images of a drive, roads are a larger part; and their middle lies lower, as a share of the height."""
LOOKED_AT = 1 << 18
"""Pixels of an image that are looked at to find out what the values mean."""


@dataclass(frozen=True, eq=False)
class Meaning:
    """What the values of the label images of a folder mean."""

    source: Taxonomy
    kind: str
    codes: NDArray[np.uint8]
    """Of every id (65536,) or colour (2^24,): the column of a class, VOID or UNKNOWN."""
    base: int = 1
    """Larger values of 16 bits are the id times this, and the number of an instance."""

    def read(self, path: Path) -> NDArray[np.uint8]:
        """The code of every pixel (h, w); raises DataError for a damaged file and for values that nobody knows."""
        import cv2

        values = self.values(read_labels(path), shown(path))
        if values.dtype == np.uint8:
            seen = np.asarray(cv2.LUT(values, self.codes[:256]), np.uint8)  # many times faster than indexing
        else:
            seen = np.take(self.codes, values)
        unknown = np.unique(values[seen == UNKNOWN]).tolist()
        if unknown:
            found = [f"#{v:06x}" for v in unknown[:5]] if self.kind == COLOUR else f"ids {unknown[:20]}"
            raise refused(
                path,
                f"found {found}, which are no {self.kind} of {self.source.name} (?ids=, ?taxonomy=)",
            )
        return seen

    def values(self, pixels: LabelPixels, where: str) -> NDArray[Any]:
        """The values of this kind, (h, w); raises DataError where the file has the others only."""
        values = pixels.colours if self.kind == COLOUR else pixels.ids
        if values is None:
            found, expected = ("ids", "colours") if self.kind == COLOUR else ("colours", f"{self.kind} ids")
            raise refused(where, f"found {found}, expected {expected}, not {found}")
        if values.dtype != np.uint16:
            return values
        values = np.where(values == 0xFFFF, np.uint16(255), values)  # -1: without a class
        if self.base == 1000:  # of Cityscapes only things have a number
            return np.where(values < 1000, values, values // np.uint16(1000))
        return values // np.uint16(self.base)


def meaning_of(
    files: Sequence[Path], label_set: LabelSet, name: str | None, kind: str | None, asked: str
) -> Meaning:
    """What label images mean: `kind` of taxonomy `name`, or what fits most of the files, colours before ids.

    Ids that fit several kinds are of the one that explains the pixels far better; ConfigError (`asked` is the folder,
    in words) where none does. DataError when no file can be read.
    """
    pictures, refused = list[LabelPixels](), list[DataError]()
    for path in files:
        try:
            pictures.append(_some(read_labels(path)))
        except DataError as error:
            refused.append(error)
    if not pictures:
        raise none_usable(refused)
    readings = list(_readings(pictures, label_set, name, kind))
    explained = [[_explained(reading, one, len(label_set.names)) for one in pictures] for reading in readings]
    fits = [sum(share is not None for share in shares) for shares in explained]
    best = [i for i, count in enumerate(fits) if count == max(fits)]
    means = sorted(
        ((sum(share or 0 for share in explained[i]) / len(pictures), -i) for i in best), reverse=True
    )
    if readings[best[0]].kind == COLOUR or means[0][0] == 0:
        return readings[best[0]]
    ids = [one.ids.ravel() for one in pictures if one.ids is not None]
    found = f"{asked}: its ids {np.unique(np.concatenate(ids))[:20].tolist()} fit"
    if len(best) == 1 or means[0][0] - means[1][0] >= ENOUGH:
        chosen = readings[-means[0][1]]
        if name is None and kind is None and (why := _odd_road(chosen, pictures, label_set)):
            raise ConfigError(
                f"{found} {chosen.kind} of {chosen.source.name}, but then {why}; are they of another data set? say so"
                f" by ?taxonomy=camvid, mapillary, ade20k or a YAML file, or ?ids={chosen.kind} if they are these"
            )
        return chosen
    kinds = [readings[i].kind for i in best]
    raise ConfigError(
        f"{found} {' as well as '.join(kinds)} of {readings[best[0]].source.name}; say which they are with"
        f" {' or '.join(f'?ids={one}' for one in kinds)}, or ?taxonomy="
    )


def _odd_road(reading: Meaning, pictures: Sequence[LabelPixels], label_set: LabelSet) -> str:
    """What is odd about the roads of a drive by these ids; empty where nothing is, or the map has no such class."""
    if ROAD not in label_set.names:
        return ""
    code, roads, heights = label_set.names.index(ROAD), [], []
    for one in pictures:
        if one.ids is not None:
            rows = (reading.codes[reading.values(one, "")] == code).mean(axis=1)
            roads.append(rows.mean())
            heights.append(rows @ (np.arange(len(rows)) + 0.5) / len(rows) / max(rows.sum(), 1e-9))
    share = float(np.mean(roads))
    if share < LEAST_ROAD:
        return f"{share:.1%} of the pixels are {ROAD}"
    middle = float(np.average(heights, weights=roads))
    return f"the middle of the {ROAD} lies {middle:.0%} down the images" if middle < LOWEST_ROAD else ""


def none_usable(refused: Sequence[DataError]) -> DataError:
    """The error for a folder of which every file that was tried is refused."""
    more = f"; none of {len(refused)} label files that were tried can be used" if len(refused) > 1 else ""
    return DataError(f"{refused[0]}{more}")


def _some(pixels: LabelPixels) -> LabelPixels:
    """At most LOOKED_AT of the pixels, at equal steps."""
    ids, colours = (None if v is None else _thinned(v) for v in (pixels.ids, pixels.colours))
    return LabelPixels(ids, colours)


def _thinned(values: NDArray[Any]) -> NDArray[Any]:
    step = int(np.ceil(np.sqrt(values.size / LOOKED_AT)))
    return values[::step, ::step]


def reading(source: Taxonomy, label_set: LabelSet, kind: str, highest: int = 0) -> Meaning:
    """What values up to `highest` mean that are `kind` of `source`; raises ConfigError where it has no such kind."""
    if kind not in source.ids:
        raise ConfigError(f"taxonomy {source.name!r} has no ids {kind!r}; expected one of {list(source.ids)}")
    classes = source.lookup(label_set, kind, 1 << 24 if kind == COLOUR else 1 << 16)
    codes = np.where(classes == UNLABELLED, np.uint8(VOID), np.uint8(UNKNOWN))
    np.copyto(codes, classes, casting="unsafe", where=classes >= 0)
    largest = max((v for v in (*source.ids[kind].values(), *source.void[kind]) if v != VOID), default=0)
    base = 1 if highest <= max(VOID, largest) else 256 if highest < 256 * (largest + 1) else 1000
    return Meaning(source, kind, codes, base)


def _readings(
    pictures: Sequence[LabelPixels], label_set: LabelSet, name: str | None, kind: str | None
) -> Iterator[Meaning]:
    """All that the values may mean, colours first."""
    usual = taxonomy(name or USUAL)
    known = [
        one for one in shipped_taxonomies() if name is None and one != USUAL and one in label_set.sources
    ]
    if kind == COLOUR or (kind is None and any(one.colours is not None for one in pictures)):
        for source in (usual, *map(taxonomy, known)):
            if COLOUR in source.ids:
                yield reading(source, label_set, COLOUR)
    highest = [int(v.ids[v.ids < 0xFFFF].max(initial=0)) for v in pictures if v.ids is not None]
    for one in usual.ids if kind is None else (kind,):
        if one != COLOUR:
            yield reading(usual, label_set, one, max(highest, default=0))


def _explained(reading: Meaning, pixels: LabelPixels, count: int) -> float | None:
    """Share of the pixels that have one of the map's classes; None where some value is unknown."""
    if (pixels.colours if reading.kind == COLOUR else pixels.ids) is None:
        return None
    seen = reading.codes[reading.values(pixels, "")]
    return None if (seen == UNKNOWN).any() else float((seen < count).mean())


def by_frame(paths: Iterable[Path], suffix: str, kind: str | None) -> tuple[dict[int, Path], str | None]:
    """The files by frame number, and the kind of ids that their names tell; one name pattern of several is taken.

    A name that is a number is one. Else it is the last number in it that differs between the files. Raises
    DataError for two files of one frame, and for several patterns of which none is known.
    """
    patterns: dict[str, list[Path]] = {}
    for path in paths:
        if path.suffix.lower() == suffix and re.search(r"\d", path.stem):
            patterns.setdefault(re.sub(r"\d+", "#", path.stem), []).append(path)
    if "#" in patterns:  # beside it may lie pictures to look at
        return _numbers(patterns["#"]), None
    for mark, of in MARKS.items():
        like = {pattern: files for pattern, files in patterns.items() if pattern.endswith(mark)}
        if like and kind in (None, of):
            return _numbers(_only(like)), of
    return (_numbers(_only(patterns)), None) if patterns else ({}, None)


def _only(patterns: dict[str, list[Path]]) -> list[Path]:
    first, *others = patterns.values()
    if others:
        names = [shown(files[0].name) for files in (first, *others)][:3]
        raise DataError(
            f"labels {shown(first[0].parent)}: found names such as {names}; keep kinds in two folders"
        )
    return first


def _numbers(paths: list[Path]) -> dict[int, Path]:
    if all(TIME.fullmatch(path.stem) for path in paths):
        raise refused(
            paths[0],
            f"named by times, {len(paths)} files; expected frame numbers: rename them",
        )
    columns = np.array([re.findall(r"\d+", path.stem) for path in paths], object).T
    differ = [column for column in columns if len(set(column)) > 1]
    chosen = differ[-1] if differ else max(columns, key=lambda column: len(column[0]))
    files: dict[int, Path] = {}
    for path, text in zip(paths, chosen, strict=True):
        if int(text) in files:
            raise refused(path, f"same frame as {shown(files[int(text)].name)}; expected one file per frame")
        files[int(text)] = path
    return files
