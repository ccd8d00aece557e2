"""Output folders: locked by one command at a time, written beside the old result, and renamed when complete.

What lies at OUT is replaced only when all of it is ours (`ownership`), and never when it is, holds or lies in an
input. The new result is written in `.OUT.work/part`; the old one moves to `.OUT.work/old`, the new one to OUT, and only
then is the old one removed. Killed in between, the next command moves the old one back. So who reads a result without
its lock can tell whether it was replaced meanwhile: then another folder lies there (`read_whole`).
"""

from __future__ import annotations

import errno
import fcntl
import os
import socket
import stat
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TextIO

from gnss_sem_map.errors import DataError
from gnss_sem_map.files import ownership, work_folder
from gnss_sem_map.files.atomic import sync

NO_LOCKS = {errno.ENOTSUP, errno.ENOSYS, errno.ENOLCK, errno.EINVAL}
"""Errors of file systems without locks: there we continue without a lock."""
FIRST_WORDS = "gnss-sem-map writes"
RESUMABLE = "the intermediate results are kept in {}: the same command with --resume continues"


@dataclass(frozen=True, eq=False)
class Claim:
    """An output folder that this process holds exclusively until the claim ends."""

    out: Path
    """Absolute path, with links resolved."""
    by_name: Callable[[str], bool]
    """Whether a folder without a list may hold a file of this path: results of older versions have no list."""

    @property
    def work(self) -> Path:
        """The work folder beside it."""
        return self.out.with_name(f".{self.out.name}.work")

    @property
    def old(self) -> Path:
        """Where the old result is while it is replaced."""
        return self.work / work_folder.OLD


_HELD: dict[Path, Claim] = {}
"""The claims of this process: a claim that is already held is not checked again."""


@contextmanager
def claimed(
    out: Path,
    inputs: Iterable[Path | str | None] = (),
    by_name: Callable[[str], bool] = lambda name: False,
    is_resumable: bool = False,
) -> Iterator[Claim]:
    """Claim an output folder, and check before any work that results can be written there.

    What a killed command left in the work folder is put right: the old result is moved back, an unfinished new one is
    removed. Intermediate results stay until the run is complete; an error says so if the command `is_resumable`: if it
    has --resume. Raises DataError when another command writes there, when what is there is not
    ours, when it is, holds or lies in one of the `inputs`, and when it may not be changed.
    """
    real = real_path(out)
    if real in _HELD:
        refuse_inputs(real, inputs)
        yield _HELD[real]
        return
    claim = Claim(real, by_name)
    refuse_places(real)
    refuse_inputs(real, inputs)
    with parents_made(real), locked(real):
        work_folder.refuse_foreign(claim.work)
        with _explained(claim.work):
            _move_back(claim)
            refuse_foreign(claim)
            ownership.remove_partials(claim.out)
            work_folder.drop_results(claim.work)
        work_folder.make(claim.work)
        _HELD[real] = claim
        try:
            yield claim
        except BaseException as error:
            if is_resumable and work_folder.holds_work(claim.work):
                error.add_note(RESUMABLE.format(claim.work))
            raise
        finally:
            del _HELD[real]
            with suppress(OSError):  # the next command tries again
                if not work_folder.holds_work(claim.work):
                    work_folder.clear(claim.work)


@contextmanager
def new_folder(out: Path, all_content: bool = False) -> Iterator[Path]:
    """A new folder for writing; it is renamed to `out` when the block succeeds, and removed when it fails.

    For `all_content` see `ownership.write_list`.

    An earlier result of ours at `out` is replaced, and what was kept for --resume is removed. Raises DataError as
    `claimed` does, when the disk is full, and when the old result can no longer be replaced: then it says where the
    new one is.
    """
    with claimed(out) as claim:
        part = claim.work / work_folder.PART
        try:
            part.mkdir()
            yield part
            ownership.write_list(part, all_content)
            sync(part)  # then the old result goes, and all that this one was made from
            _swap(claim, part)
        except OSError as error:
            raise DataError(
                f"{out}: cannot write the results ({error.strerror or error}); free the disk or choose another -o"
            ) from None
        finally:
            with suppress(OSError):  # what cannot be removed is named by the next command
                work_folder.drop_results(claim.work)
        with suppress(OSError):
            work_folder.clear(claim.work)


def _swap(claim: Claim, part: Path) -> None:
    out, old = claim.out, claim.old
    try:
        refuse_foreign(claim)  # hours may have passed
        if out.exists() and any(out.iterdir()):
            if ownership.read_list(out) is None:
                ownership.write_list(out)  # of an older version, ours by its names
            out.rename(old)
        try:
            part.rename(out)
        except OSError:
            if old.exists():
                old.rename(out)
            raise
    except (OSError, DataError) as error:
        kept = _free_name(out)
        part.rename(kept)
        why = error.strerror if isinstance(error, OSError) else error
        raise DataError(f"{out}: the earlier results stay ({why}); the new ones are in {kept}") from None


def _free_name(out: Path) -> Path:
    names = (out.with_name(f"{out.name}.new{n or ''}") for n in range(1_000_000))
    return next(path for path in names if not os.path.lexists(path))


def _move_back(claim: Claim) -> None:
    """Restore the old result when a command was killed before it had moved the new one into place."""
    out, old = claim.out, claim.old
    free = not os.path.lexists(out) or (out.is_dir() and not any(out.iterdir()))
    if free and ownership.is_whole(old):
        old.rename(out)


def restore(out: Path, by_name: Callable[[str], bool] = lambda name: False) -> None:
    """Move an old result back, if a command was killed while it replaced it; raises DataError as `claimed` does."""
    real = real_path(out)
    if not os.path.lexists(real) and Claim(real, by_name).old.is_dir():
        with claimed(out, by_name=by_name):
            pass


@contextmanager
def _explained(work: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise DataError(
            f"{error.filename or work}: an earlier command could not remove it, nor can this one ({error.strerror});"
            " see to its rights, or remove it"
        ) from None


def real_path(out: Path) -> Path:
    """Absolute path of a result, with links resolved; raises DataError for a broken link."""
    try:
        real = Path(os.path.realpath(out))
        if real.is_symlink():
            raise DataError(f"{out}: is a link to itself; choose another -o")
        str(real).encode()  # not every format's writer can open what is no text
    except (OSError, ValueError) as error:
        raise DataError(f"{str(out)!r}: is no place for results ({error}); choose another -o") from None
    return real


def refuse_places(out: Path) -> None:
    """Raise DataError for folders that are never results: /, the current folder and the home folder, and their
    parents.
    """
    for what, place in (("the folder that you are in", _here()), ("your home", _home())):
        if place is not None and (out == place or out in place.parents):
            raise DataError(
                f"{out}: is {what}, or holds it; choose a folder of its own, such as -o {out / 'out'}"
            )
    if not out.name:
        raise DataError(f"{out}: is the root of all files; choose another -o")


def _here() -> Path | None:
    try:
        return Path(os.path.realpath(os.getcwd()))
    except OSError:  # it was removed
        return None


def _home() -> Path | None:
    home = os.path.expanduser("~")
    return None if home == "~" else Path(os.path.realpath(home))


def refuse_inputs(out: Path, inputs: Iterable[Path | str | None]) -> None:
    """Raise DataError when an output folder is, contains or lies in one of the inputs, with links resolved."""
    for given in inputs:
        if given is None or not os.path.exists(given):
            continue
        absolute = Path(os.path.abspath(given))
        for place in {
            absolute,
            Path(os.path.realpath(given)),
            Path(os.path.realpath(absolute.parent)) / absolute.name,
        }:
            if out == place or out in place.parents:
                raise DataError(f"{out}: is or holds {given}, which is read; choose another -o")
            if place in out.parents:
                raise DataError(f"{out}: lies in {given}, which is read; choose an -o outside")


def refuse_foreign(claim: Claim) -> None:
    """Raise DataError when the output folder holds a file that we did not write, or that may not be replaced."""
    out = claim.out
    if not os.path.lexists(out):
        return
    if not out.is_dir():
        raise DataError(f"{out}: exists and is no run folder; choose another -o or remove it")
    if os.path.ismount(out):
        raise DataError(
            f"{out}: is a mount point, which cannot be replaced; choose a folder in it: -o {out / 'out'}"
        )
    try:
        if not any(out.iterdir()):
            return
        strange = ownership.foreign(out, claim.by_name)
        folders = [Path(place) for place, _, _ in os.walk(out)]
    except OSError as error:
        raise DataError(f"{out}: cannot be read ({error.strerror}); choose another -o") from None
    if strange is not None and ownership.read_list(out) is None:
        raise DataError(
            f"{out}: exists and is no run folder (it holds {strange}, and no list of what we wrote); choose another -o"
            " or remove it"
        )
    if strange is not None:
        raise DataError(
            f"{out / strange}: is not ours, or was changed since we wrote it; move it away, or choose another -o"
        )
    for folder in (out.parent, *folders):
        if not os.access(folder, os.R_OK | os.W_OK | os.X_OK):
            raise DataError(
                f"{folder}: may not be changed, so the results there cannot be replaced; choose another -o"
            )
        if folder != out.parent and os.path.ismount(folder):
            raise DataError(f"{folder}: is a mount point, which cannot be replaced; choose another -o")


@contextmanager
def parents_made(out: Path) -> Iterator[None]:
    """Create the parent folders of a result; created ones are removed again if they stay empty."""
    missing = [folder for folder in out.parents if not folder.exists()]
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"{out}: cannot be made ({error.strerror}); choose another -o") from None
    try:
        yield
    finally:
        with suppress(OSError):
            for folder in missing:
                folder.rmdir()


@contextmanager
def locked(out: Path) -> Iterator[None]:
    """Lock an output folder with `.OUT.lock`, which names the process. The lock of a dead process is ignored.

    What this process has claimed is locked already. Raises DataError when another command writes there, or
    the lock cannot be written.
    """
    if out in _HELD:
        yield
        return
    path = out.with_name(f".{out.name}.lock")
    try:
        file = _lock(path, out)
    except OSError as error:
        raise DataError(
            f"{out}: cannot be written ({error.strerror}); see to its rights, or choose another place"
        ) from None
    with file:
        try:
            yield
        finally:
            with suppress(OSError):
                path.unlink()


@contextmanager
def read_whole(*results: Path) -> Iterator[None]:
    """Read results that other commands may replace; raises DataError when one of them was.

    That is also why reading fails then, whatever the error says.
    """
    with ExitStack() as held:
        opened = {result: held.enter_context(_opened(result)) for result in results}
        try:
            yield
        finally:
            _refuse_replaced(opened)


@contextmanager
def _opened(folder: Path) -> Iterator[int]:
    """A folder, held open: no other one gets its inode number."""
    try:
        number = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        raise DataError(
            f"{folder}: no run folder here ({error.strerror}); expected the -o of an earlier `gnss-sem-map run`"
        ) from None
    try:
        yield number
    finally:
        os.close(number)


def _refuse_replaced(opened: Mapping[Path, int]) -> None:
    for folder, number in opened.items():
        if not (folder.exists() and os.path.samestat(os.fstat(number), folder.stat())):
            raise DataError(f"{folder}: was replaced by another command while it was read; run this again")


def _lock(path: Path, out: Path) -> TextIO:
    while True:
        number = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o644)
        if not stat.S_ISREG(os.fstat(number).st_mode):
            os.close(number)
            raise DataError(f"{path}: is in the way, and no lock of ours; move it away")
        file = os.fdopen(number, "r+", encoding="utf-8", errors="replace")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = file.read(200).strip() or f"{FIRST_WORDS} it"
            file.close()
            raise DataError(f"{out}: {holder}; wait for it, or choose another -o") from None
        except OSError as error:
            if error.errno not in NO_LOCKS:
                file.close()
                raise
        if path.exists() and os.path.samestat(os.fstat(file.fileno()), path.stat()):
            break
        file.close()  # its holder ended just now, and removed it
    said = file.read()
    if said and not said.startswith(FIRST_WORDS):
        file.close()
        raise DataError(f"{path}: is in the way, and no lock of ours; move it away")
    file.seek(0)
    file.truncate()
    file.write(
        f"{FIRST_WORDS} it now (process {os.getpid()} on {socket.gethostname()},"
        f" since {datetime.now().astimezone():%Y-%m-%d %H:%M:%S})\n"
    )
    file.flush()
    return file
