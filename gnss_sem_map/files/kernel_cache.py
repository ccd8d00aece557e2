"""Where numba keeps what it has compiled, when it may write neither beside the package nor into the user's cache.

So it is of a user without a home, with an installation that belongs to root: a container with `--user`, a shared
server. numba would not even import then. A folder of this user under the system's temporary one takes its place, also
for later processes. Its name cannot be foretold, and it is taken only where it is this user's alone: what lies in it is
executed. Only the standard library is imported here: `--help` is to answer at once.
"""

from __future__ import annotations

import hashlib
import logging
import os
import shutil
import stat
import tempfile
from pathlib import Path

VARIABLE = "NUMBA_CACHE_DIR"
PACKAGE = Path(__file__).parents[1]
PREFIX = "gnss-sem-map-kernels-"
COMPILED = ("*.nbi", "*.nbc")


def find_kernel_cache() -> None:
    """Let numba, and matplotlib, write into a temporary folder, where it could write nowhere else; say so once."""
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path(os.path.expanduser("~"), ".cache"), "numba")
    if os.environ.get(VARIABLE) or _is_writable(home):
        return
    beside = [Path(folder, "__pycache__") for folder, _, files in os.walk(PACKAGE) if "__init__.py" in files]
    if all(map(_is_writable, beside)):
        return
    folder = next(filter(_is_ours, sorted(Path(tempfile.gettempdir()).glob(f"{PREFIX}*"))), None)
    if folder is None:
        folder = Path(tempfile.mkdtemp(prefix=PREFIX))
        _take_over(beside, folder)
    os.environ[VARIABLE] = str(folder)  # child processes have it, too
    os.environ.setdefault("MPLCONFIGDIR", str(folder / "matplotlib"))
    logging.getLogger(__name__).warning(
        "neither the installation nor a home can be written: kernels are compiled into %s; %s names another folder",
        folder, VARIABLE,
    )  # fmt: skip


def _take_over(beside: list[Path], folder: Path) -> None:
    """Copy what was compiled ahead, by root, to where numba will look for it; else it is compiled again."""
    for made in beside:
        of_module = str(made.parent)
        place = (
            folder
            / f"{made.parent.name}_{hashlib.sha1(of_module.encode(), usedforsecurity=False).hexdigest()}"
        )
        for file in [file for pattern in COMPILED for file in made.glob(pattern)]:
            place.mkdir(exist_ok=True)
            shutil.copyfile(file, place / file.name)


def _is_writable(folder: Path) -> bool:
    """Whether a folder can be written, or made."""
    while not os.path.lexists(folder):
        folder = folder.parent
    return os.access(folder, os.W_OK | os.X_OK)


def _is_ours(folder: Path) -> bool:
    """Whether it is a folder, and no link, of this user alone."""
    found = folder.lstat()
    return (
        stat.S_ISDIR(found.st_mode) and found.st_uid == os.geteuid() and stat.S_IMODE(found.st_mode) == 0o700
    )
