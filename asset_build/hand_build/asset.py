"""Write arrays to an .npz file that is the same, byte for byte, each time."""

import hashlib
import io
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

EPOCH = (1980, 1, 1, 0, 0, 0)
"""The earliest time that a zip file can name; `numpy.savez` would write the time of the build."""


def write_npz(path: Path, arrays: Mapping[str, np.ndarray]) -> str:
    """Write `arrays` compressed to `path`, by rename, and return the file's SHA-256."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for name, array in arrays.items():
            member = io.BytesIO()
            np.lib.format.write_array(member, np.asarray(array, order="C"), allow_pickle=False)
            info = zipfile.ZipInfo(name + ".npy", EPOCH)
            info.compress_type = zipfile.ZIP_DEFLATED
            info.external_attr = 0o644 << 16
            archive.writestr(info, member.getvalue())
    partial = path.with_name(path.name + ".partial")
    partial.write_bytes(buffer.getvalue())
    os.replace(partial, path)
    return hashlib.sha256(buffer.getvalue()).hexdigest()
