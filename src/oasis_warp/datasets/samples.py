"""Samples, as every data set is read into, those that were left out and why, and the files they come from.

Files lie in a folder or in tar files of it, which are read in place and never unpacked.
"""

import contextlib
import json
import os
import re
import tarfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.core.errors import InputError, shortened
from oasis_warp.core.mirror import mirror_camera
from oasis_warp.core.types import Camera, Photo, Side
from oasis_warp.data.photo import read_photo
from oasis_warp.data.square_crop import resample_square
from oasis_warp.hand.mano import ManoModel, ManoPose, mano_surface, mirror_mano_pose

MAX_BYTES = 1 << 28
"""Largest file in a tar file; annotations of a whole data set are larger, and lie beside it."""
_BLOCK = 512
"""Size of a block of a tar file [bytes]."""
_UNSAFE = re.compile(r"(^|/)\.\.(/|$)|^/|\\|\0|^[A-Za-z]:")
"""Names that leave the folder they are relative to, here or on another system."""
MARGIN = 1.3
"""Side of the crop over the longer side of the box; the paper's."""
MIN_BOX, MAX_BOX, FARTHEST = 8.0, 1e5, 100.0
"""Smallest and largest box [px] and most distant hand [m] that are taken."""
Models = dict[Side, ManoModel]


class File(NamedTuple):
    """A file, or the part of a tar file that holds it."""

    path: Path
    start: int = 0
    """Start of the part [bytes]."""
    size: int | None = None
    """Length of the part [bytes]; None for the whole file."""

    @property
    def exists(self) -> bool:
        """Whether there is such a file."""
        return self.size is not None or os.path.isfile(self.path)  # which no name is too long for

    def read(self) -> bytes:
        """Its bytes.

        Raises:
            InputError: it cannot be read, or is shorter than it was.
        """
        if os.path.exists(self.path) and not os.path.isfile(self.path):
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


class Sample(NamedTuple):
    """One hand of one photo."""

    name: str
    """Path of the photo below the data set's root, and the side."""
    image: File
    mask: File | None
    """White where the hand is."""
    side: Side
    subject: str
    """Samples of one subject show the same person."""
    viewmat: np.ndarray
    """World to camera [m], [4, 4]."""
    K: np.ndarray
    """[px], [3, 3]."""
    mano: ManoPose
    """Pose of the model of its side, in the world; the mean pose included."""
    box: np.ndarray | None
    """Left, top, width, height of the annotated box [px]; None where the surface's own is taken."""


class Picture(NamedTuple):
    """A square crop of a sample as a right hand; left ones are mirrored."""

    image: Float[Tensor, "S S 3"]
    mask: Float[Tensor, "S S"] | None
    camera: Camera
    mano: ManoPose


@dataclass
class Catalogue:
    """The samples of a data set."""

    samples: list[Sample] = field(default_factory=list)
    left_out: dict[str, str] = field(default_factory=dict)
    """By name, in words."""

    @contextmanager
    def reading(self, name: str) -> Iterator[None]:
        """Leave a sample out where reading it fails, and go on."""
        try:
            yield
        except InputError as error:
            self.left_out[name] = str(error)
        except KeyError as error:
            self.left_out[name] = f"{name}: the annotation {shortened(str(error))} is missing."
        except (ValueError, TypeError, IndexError, OverflowError, AttributeError) as error:
            self.left_out[name] = f"{name}: a damaged annotation ({shortened(str(error))})."

    def add(self, sample: Sample, models: Models) -> None:
        """Check and keep a sample.

        Raises:
            InputError: no photo, a camera or parameters that are none, or a hand that its camera does not see.
        """
        if not sample.image.exists:
            raise InputError(f"{sample.name}: the photo {sample.image.path.name} is missing.")
        if sample.mask is not None and not sample.mask.exists:
            raise InputError(f"{sample.name}: the mask {sample.mask.path.name} is missing.")
        if not (np.array_equal(sample.K[2], [0, 0, 1]) and sample.K[0, 0] > 0 and sample.K[1, 1] > 0):
            raise InputError(f"{sample.name}: its K is no camera's.")
        xy = projected(sample, models)[1]
        if sample.box is not None and (xy.max(0) < sample.box[:2]).any():
            raise InputError(f"{sample.name}: the hand lies outside its box.")
        self.samples.append(sample)


def numbers(value: Any, *shape: int, what: str) -> np.ndarray:
    """Finite numbers of a shape, float64; a size of -1 is any.

    Raises:
        ValueError: anything else.
    """
    try:
        array = np.asarray(value, np.float64)
    except (ValueError, TypeError):
        array = np.zeros(())
    sizes = zip(array.shape, shape, strict=False)
    if array.ndim != len(shape) or any(want not in (-1, got) for got, want in sizes):
        raise ValueError(f"{what}: expected {' x '.join(map(str, shape)) or 'one'} numbers")
    if not np.isfinite(array).all() or np.abs(array).max(initial=0) > 1e7:
        raise ValueError(f"{what}: expected finite numbers")
    return array


def pose_of_48(
    model: ManoModel, pose: Any, betas: Any, transl: Any, *, with_mean: bool
) -> ManoPose:
    """MANO's parameters from 48 angles, 10 shapes and a translation [m].

    Args:
        model: Model of the side.
        pose: Wrist and 15 joints, axis times angle [rad].
        betas: Shapes.
        transl: Translation.
        with_mean: Whether the angles hold the mean pose already; else it is added, as smplx does without
            flat_hand_mean.
    """
    angles = numbers(pose, 48, what="pose").reshape(16, 3)
    mean = 0 if with_mean else model.pose_mean
    return ManoPose(numbers(betas, 10, what="shape"), angles[0], angles[1:] + mean, numbers(transl, 3, what="trans"))


def projected(sample: Sample, models: Models) -> tuple[np.ndarray, np.ndarray]:
    """The model's vertices in the camera's frame [m], [V, 3], and in the photo [px], [V, 2].

    Raises:
        InputError: some lie behind the camera or too far away.
    """
    vertices = mano_surface(models[sample.side], sample.mano)[0] @ sample.viewmat[:3, :3].T + sample.viewmat[:3, 3]
    if vertices[:, 2].min() <= 0 or vertices[:, 2].max() > FARTHEST:
        raise InputError(f"{sample.name}: its camera does not see the hand; check units and axes.")
    seen = vertices @ sample.K.T
    return vertices, seen[:, :2] / seen[:, 2:]


def read_table(file: File) -> Any:
    """The value of a JSON file of annotations.

    Raises:
        InputError: missing or no JSON.
    """
    content = file.read()
    try:
        return json.loads(content)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{file.path}: expected JSON, got {shortened(str(error))}; download it again.") from error


def entry(table: Any, *keys: Any, what: str) -> Any:
    """A value of nested tables; whole numbers are looked up as JSON's texts too.

    Raises:
        KeyError: it is missing.
    """
    for key in keys:
        if isinstance(table, dict):
            key = key if key in table else str(key)
        try:
            table = table[key]
        except (KeyError, IndexError, TypeError):
            raise KeyError(f"{what} {key}") from None
    return table


def load_picture(sample: Sample, models: Models, size: int, margin: float = MARGIN) -> Picture:
    """The square around a sample's box, `margin` times as large, at `size` pixels.

    Raises:
        InputError: the photo or mask cannot be read, or the box is too small.
    """
    photo = sample.image.photo(sample.name)
    box = sample.box
    if box is None:
        xy = projected(sample, models)[1]
        box = np.concatenate([xy.min(0), np.ptp(xy, axis=0)])
    side = margin * float(max(box[2:]))
    if not MIN_BOX <= side <= MAX_BOX:
        raise InputError(f"{sample.name}: a box of {side:.0f} pixels is too {'small' if side < MIN_BOX else 'large'}.")
    left, top = (float(v) for v in box[:2] + box[2:] / 2 - side / 2)
    left, top, side = left * photo.shrink, top * photo.shrink, side * photo.shrink
    image = resample_square(photo.rgb.float() / 255, left, top, side, size).clamp(0, 1)
    mask = None
    if sample.mask is not None:
        white = sample.mask.photo(sample.name)
        if white.rgb.shape != photo.rgb.shape:
            raise InputError(f"{sample.name}: its mask has another size than the photo.")
        mask = resample_square((white.rgb[..., 0].float() / 255).contiguous(), left, top, side, size).clamp(0, 1)
    K = torch.from_numpy(sample.K.copy())
    K[:2] *= photo.shrink
    K[:2, 2] -= torch.tensor([left, top], dtype=K.dtype)
    K[:2] *= size / side
    camera = Camera(torch.from_numpy(sample.viewmat.copy()), K, size, size)
    if sample.side == "right":
        return Picture(image, mask, camera, sample.mano)
    mirrored = None if mask is None else mask.flip(1)
    return Picture(image.flip(1), mirrored, mirror_camera(camera), mirror_mano_pose(sample.mano))
