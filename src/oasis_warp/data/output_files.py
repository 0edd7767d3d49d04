"""Write files and folders atomically: a hidden sibling is written, then renamed.

A rename inside one folder is atomic on all common file systems, so a full disk, Ctrl-C or a crash never leaves half an
output. What a killed run leaves, `.NAME.xxxxxxxx.part`, the next run for the same output removes; files that were whole
and not all moved yet, `.NAME.xxxxxxxx.done`, it moves. A lock tells them from those of a run that goes on.
Folders of long work instead note the settings with which it started, so that it can be resumed.
"""

import contextlib
import errno
import json
import os
import re
import secrets
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

try:
    import fcntl
except ImportError:  # Windows has no such locks: there, leftovers stay
    fcntl = None

from oasis_warp.core.errors import InputError, one_line, shortened
from oasis_warp.data.json_text import read_json

_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_DISK = (*_NO_ROOM, errno.EIO, errno.EROFS)
PART, DONE = ".part", ".done"
"""Ends of temporary names: before and after everything in it is whole."""
_LONGEST = 40
"""Letters of a temporary name taken from the output's: a name may have 255 bytes, a letter up to 4."""


@contextlib.contextmanager
def output_file(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path for the file `path`: moved there when the block ends, removed when it fails.

    The temporary file is a sibling of `path` with the same suffix. An existing file is replaced, also through a link.
    A missing folder is made, and removed again if the block fails.

    Raises:
        InputError: the folder cannot be made or written, `path` exists and is no file, or the disk is full.
    """
    final = Path(os.path.realpath(path))
    with _explained(path, final), _folder(path, final.parent):
        _check_file(path, final)
        _recover(final.parent, final.stem, final.suffix)
        with _part(Path.touch, final.parent, final.stem, final.suffix) as part:
            yield part
            _flush(part)
            os.replace(part, final)


def write_file(path: Path | str, data: bytes) -> None:
    """Write `data` to `path` atomically.

    Raises:
        InputError: see `output_file`.
    """
    with output_file(path) as part:
        part.write_bytes(data)


def write_files(contents: Mapping[Path, bytes]) -> None:
    """Write files that belong together: they appear when all are complete, the first one last.

    Raises:
        InputError: see `output_file`.
    """
    with contextlib.ExitStack() as files:  # ends in reverse
        for path, data in contents.items():
            files.enter_context(output_file(path)).write_bytes(data)


@contextlib.contextmanager
def output_folder(path: Path | str) -> Iterator[Path]:
    """Yield a temporary folder for the files of `path`: they all appear there when the block ends, or none if it fails.

    In an existing folder, new files replace those of the same name and other files stay, so running again updates the
    folder. The files are then moved one by one, in the order of their names; if that is cut off, the next run for this
    folder moves the others. Missing folders above are made, and removed again if the block fails.

    Raises:
        InputError: a folder above cannot be made or written, `path` is a file, or the disk is full.
    """
    final = Path(os.path.realpath(path))
    with _explained(path, final), _folder(path, final.parent):
        if final.exists() and not final.is_dir():
            raise InputError(f"{path}: expected a folder to write to, found a file; choose another name.")
        # The temporary folder lies inside an existing folder, which may be the only writable place.
        home = final if final.is_dir() else final.parent
        for place in {home, final.parent}:
            _recover(place, final.name)
        with _part(Path.mkdir, home, final.name) as part:
            try:
                yield part
            except InputError as error:  # from a writer inside, which only knows the temporary path
                raise InputError(str(error).replace(one_line(part), one_line(path))) from error
            _move_files(part, final)


@contextlib.contextmanager
def new_folder(path: Path | str) -> Iterator[Path]:
    """Yield a temporary folder that becomes `path` when the block ends, unless `path` is there by then.

    For folders whose names say what is in them: of several processes that make the same one, the first makes it.

    Raises:
        InputError: see `output_folder`.
    """
    final = Path(os.path.realpath(path))
    with _explained(path, final), _folder(path, final.parent), _part(Path.mkdir, final.parent, final.name) as part:
        yield part
        for file in part.iterdir():
            _flush(file)
        try:
            os.rename(part, final)
        except OSError:
            if not final.is_dir():
                raise


def remove_leftovers(folder: Path) -> None:
    """Remove what killed runs left in `folder`, of whatever output; what another process works on stays."""
    _recover(folder, None)


def _check_file(path: Path | str, final: Path) -> None:
    if final.is_dir():
        raise InputError(f"{path}: expected a file to write, found a folder; add a file name.")
    if final.exists() and not final.is_file():
        raise InputError(f"{path}: expected a file to write, found a device or pipe; give a file name.")


def _move_files(part: Path, final: Path) -> None:
    """Move the folder `part` to `final`, or its files into the folder that is there."""
    for file in part.iterdir():
        _flush(file)
    if not final.is_dir():
        os.replace(part, final)
        return
    for file in part.iterdir():
        _check_file(final / file.name, final / file.name)
    done = part.with_suffix(DONE)
    os.replace(part, done)  # from here on the next run would finish
    _empty(done, final)


def _empty(done: Path, final: Path) -> None:
    for file in sorted(done.iterdir()):
        os.replace(file, final / file.name)
    done.rmdir()


@contextlib.contextmanager
def _part(make: Callable[[Path], object], folder: Path, stem: str, suffix: str = "") -> Iterator[Path]:
    """A new temporary file or folder, locked while the block runs, and gone after it."""
    lock = None
    while lock is None:  # another run may take it for a leftover before it is locked
        part = folder / f".{stem[:_LONGEST]}.{secrets.token_hex(4)}{PART}{suffix[:_LONGEST]}"
        make(part)  # fails now and not after minutes of work
        lock = _lock(part)
    try:
        yield part
    finally:
        _remove(part)
        os.close(lock)


def _recover(folder: Path, stem: str | None, suffix: str = "") -> None:
    """Remove what killed runs left of the same output, or of any, and move what was whole."""
    start, end = (r"\..*\.", ".*") if stem is None else map(re.escape, (f".{stem[:_LONGEST]}.", suffix[:_LONGEST]))
    name = re.compile(f"{start}[0-9a-f]{{8}}({PART}{end}|{DONE})")
    with contextlib.suppress(OSError):  # a folder that may not be listed
        for left in [file for file in folder.iterdir() if name.fullmatch(file.name)]:
            if fcntl is None or (lock := _lock(left)) is None:
                continue  # in use
            with contextlib.suppress(OSError):
                if left.suffix == DONE:
                    _empty(left, folder)
                else:
                    _remove(left)
            os.close(lock)


def _remove(part: Path) -> None:
    if part.is_dir():
        shutil.rmtree(part, ignore_errors=True)
    else:
        part.unlink(missing_ok=True)


def _lock(path: Path) -> int | None:
    """An open file that locks `path` as long as this process lives, None if another has the lock or removed it."""
    if fcntl is None:
        return os.open(os.devnull, os.O_RDONLY)
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    except FileNotFoundError:
        return None
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        free = os.fstat(handle).st_nlink > 0
    except BlockingIOError:
        free = False
    except OSError:  # a file system without locks
        free = True
    if free:
        return handle
    os.close(handle)
    return None


@contextlib.contextmanager
def _explained(path: Path | str, final: Path) -> Iterator[None]:
    """Turn errors of writing the output `path` into one sentence, but not those of other things in the block."""
    try:
        yield
    except OSError as error:
        if error.errno in _DISK or PART in str(error.filename) or str(error.filename) == str(final):
            raise _explain(path, error) from error
        raise


@contextlib.contextmanager
def _folder(path: Path | str, folder: Path) -> Iterator[None]:
    """Make `folder` and those above it for the output `path`; if the block fails, remove those again that are empty."""
    made = make_folders(path, folder)
    try:
        yield
    except BaseException:
        for new in made:
            with contextlib.suppress(OSError):
                new.rmdir()
        raise


def make_folders(path: Path | str, folder: Path) -> list[Path]:
    """Make `folder` and those above it that are missing, for the output `path`; the new ones, the innermost first.

    Raises:
        InputError: one cannot be made.
    """
    missing = []
    while not folder.is_dir():
        if folder.exists() or folder.parent == folder:
            raise InputError(f"{path}: expected the folder {folder} to write to, found a file; choose another name.")
        missing.append(folder)
        folder = folder.parent
    for k, new in enumerate(reversed(missing)):
        try:
            new.mkdir(exist_ok=True)
        except OSError as error:
            for undo in missing[len(missing) - k :]:
                undo.rmdir()
            raise _explain(path, error) from error
    return missing


def _flush(file: Path) -> None:
    """Flush `file` to the disk: a full disk may only be reported now."""
    with file.open("rb+") as stream:
        os.fsync(stream.fileno())


def _explain(path: Path | str, error: OSError) -> InputError:
    if error.errno in _NO_ROOM:
        return InputError(f"{path}: no room left to write it ({error.strerror}); free some or choose another disk.")
    if error.errno == errno.ENAMETOOLONG:
        return InputError(f"{path}: the name is too long for this disk; choose a shorter one.")
    return InputError(f"{path}: cannot be written ({error.strerror}); check the permissions of its folder.")


def check_apart(inputs: Sequence[Path], names: Sequence[str], shared: str, remedy: str) -> None:
    """Check that what is written of each photo has a name of its own.

    Args:
        inputs: The photos.
        names: Of their outputs.
        shared: What two of one name would share, for messages.
        remedy: What to do about it.

    Raises:
        InputError: two photos or more have one name.
    """
    counts = Counter(names)
    if twins := [str(path) for path, name in zip(inputs, names, strict=True) if counts[name] > 1]:
        raise InputError(f"photos: {' and '.join(twins)} would share one {shared}; {remedy}.")


def open_resumable_folder(folder: Path, name: str, settings: dict[str, Any], content: str) -> None:
    """Create `folder` and write `settings` to its file `name`, or check that the same settings stand there.

    What killed runs left in it is removed: of a file that is complete, nothing else would.

    Args:
        folder: Made if it is missing, with those above it.
        name: Name of the JSON file.
        settings: Settings as JSON values.
        content: What the folder holds, for messages.

    Raises:
        InputError: `folder` is a file or cannot be made, or it holds other settings.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: expected a folder to write to, found a file; choose another name.")
    make_folders(folder, folder)
    file = folder / name
    text = json.dumps(settings, indent=1, sort_keys=True) + "\n"
    try:
        noted = file.read_bytes() if file.exists() else None
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror}); choose another folder.") from error
    if noted is None:
        write_file(file, text.encode())
    elif noted != text.encode():
        raise InputError(
            f"{folder}: holds {content} made with other settings{_first_difference(noted, settings)} (see {name}); "
            "choose another folder."
        )
    remove_leftovers(folder)


def _first_difference(noted: bytes, settings: dict[str, Any]) -> str:
    try:
        before = read_json(noted)
    except ValueError:
        return ""
    for key in sorted(before.keys() | settings.keys()):
        old, new = before.get(key), settings.get(key)
        if old != new:
            return f", {shortened(key)} {shortened(json.dumps(old))} and not {shortened(json.dumps(new))}"
    return ""
