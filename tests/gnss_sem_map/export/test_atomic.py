"""A file, or a folder of files, is whole or not there."""

from pathlib import Path

import pytest

from gnss_sem_map.errors import DataError
from gnss_sem_map.files import ownership
from gnss_sem_map.files.atomic import adding_folder, replacing


def half_of_a_map(path: Path) -> None:
    with replacing(path) as file:
        file.write(b"half")
        raise KeyboardInterrupt


def test_the_file_appears_only_when_the_block_has_ended(tmp_path: Path) -> None:
    path = tmp_path / "map.ply"
    with replacing(path) as file:
        file.write(b"whole")
        file.flush()
        assert not path.exists()
    assert path.read_bytes() == b"whole"
    assert list(tmp_path.iterdir()) == [path]


def test_two_that_write_one_file_at_a_time_do_not_mix_their_bytes(tmp_path: Path) -> None:
    """A worker that is thought lost may go on, in another container with the same process number."""
    path = tmp_path / "map.ply"
    with replacing(path) as first:
        first.write(b"half of the fir")
        with replacing(path) as second:
            second.write(b"second")
        assert path.read_bytes() == b"second"
        first.write(b"st")
    assert path.read_bytes() == b"half of the first"
    assert list(tmp_path.iterdir()) == [path]


def test_an_interrupted_write_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "map.ply"
    path.write_bytes(b"old")
    with pytest.raises(KeyboardInterrupt):
        half_of_a_map(path)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"the folder .*nowhere does not exist"):
        half_of_a_map(tmp_path / "nowhere" / "map.ply")


def half_of_a_folder(path: Path) -> None:
    with adding_folder(path) as folder:
        (folder / "0_0_0.js").write_bytes(b"half")
        raise KeyboardInterrupt


def test_a_folder_appears_only_when_the_block_has_ended_and_only_with_files(tmp_path: Path) -> None:
    with adding_folder(tmp_path / "empty"):
        pass
    with pytest.raises(KeyboardInterrupt):
        half_of_a_folder(tmp_path / "viewer")
    assert not list(tmp_path.iterdir())
    with adding_folder(tmp_path / "viewer") as folder:
        (folder / "0_0_0.js").write_bytes(b"whole")
        assert not (tmp_path / "viewer").exists()
    assert [path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*")] == [
        "viewer",
        "viewer/0_0_0.js",
    ]
    with pytest.raises(DataError, match="exists; move it away"):
        half_of_a_folder(tmp_path / "viewer")


def test_what_a_format_writes_into_a_run_is_listed_with_its_folders_and_goes_with_the_run(
    tmp_path: Path,
) -> None:
    run, exported = tmp_path / "run", tmp_path / "exported"
    (exported / "viewer").mkdir(parents=True)
    for name in ("viewer.html", "viewer/0_0_0.js", "viewer/0_1_0.js"):
        (exported / name).write_text(f"content of {name}")
    run.mkdir()
    (run / "run.json").write_text("{}")
    ownership.write_list(run)
    for _ in range(2):
        ownership.amend_all(run, exported)
        assert (run / "viewer/0_1_0.js").read_text() == "content of viewer/0_1_0.js"
        assert ownership.foreign(run) is None
        assert ownership.is_whole(run)
    (run / "viewer/0_1_0.js").write_text("work of somebody")
    with pytest.raises(DataError, match=r"0_1_0.js: was not written by us"):
        ownership.amend_all(run, exported)
    (run / "viewer/0_1_0.js").unlink()
    for name in (".viewer.html.7.part", "viewer/.0_1_0.js.7.part"):  # the process was killed
        (run / name).write_text("half of it")
    assert ownership.foreign(run) is None
    (run / ".thesis.tex.7.part").write_text("half of a thesis")
    assert ownership.foreign(run) == ".thesis.tex.7.part"
    (run / ".thesis.tex.7.part").unlink()
    ownership.remove(run)
    assert not run.exists()
