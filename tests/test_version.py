"""The version of a package is that of the tag of its source, however that was got."""

import os
import re
import shutil
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FALLBACK = re.findall(r'fallback_version = "(.*)"', (ROOT / "pyproject.toml").read_text("utf-8"))[0]


def done(*command: str, at: Path) -> str:
    identity = {
        "GIT_AUTHOR_NAME": "a",
        "GIT_AUTHOR_EMAIL": "a@b",
        "GIT_COMMITTER_NAME": "a",
        "GIT_COMMITTER_EMAIL": "a@b",
    }
    return subprocess.run(
        command, cwd=at, check=True, capture_output=True, text=True, env=os.environ | identity
    ).stdout.strip()


def version_of(source: Path) -> str:
    return done(sys.executable, "-m", "hatchling", "version", at=source)


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """A repository of the files that say what the version is, with one commit."""
    folder = tmp_path / "source"
    folder.mkdir()
    for name in ("pyproject.toml", ".git_archival.txt", ".gitattributes", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, folder)
    for command in (["init", "-q"], ["add", "."], ["commit", "-q", "-m", "first"]):
        done("git", *command, at=folder)
    return folder


def archive(source: Path, to: Path) -> Path:
    to.mkdir()
    done("git", "archive", "-o", str(to / "archive.tar"), "HEAD", at=source)
    shutil.unpack_archive(to / "archive.tar", to, filter="data")
    return to


def test_a_tag_is_the_version_in_a_clone_an_archive_and_an_sdist(source: Path, tmp_path: Path) -> None:
    done("git", "tag", "v3.2.1", at=source)
    assert version_of(source) == "3.2.1"
    assert version_of(archive(source, tmp_path / "archive")) == "3.2.1"
    done(sys.executable, "-m", "hatchling", "build", "-t", "sdist", "-d", str(tmp_path), at=source)
    shutil.unpack_archive(tmp_path / "gnss_sem_map-3.2.1.tar.gz", tmp_path, filter="data")
    assert version_of(tmp_path / "gnss_sem_map-3.2.1") == "3.2.1"


def test_after_a_tag_comes_the_next_version_with_the_commit(source: Path) -> None:
    done("git", "tag", "v3.2.1", at=source)
    done("git", "commit", "-q", "--allow-empty", "-m", "second", at=source)
    done("git", "tag", "another-7", at=source)  # says nothing of a version
    commit = done("git", "rev-parse", "HEAD", at=source)
    assert re.fullmatch(rf"3\.2\.2\.dev1\+g{commit[:7]}\w*", version_of(source))


def test_where_git_finds_no_tag_the_version_is_a_lower_one_than_the_first(
    source: Path, tmp_path: Path
) -> None:
    assert re.fullmatch(r"0\.1\.0\.dev1\+g\w+", version_of(source))
    assert version_of(archive(source, tmp_path / "archive")) == FALLBACK
    shutil.rmtree(source / ".git")
    assert version_of(source) == FALLBACK


def test_the_command_tells_the_installed_version() -> None:
    said = subprocess.run(
        [sys.executable, "-m", "gnss_sem_map.cli", "--version"], check=True, capture_output=True, text=True
    ).stdout
    assert said == f"gnss-sem-map {version('gnss-sem-map')}\n"
