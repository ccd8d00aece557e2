"""A network gives the same answers whoever asks, on every device that there is."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from threading import get_ident

import numpy as np
import pytest
import torch

from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.segmentation import open_segmenter
from gnss_sem_map.segmentation.networks import NetworkSegmenter
from gnss_sem_map.sensor_log import Image

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
TOLERANCE = {"cpu": 1e-5, "cuda": 0.02}
"""A GPU computes convolutions with 10 bits of mantissa (TF32), other ones for another batch."""


def photograph(number: int) -> Image:
    rng = np.random.default_rng(number)
    pixels = rng.integers(0, 256, (12, 20, 3), dtype=np.uint8).repeat(8, 0).repeat(8, 1)
    return Image(number, 0.1 * number, lambda: pixels)


IMAGES = [photograph(number) for number in range(6)]


@pytest.mark.parametrize("device", DEVICES)
def test_batches_and_threads_give_what_one_image_alone_gives_on_a_cpu(device: str) -> None:
    alone = [open_segmenter("demo", open_label_set(), "cpu")(image) for image in IMAGES]
    network = open_segmenter("demo", open_label_set(), device)
    assert isinstance(network, NetworkSegmenter)
    with ThreadPoolExecutor(3) as pool:
        by_threads = [one for (one,) in pool.map(network.on_one_core, ([image] for image in IMAGES))]
    for seen in (network.segment_many(IMAGES), by_threads):
        np.testing.assert_allclose(seen, alone, atol=TOLERANCE[device])


def test_on_another_device_than_the_cpu_one_thread_runs_the_network_whoever_asks() -> None:
    runners = set()

    def probabilities(images: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
        runners.add(get_ident())
        return torch.ones(len(images), 1, *size)

    device = torch.device("meta")  # of torch's own, for shapes without numbers
    segment = NetworkSegmenter("net", probabilities, ("road",), device, torch.from_numpy)
    with ThreadPoolExecutor(4) as pool:
        assert all(one.shape == (48, 80, 1) for one in pool.map(segment, IMAGES))
    assert len(runners) == 1
