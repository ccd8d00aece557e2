"""Types of arrays; their shapes and units are in the docstrings of what takes them."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Mask = NDArray[np.bool_]
Rows = NDArray[np.intp]
