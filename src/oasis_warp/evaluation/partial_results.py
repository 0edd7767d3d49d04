"""Results of one person, hand or photo, kept so that an evaluation that was stopped goes on with the others."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from oasis_warp.core.errors import InputError
from oasis_warp.core.logging import logger
from oasis_warp.data.photo import read_photo


def read_result(file: Path, keys: Sequence[str], pictures: Sequence[Path] = ()) -> Any:
    """What an earlier run has kept; None where it has not, or where the disk has damaged it, which is logged.

    Args:
        file: JSON: an object with the `keys`, or one that only says why it was "left_out", or a list of such objects.
        keys: See above.
        pictures: Drawn with the result; one that cannot be read is damage, too.
    """
    try:
        value = json.loads(file.read_bytes())
        records = value if isinstance(value, list) else [value]
        if not records or not all(_is_whole(record, keys) for record in records):
            raise ValueError("not an evaluation's")
        for picture in pictures if "left_out" not in value or "left_out" in keys else ():
            read_photo(picture)
    except FileNotFoundError:
        return None
    except (ValueError, RecursionError, InputError):
        logger.warning("%s: is damaged, so this part is measured again.", file)
        return None
    return value


def _is_whole(record: object, keys: Sequence[str]) -> bool:
    return isinstance(record, dict) and (record.keys() >= set(keys) or record.keys() == {"left_out"})
