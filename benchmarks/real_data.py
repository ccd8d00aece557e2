"""Where the excerpts of real drives are: $GNSS_SEM_MAP_DATA, or ../shared/data."""

import os
from pathlib import Path

DATA = Path(os.environ.get("GNSS_SEM_MAP_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
