"""A user without a home runs an installation of root's: what numba compiles is in a folder of this user alone."""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from declared import ROOT, absent

import gnss_sem_map
from gnss_sem_map.files.kernel_cache import PREFIX

pytestmark = pytest.mark.integration

CALL = """
import numpy as np
from gnss_sem_map.voxels import hash_unique
keys, numbers = hash_unique.distinct(np.array([7, 3, 7]))
assert keys.tolist() == [3, 7] and numbers.tolist() == [1, 0, 1]
print(sum(hash_unique._numbered.stats.cache_hits.values()))
"""
RIGHTS = "-dac_override,-dac_read_search"
AS_OWNER = ["setpriv", f"--bounding-set={RIGHTS}", f"--inh-caps={RIGHTS}"]
"""Root without its right to write everywhere: mode bits hold for it as for any user."""
NOWHERE = "/proc"
"""Nobody makes a folder there."""

Start = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def start(tmp_path: Path) -> Start:
    """Run a program with a copy of the package that cannot be written."""
    package, temporary = tmp_path / "installed", tmp_path / "temporary"
    temporary.mkdir()
    for name in ("gnss_sem_map", "factor_graphs"):
        source = Path(gnss_sem_map.__file__).parents[1] / name
        shutil.copytree(source, package / name, ignore=shutil.ignore_patterns("__pycache__"))
    prefix = AS_OWNER if os.geteuid() == 0 else []

    def run(*command: str, compiled_ahead: bool = False, **more: str) -> subprocess.CompletedProcess[str]:
        environment = {"PATH": os.environ["PATH"], "PYTHONPATH": str(package), "TMPDIR": str(temporary)}
        if compiled_ahead:
            subprocess.run([sys.executable, "-c", CALL], env=environment, cwd=tmp_path, check=True)
        subprocess.run(["chmod", "-R", "a-w", str(package)], check=True)
        there = subprocess.run([*prefix, "touch", str(package / "x")], capture_output=True, check=False)
        if there.returncode == 0:
            absent(ROOT, "root cannot drop its rights here")
        return subprocess.run(
            [*prefix, sys.executable, *command], env=environment | {"HOME": NOWHERE} | more,
            cwd=tmp_path, capture_output=True, text=True, check=False,
        )  # fmt: skip

    return run


def test_kernels_are_compiled_once_into_a_folder_of_this_user(start: Start, tmp_path: Path) -> None:
    first, second = start("-c", CALL), start("-c", CALL)
    assert (first.returncode, first.stdout) == (0, "0\n"), first.stderr
    assert (second.returncode, second.stdout) == (0, "1\n"), second.stderr
    [folder] = (tmp_path / "temporary").iterdir()
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    for said in (first.stderr, second.stderr):
        assert said.count("\n") == 1
        assert f"kernels are compiled into {folder}; NUMBA_CACHE_DIR names another folder" in said


@pytest.mark.slow
def test_what_was_compiled_ahead_is_used(start: Start) -> None:
    done = start("-c", CALL, compiled_ahead=True)
    assert (done.returncode, done.stdout) == (0, "1\n"), done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("trap", ["open to all", "a link"])
def test_a_folder_that_others_may_have_filled_is_not_taken(start: Start, tmp_path: Path, trap: str) -> None:
    planted = tmp_path / "temporary" / f"{PREFIX}0"
    if trap == "a link":
        (tmp_path / "elsewhere").mkdir(mode=0o700)
        planted.symlink_to(tmp_path / "elsewhere")
    else:
        planted.mkdir()
        planted.chmod(0o777)
    done = start("-c", CALL)
    assert done.returncode == 0, done.stderr
    assert not list(planted.iterdir())
    assert f"{planted};" not in done.stderr


@pytest.mark.slow
def test_a_folder_that_the_user_names_is_taken_without_a_word(start: Start, tmp_path: Path) -> None:
    done = start("-c", CALL, NUMBA_CACHE_DIR=str(tmp_path / "mine"))
    assert (done.returncode, done.stderr) == (0, "")
    assert list((tmp_path / "mine").rglob("*.nbi"))


@pytest.mark.slow
def test_a_drive_is_mapped_from_a_read_only_installation(start: Start, tmp_path: Path) -> None:
    command = ("-m", "gnss_sem_map.cli", "demo", "-o", str(tmp_path / "demo"), "--seconds", "3")
    done = start(*command)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("kernels are compiled into") == 1
