"""Write files and folders atomically: a hidden sibling is written, then renamed.

A rename inside one folder is atomic on all common file systems, so a full disk, Ctrl-C or a crash never leaves half an
output. Folders of long work instead note the settings with which it started, so that it can be resumed.
"""

import contextlib
import errno
import json
import os
import secrets
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from oasis_warp.core.errors import InputError

_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_DISK = (*_NO_ROOM, errno.EIO, errno.EROFS)


@contextlib.contextmanager
def output_file(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path for the file `path`: moved there when the block ends, removed when it fails.

    The temporary file is a sibling of `path` with the same suffix. An existing file is replaced, also through a link.

    Raises:
        InputError: the folder is missing or not writable, `path` exists and is no file, or the disk is full.
    """
    final = Path(os.path.realpath(path))
    if final.is_dir():
        raise InputError(f"{path}: expected a file to write, found a folder; add a file name.")
    if final.exists() and not final.is_file():
        raise InputError(f"{path}: expected a file to write, found a device or pipe; give a file name.")
    _check_parent(path, final.parent)
    part = final.with_name(f".{final.stem}.{secrets.token_hex(4)}{final.suffix}")
    try:
        part.touch(exist_ok=False)  # fails now and not after minutes of work
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
    folder. The files are then moved one by one, in the order of their names.

    Raises:
        InputError: the parent is missing or not writable, `path` is a file, or the disk is full.
    """
    final = Path(os.path.realpath(path))
    _check_folder(path, final)
    # The temporary folder lies inside an existing folder, which may be the only writable place.
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
    except InputError as error:  # from a writer inside, which only knows the temporary path
        raise InputError(str(error).replace(str(part), str(path))) from error
    except OSError as error:
        if _is_about(part, error):
            raise _explain(path, error) from error
        raise
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _check_folder(path: Path | str, final: Path) -> None:
    if final.exists() and not final.is_dir():
        raise InputError(f"{path}: expected a folder to write to, found a file; choose another name.")
    _check_parent(path, final.parent)


def _check_parent(path: Path | str, parent: Path) -> None:
    if not parent.is_dir():
        found = "a file" if parent.exists() else "no such folder"
        raise InputError(f"{path}: expected the folder {parent} to write to, found {found}; make it first.")


def _flush(file: Path) -> None:
    """Flush `file` to the disk: a full disk may only be reported now."""
    with file.open("rb+") as stream:
        os.fsync(stream.fileno())


def _is_about(part: Path, error: OSError) -> bool:
    """Whether `error` comes from writing `part`, and not from something else in the block."""
    return error.errno in _DISK or (
        isinstance(error.filename, str | Path) and Path(error.filename).is_relative_to(part)
    )


def _explain(path: Path | str, error: OSError) -> InputError:
    if error.errno in _NO_ROOM:
        return InputError(f"{path}: no room left to write it ({error.strerror}); free some or choose another disk.")
    return InputError(f"{path}: cannot be written ({error.strerror}); check the permissions of its folder.")


def open_resumable_folder(folder: Path, name: str, settings: dict[str, Any], content: str) -> None:
    """Create `folder` and write `settings` to its file `name`, or check that the same settings stand there.

    Args:
        folder: Folder whose parent exists.
        name: Name of the JSON file.
        settings: Settings as JSON values.
        content: What the folder holds, for messages.

    Raises:
        InputError: `folder` is a file, its parent is missing, or it holds other settings.
    """
    _check_folder(folder, folder)
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
            f"{folder}: holds {content} made with other settings{_first_difference(noted, settings)} (see {name}); "
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
