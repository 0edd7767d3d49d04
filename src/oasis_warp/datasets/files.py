"""The files of a data set: a folder, and what lies in tar files of it, which are read in place and never unpacked."""

import contextlib
import os
import re
import tarfile
from pathlib import Path
from typing import NamedTuple

from oasis_warp.core.errors import InputError, shortened
from oasis_warp.core.types import Photo
from oasis_warp.data.photo import read_photo

MAX_BYTES = 1 << 28
"""Of a file in a tar file; annotations of a whole data set are larger, and lie beside it."""
_BLOCK = 512
"""Of a tar file [bytes]."""
_UNSAFE = re.compile(r"(^|/)\.\.(/|$)|^/|\\|\0|^[A-Za-z]:")
"""Names that leave the folder they are relative to, here or on another system."""


class File(NamedTuple):
    """A file, or the part of a tar file that holds it."""

    path: Path
    start: int = 0
    """Of the part [bytes]."""
    size: int | None = None
    """Of the part [bytes]; None for the whole file."""

    @property
    def exists(self) -> bool:
        """Whether there is such a file."""
        return self.size is not None or self.path.is_file()

    def read(self) -> bytes:
        """Its bytes.

        Raises:
            InputError: it cannot be read, or is shorter than it was.
        """
        if self.path.exists() and not self.path.is_file():
            raise InputError(f"{self.path}: cannot be read (a folder, a device or a pipe); give a file.")
        try:
            if self.size is None:
                return self.path.read_bytes()
            with self.path.open("rb") as stream:
                stream.seek(self.start)
                content = stream.read(self.size)
        except OSError as error:
            raise InputError(
                f"{self.path}: cannot be read ({error.strerror}); give the folder that holds it."
            ) from error
        if len(content) < self.size:
            raise InputError(f"{self.path}: is shorter than when it was opened; copy it again.")
        return content

    def photo(self, name: str) -> Photo:
        """The photo in it; `name` is for messages.

        Raises:
            InputError: as `data.photo.read_photo`.
        """
        return read_photo(self.path) if self.size is None else read_photo(name, content=self.read())


class Tree:
    """Files by their names relative to a folder, with slashes; *.tar files directly in it count as unpacked there."""

    def __init__(self, root: Path):
        """Read the tables of contents.

        Raises:
            InputError: a tar file is none, or a compressed one.
        """
        self.root = root
        self.left_out: dict[str, str] = {}
        """Files of tar files that are not read, and why."""
        self._packed: dict[str, File] = {}
        for archive in sorted(root.glob("*.tar")):
            self._open(archive)

    def file(self, name: str) -> File:
        """The file of that name; it need not exist.

        Raises:
            InputError: the name leads out of the folder.
        """
        if _UNSAFE.search(name):
            raise InputError(f"{shortened(name)}: a name that leads out of the folder; name a file in it.")
        return self._packed.get(name) or File(self.root / name)

    def names(self, folder: str = "") -> list[str]:
        """All names below a folder."""
        found = [
            Path(place, file).relative_to(self.root).as_posix()
            for place, _, files in os.walk(self.root / folder) for file in files
        ]  # fmt: skip
        prefix = f"{folder}/" if folder else ""
        return sorted({*found, *(name for name in self._packed if name.startswith(prefix))})

    def _open(self, archive: Path) -> None:
        try:
            total = archive.stat().st_size
            with tarfile.open(archive, "r:") as contents:
                with contextlib.suppress(tarfile.ReadError):  # the last file is cut short, which `_add` has seen
                    for member in contents:
                        self._add(archive, member, total)
                end = contents.offset
            with archive.open("rb") as stream:
                stream.seek(end)
                rest = stream.read(_BLOCK)
        except (tarfile.TarError, OSError, ValueError, OverflowError, EOFError) as error:
            reason = shortened(str(error).rstrip("."))
            raise InputError(
                f"{archive}: expected a tar file that is not compressed ({reason}); unpack it, or pack it again."
            ) from error
        if rest.strip(b"\0"):  # tarfile takes any damage for the end
            self.left_out[archive.name] = f"{archive.name}: is damaged after {end} bytes; what follows is not read."

    def _add(self, archive: Path, member: tarfile.TarInfo, total: int) -> None:
        if member.isdir():
            return
        name, what = member.name.removeprefix("./"), None
        if not member.isreg() or member.issparse():
            what = "is a link, a device or a file with holes"
        elif _UNSAFE.search(name):
            what = "leads out of the folder"
        elif member.size > MAX_BYTES:
            what = f"has more than {MAX_BYTES >> 20} MB"
        elif member.offset_data + member.size > total:
            what = "is cut short"
        elif name in self._packed:
            what = "is there twice"
        if what is None:
            self._packed[name] = File(archive, member.offset_data, member.size)
        else:
            self.left_out[f"{archive.name}: {shortened(name)}"] = f"{archive.name}: {shortened(name)} {what}."
