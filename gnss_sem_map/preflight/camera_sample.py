"""What the checks of one camera share: some of its images, with the depth edges of the scans of their moment."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from factor_graphs.errors import FactorGraphError
from gnss_sem_map.errors import DataError
from gnss_sem_map.preflight.depth_edges import Edges, View, depth_edges, edge_strength
from gnss_sem_map.preflight.sample import Sample
from gnss_sem_map.scans.projection import exposure_stamp, image_exposed_at
from gnss_sem_map.sensor_log import Image, Scan
from gnss_sem_map.sensor_log.cameras import Camera


@dataclass(frozen=True, eq=False)
class CameraSample:
    """A camera of the drive that is checked; every value is computed once, when a check first needs it."""

    drive: Sample
    camera: Camera

    @property
    def images(self) -> tuple[Image, ...]:
        """All images of the camera, sorted by stamp."""
        return self.drive.log.images_of(self.camera.name)

    def exposed(self, image: Image) -> float:
        """When an image was exposed, as said, s."""
        return exposure_stamp(image, self.drive.log.calibration, self.drive.settings.labelling)

    def pixels(self, image: Image) -> NDArray[np.uint8]:
        """An image, read once; raises DataError."""
        if image.number not in self._pixels:
            self._pixels[image.number] = image.read()
        return self._pixels[image.number]

    @cached_property
    def _pixels(self) -> dict[int, NDArray[np.uint8]]:
        return {}

    @property
    def edges(self) -> Edges | None:
        """Depth edges of a few scans, and their images; None where no image is near a scan."""
        return self._edges[0] if self._edges is not None else None

    @property
    def edge_images(self) -> tuple[Image, ...]:
        """The image of each view of `edges`."""
        return self._edges[1] if self._edges is not None else ()

    @cached_property
    def _edges(self) -> tuple[Edges, tuple[Image, ...]] | None:
        return self._edges_of(self.drive.moving_scans[0])

    @cached_property
    def other_edges(self) -> Edges | None:
        """The same of other scans, twice as many: read only where the first ones leave doubt."""
        found = self._edges_of(self.drive.moving_scans[1])
        return found[0] if found is not None else None

    def _edges_of(self, scans: list[Scan]) -> tuple[Edges, tuple[Image, ...]] | None:
        drive, views, images = self.drive, [], []
        T_imu_lidar = drive.log.calibration.T_imu_lidar
        for scan in scans:
            image = image_exposed_at(scan.stamp, drive.log, self.camera, drive.settings.labelling)
            if image is None:
                continue
            try:
                p_map, weights = depth_edges(scan.read(), scan.stamp, drive.trajectory, T_imu_lidar)
                coarse, fine = edge_strength(self.pixels(image))
            except (DataError, FactorGraphError):
                continue  # counted when the map is built
            views.append(View(p_map, weights, self.exposed(image), coarse, fine))
            images.append(image)
        if not views:
            return None
        return Edges(tuple(views), drive.trajectory, T_imu_lidar, self.camera), tuple(images)
