"""Thinned sweeps: what a later stage needs of some sweeps is saved by the stage that reads them first.

So the file of a scan is read once before it is mapped, by whichever process gets to it. Each use has files of its own:

FOLDER/NUMBER.USE.npz    rows (n, 4) float32 x, y, z in m and intensity, and the stamps (n,) of its points, if they have
                         (a file of the memo, see `files.memo`)
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from gnss_sem_map.errors import DataError
from gnss_sem_map.files.memo import recall, remember
from gnss_sem_map.sensor_log import Points, Scan, SensorLog


@dataclass(frozen=True, eq=False)
class ThinnedSweeps:
    """Some sweeps of a drive, thinned for one use.

    `numbers` are their places in `log.scans`. Without a folder nothing is saved, and a sweep is read when it is needed.
    """

    log: SensorLog
    use: str
    thin: Callable[[Points], Points]
    numbers: frozenset[int]
    folder: Path | None = None

    def listening(self) -> SensorLog:
        """The same log, of which these sweeps are saved when they are read."""
        if self.folder is None or not self.numbers:
            return self.log
        scans = (
            replace(scan, read=partial(self._read, scan, number)) if number in self.numbers else scan
            for number, scan in enumerate(self.log.scans)
        )
        return replace(self.log, scans=tuple(scans))

    def __getitem__(self, number: int) -> Points:
        """A thinned sweep; raises DataError where it has to be read, and cannot be."""
        saved = self._saved(number)
        if saved is not None:
            return saved
        thinned = self.thin(self.log.scans[number].read())
        self._save(number, thinned)
        return thinned

    def forget(self) -> None:
        """Remove what was saved for this use; a sweep that is needed again is read again."""
        for number in self.numbers if self.folder is not None else ():
            self._file(number).unlink(missing_ok=True)

    def _read(self, scan: Scan, number: int) -> Points:
        points = scan.read()
        if not self._file(number).exists():
            self._save(number, self.thin(points))
        return points

    def _file(self, number: int) -> Path:
        assert self.folder is not None
        return self.folder / f"{number}.{self.use}.npz"

    def _saved(self, number: int) -> Points | None:
        """What was saved; None where there is nothing, or it is damaged."""
        if self.folder is None or number not in self.numbers:
            return None
        found = recall(self._file(number), self.use)
        if found is None:
            return None
        rows = found.arrays["rows"]
        return Points(rows[:, :3], rows[:, 3], found.arrays.get("stamps"))

    def _save(self, number: int, points: Points) -> None:
        """It is no loss where it cannot be saved: the sweep is read again."""
        if self.folder is None or number not in self.numbers or not self.folder.is_dir():
            return
        arrays = {"rows": points.rows.reshape(-1, 4)}
        with suppress(DataError):
            remember(
                self._file(number),
                self.use,
                {},
                arrays if points.stamps is None else {**arrays, "stamps": points.stamps},
            )
