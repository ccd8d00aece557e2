"""Networks on one thread and from one seed: several test runs share a machine, and every run is the same."""

import sys
from collections.abc import Iterator

import pytest


@pytest.fixture(autouse=True)
def _one_thread_one_seed() -> Iterator[None]:
    torch = sys.modules.get("torch")  # tests without a network do not wait for it
    if torch is None:
        yield
        return
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    yield
    torch.set_num_threads(threads)
