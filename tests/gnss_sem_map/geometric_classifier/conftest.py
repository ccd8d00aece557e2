"""scikit-learn counts the cores of the machine once, by a process that no unit test may start."""

from __future__ import annotations

from joblib import cpu_count

cpu_count(only_physical_cores=True)  # joblib remembers it
