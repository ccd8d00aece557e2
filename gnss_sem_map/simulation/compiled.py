"""How the simulator's loops are compiled: once, kept on disk, without the interpreter's lock.

They allocate nothing, so reference counts are switched off: counting alone would double the time of a ray and make
threads wait for each other. No fastmath: the same operations in the same order give the same bits everywhere.
"""

from typing import Final

from numba import njit

kernel: Final = njit(cache=True, nogil=True, error_model="numpy", _nrt=False)
inlined: Final = njit(cache=True, nogil=True, error_model="numpy", _nrt=False, inline="always")
