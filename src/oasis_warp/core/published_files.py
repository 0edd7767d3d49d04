"""Weights that others publish: where they come from, whether they came whole, and their download if allowed."""

import hashlib
import http.client
import re
import shutil
import sys
import urllib.error
import urllib.request
from pathlib import Path
from typing import NamedTuple

from oasis_warp.core.errors import InputError

PATIENCE = 60.0
"""Seconds without an answer after which a download ends."""
_DIGEST_IN_NAME = re.compile(r"-([0-9a-f]{8,64})\.(?:pth|pt|safetensors)$")
"""First digits of the SHA-256, as PyTorch puts them into the names of its files."""


class Published(NamedTuple):
    """A file of others."""

    what: str
    url: str
    megabytes: int
    """About; said before a download."""


_HUB, _TORCH = "https://huggingface.co/facebook", "https://download.pytorch.org/models"
_LINES = "https://raw.githubusercontent.com/richzhang/PerceptualSimilarity/master/lpips/weights/v0.1"
PUBLISHED = {
    "dinov2-small": Published("DINOv2 ViT-S/14", f"{_HUB}/dinov2-small/resolve/main/model.safetensors", 88),
    "dinov2-base": Published("DINOv2 ViT-B/14", f"{_HUB}/dinov2-base/resolve/main/model.safetensors", 346),
    "dinov2-large": Published("DINOv2 ViT-L/14", f"{_HUB}/dinov2-large/resolve/main/model.safetensors", 1218),
    "alex": Published("AlexNet", f"{_TORCH}/alexnet-owt-7be5be79.pth", 244),
    "vgg": Published("VGG-16", f"{_TORCH}/vgg16-397923af.pth", 553),
    "alex-lines": Published("LPIPS's layers for AlexNet", f"{_LINES}/alex.pth", 1),
    "vgg-lines": Published("LPIPS's layers for VGG-16", f"{_LINES}/vgg.pth", 1),
}


def published_file(path: Path, name: str, *, allow_download: bool = False) -> Path:
    """`path`, where the published file of that name lies whole.

    Its SHA-256 is compared with the digits in the file's own name, and with PATH.sha256 beside it where there is one
    (as `sha256sum` writes it).

    Args:
        path: Where it is, or where a download shall put it.
        name: A key of `PUBLISHED`.
        allow_download: Whether a missing file may be downloaded; what and how much is said on stderr first.

    Raises:
        InputError: it is missing, cannot be downloaded, or has another SHA-256.
    """
    known = PUBLISHED[name]
    if not path.exists():
        if not allow_download:
            raise InputError(
                f"{path}: expected {known.what}, found no such file; download {known.url} ({known.megabytes} MB) to "
                "this name, or add --allow-download."
            )
        _download(known, path)
    elif not path.is_file():
        raise InputError(f"{path}: expected {known.what}, found a folder; name the file in it.")
    check_digest(path)
    return path


def check_digest(path: Path) -> None:
    """Compare a file's SHA-256 with what its name or PATH.sha256 says; nothing where neither does.

    Raises:
        InputError: it is another.
    """
    said = _DIGEST_IN_NAME.search(path.name)
    expected = [said[1]] if said else []
    beside = path.with_name(path.name + ".sha256")
    if beside.is_file():
        expected += beside.read_text(errors="replace").split()[:1]
    if not expected:
        return
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    for prefix in expected:
        if not digest.startswith(prefix.lower()):
            raise InputError(
                f"{path}: expected a SHA-256 that begins with {prefix[:16]}, got {digest[:16]}; the file is cut short "
                "or another one, download it again."
            )


def _download(known: Published, path: Path) -> None:
    """Write the file under another name first, so that a cut download leaves nothing behind."""
    part = path.with_name(path.name + ".part")
    print(f"oasis: downloading {known.what}, {known.megabytes} MB: {known.url}", file=sys.stderr, flush=True)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with urllib.request.urlopen(known.url, timeout=PATIENCE) as answer, part.open("wb") as file:
            expected = answer.headers.get("Content-Length")
            shutil.copyfileobj(answer, file, 1 << 20)
        if expected is not None and part.stat().st_size != int(expected):
            raise InputError(f"{known.url}: the download ended too early; run the same command again.")
        part.replace(path)
    except (OSError, ValueError, urllib.error.URLError, http.client.HTTPException) as error:
        if isinstance(error, InputError):
            raise
        reason = getattr(error, "reason", None) or error
        raise InputError(f"{known.url}: cannot be downloaded ({reason}); copy it to {path} by hand.") from error
    finally:
        part.unlink(missing_ok=True)
