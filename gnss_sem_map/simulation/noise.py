"""Counter-based random numbers: each is a hash of its indices, so the order of computation does not matter."""

import numpy as np

from gnss_sem_map.simulation.compiled import kernel_of

_K1 = np.uint64(0x9E3779B97F4A7C15)
_K2 = np.uint64(0xC2B2AE3D27D4EB4F)
_K3 = np.uint64(0x165667B19E3779F9)
_K4 = np.uint64(0xD6E8FEB86659FD93)
_M1 = np.uint64(0xBF58476D1CE4E5B9)
_M2 = np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31, _S11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)
_LOW16 = np.uint64(0xFFFF)


@kernel_of("uint64(int64, int64, int64, int64)")
def hash_bits(seed: int, i: int, j: int, k: int) -> np.uint64:
    """64 well mixed bits of four integers (the finaliser of SplitMix64, Steele et al. 2014)."""
    x = (np.uint64(seed) + _K1) * _K2 + np.uint64(i) * _K1 + np.uint64(j) * _K3 + np.uint64(k) * _K4
    x = (x ^ (x >> _S30)) * _M1
    x = (x ^ (x >> _S27)) * _M2
    return x ^ (x >> _S31)


@kernel_of("float64(int64, int64, int64, int64)")
def uniform(seed: int, i: int, j: int, k: int) -> float:
    """A number in [0, 1) that belongs to these four integers."""
    return np.float64(hash_bits(seed, i, j, k) >> _S11) * (1.0 / 9007199254740992.0)


@kernel_of("float64(int64, int64, int64, int64)")
def gaussian(seed: int, i: int, j: int, k: int) -> float:
    """A number of mean 0 and variance 1: the sum of four uniforms, so within 3.5 and free of libm."""
    bits = hash_bits(seed, i, j, k)
    total = 0.0
    for _ in range(4):
        total += np.float64(bits & _LOW16)
        bits = bits >> np.uint64(16)
    return (total / 65535.0 - 2.0) * 1.7320508075688772


@kernel_of("float64(int64, float64, float64)")
def value_noise(seed: int, x: float, y: float) -> float:
    """Smooth noise in [0, 1): the lattice has unit spacing."""
    fx, fy = np.floor(x), np.floor(y)
    i, j = int(fx), int(fy)
    a, b = x - fx, y - fy
    a, b = a * a * (3.0 - 2.0 * a), b * b * (3.0 - 2.0 * b)
    low = uniform(seed, i, j, 0) * (1.0 - a) + uniform(seed, i + 1, j, 0) * a
    high = uniform(seed, i, j + 1, 0) * (1.0 - a) + uniform(seed, i + 1, j + 1, 0) * a
    blend: float = low * (1.0 - b) + high * b
    return blend
