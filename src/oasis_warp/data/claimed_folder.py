"""Folders that work goes on in: a JSON file says with which settings it began, and others are refused."""

import json
from pathlib import Path
from typing import Any

from oasis_warp.core.errors import InputError
from oasis_warp.data.atomic import write_file


def claim_folder(folder: Path, name: str, settings: dict[str, Any], made: str) -> None:
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
