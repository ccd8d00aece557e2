"""The distinct keys of many, beside numpy's."""

import numpy as np
import pytest

from gnss_sem_map.voxels.hash_unique import distinct
from gnss_sem_map.voxels.voxel_map import keys_of


@pytest.mark.parametrize("count", [0, 1, 100, 30_000])
def test_distinct_keys_are_those_of_numpy(count):
    rng = np.random.default_rng(count)
    keys = keys_of(rng.normal(size=(count, 3)) * [30, 30, 2], 0.5)
    keys = np.repeat(keys, rng.integers(1, 4, count))  # neighbours in a scan are often in one voxel
    found, numbers = distinct(keys)
    expected, expected_numbers = np.unique(keys, return_inverse=True)
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(numbers, expected_numbers)
