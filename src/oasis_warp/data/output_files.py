"""Write files and folders so that they are whole or not there: a hidden sibling is filled, then renamed.

A rename inside one folder is atomic on every file system worth the name, so a reader, a full disk, Ctrl-C or a crash
never sees half an output.
"""

import contextlib
import errno
import json
import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from oasis_warp.core.errors import InputError

_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_DISK = (*_NO_ROOM, errno.EIO, errno.EROFS)


@contextlib.contextmanager
def output_file(path: Path | str) -> Iterator[Path]:
    """A place to write the file `path`: moved there when the block ends, removed when it fails or is interrupted.

    The place is a sibling of `path` with the same suffix. An existing file is replaced, through a link too.

    Raises:
        InputError: the folder is missing or closed, something that is no file stands there, the disk is full.
    """
    final = Path(os.path.realpath(path))
    if final.is_dir():
        raise InputError(f"{path}: expected a file to write, found a folder; add a file name.")
    if final.exists() and not final.is_file():
        raise InputError(f"{path}: expected a file to write, found a device or pipe; give a file name.")
    _check_parent(path, final.parent)
    part = final.with_name(f".{final.stem}.{secrets.token_hex(4)}{final.suffix}")
    try:
        part.touch(exist_ok=False)  # now, and not after minutes of work, is the time to learn that it cannot be written
        yield part
        _flush(part)
        os.replace(part, final)
    except OSError as error:
        if _is_about(part, error):
            raise _explain(path, error) from error
        raise
    finally:
        part.unlink(missing_ok=True)


def write_file(path: Path | str, data: bytes) -> None:
    """Write `data` to `path`, all or nothing.

    Raises:
        InputError: as for `output_file`.
    """
    with output_file(path) as part:
        part.write_bytes(data)


@contextlib.contextmanager
def output_folder(path: Path | str) -> Iterator[Path]:
    """A place to write the files of the folder `path`: they appear there when the block ends, or none of them does.

    Where `path` exists already, each new file replaces its namesake and every other file in it stays: running again
    into the same folder updates it. The files move one by one then, in the order of their names.

    Raises:
        InputError: the parent is missing or closed, a file stands at `path`, the disk is full.
    """
    final = Path(os.path.realpath(path))
    if final.exists() and not final.is_dir():
        raise InputError(f"{path}: expected a folder to write to, found a file; choose another name.")
    _check_parent(path, final.parent)
    # An existing folder may be the only one we may write to, so the new files are gathered inside it.
    home = final if final.is_dir() else final.parent
    part = home / f".{final.name}.{secrets.token_hex(4)}"
    try:
        part.mkdir()
        yield part
        for file in part.iterdir():
            _flush(file)
        if final.is_dir():
            for file in sorted(part.iterdir()):
                os.replace(file, final / file.name)
        else:
            os.replace(part, final)
    except InputError as error:  # from a writer inside, which knows the file by its hidden place only
        raise InputError(str(error).replace(str(part), str(path))) from error
    except OSError as error:
        if _is_about(part, error):
            raise _explain(path, error) from error
        raise
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _check_parent(path: Path | str, parent: Path) -> None:
    if not parent.is_dir():
        found = "a file" if parent.exists() else "no such folder"
        raise InputError(f"{path}: expected the folder {parent} to write to, found {found}; make it first.")


def _flush(file: Path) -> None:
    """Have the system write `file` out: a full disk may only show now."""
    with file.open("rb+") as stream:
        os.fsync(stream.fileno())


def _is_about(part: Path, error: OSError) -> bool:
    """Whether `error` comes from writing `part`, and not from something else that the block did."""
    return error.errno in _DISK or (
        isinstance(error.filename, str | Path) and Path(error.filename).is_relative_to(part)
    )


def _explain(path: Path | str, error: OSError) -> InputError:
    if error.errno in _NO_ROOM:
        return InputError(f"{path}: no room left to write it ({error.strerror}); free some or choose another disk.")
    return InputError(f"{path}: cannot be written ({error.strerror}); check the permissions of its folder.")


def open_resumable_folder(folder: Path, name: str, settings: dict[str, Any], made: str) -> None:
    """Make `folder` and note `settings` in its file `name`, or check that the same are noted there.

    Args:
        folder: Its parent must exist.
        name: Of the JSON file.
        settings: What JSON can hold.
        made: What the folder holds, as its owner calls it.

    Raises:
        InputError: something that is no folder stands there, the parent is missing, or the settings are others.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: expected a folder to write to, found a file; choose another name.")
    if not folder.parent.is_dir():
        raise InputError(f"{folder}: expected the folder {folder.parent} to write to, found none; make it first.")
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror}); check the permissions.") from error
    file = folder / name
    text = json.dumps(settings, indent=1, sort_keys=True) + "\n"
    if not file.exists():
        write_file(file, text.encode())
    elif (noted := file.read_text()) != text:
        raise InputError(
            f"{folder}: holds {made} made with other settings{_first_difference(noted, settings)} (see {name}); "
            "choose another folder."
        )


def _first_difference(noted: str, settings: dict[str, Any]) -> str:
    try:
        before = json.loads(noted)
    except json.JSONDecodeError:
        return ""
    for key in sorted(before.keys() | settings.keys()):
        old, new = before.get(key), settings.get(key)
        if old != new:
            return f", {key} {json.dumps(old)} and not {json.dumps(new)}"
    return ""
