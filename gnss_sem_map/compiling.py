"""numba's `njit`, whose compiled code is kept in files that have a name of their own.

numba counts the files of a function, and writes the list of them first. A process that is killed in between, a full
disk, or two processes that compile one function at the same time leave a list that names a file of other code: that of
an earlier version, or of other types. It would be called without a word, by every process from then on.
"""

from __future__ import annotations

from uuid import uuid4

from numba import njit
from numba.core.caching import IndexDataCacheFile

__all__ = ["njit"]


def _name_of_its_own(files: IndexDataCacheFile, number: int) -> str:
    """The name of a new file; `number` is what numba would call it."""
    return str(files._index_name).removesuffix("nbi") + f"{uuid4().hex[:16]}.nbc"


IndexDataCacheFile._data_name = _name_of_its_own  # type: ignore[method-assign]
