"""Weights published by others: addresses, checks of their digests, and their download if allowed."""

import hashlib
import http.client
import shutil
import sys
import urllib.error
import urllib.request
from pathlib import Path
from typing import NamedTuple

from oasis_warp.core.errors import InputError

PATIENCE = 60.0
"""Seconds without an answer after which a download ends."""


class Published(NamedTuple):
    """A file of others."""

    what: str
    url: str
    megabytes: int
    """About; said before a download."""
    sha256: str
    """Digest of the whole file."""


_HUB, _TORCH = "https://huggingface.co/facebook", "https://download.pytorch.org/models"
_LINES = "https://raw.githubusercontent.com/richzhang/PerceptualSimilarity/master/lpips/weights/v0.1"
PUBLISHED = {
    "dinov2-small": Published(
        "DINOv2 ViT-S/14", f"{_HUB}/dinov2-small/resolve/main/model.safetensors", 88,
        "ae1e99fcefd534ed978cdeb8326f08030c96e28b7a81ffcbc98a857c84d14be1",
    ),
    "dinov2-base": Published(
        "DINOv2 ViT-B/14", f"{_HUB}/dinov2-base/resolve/main/model.safetensors", 346,
        "d73036b56966966d07975d696bde331762f37297e2f095de8cea0040c3aa0841",
    ),
    "dinov2-large": Published(
        "DINOv2 ViT-L/14", f"{_HUB}/dinov2-large/resolve/main/model.safetensors", 1218,
        "399fba97a95f22c36834418bc69373364a99af3a1153da1c0fb31db567c92e23",
    ),
    "alex": Published(
        "AlexNet", f"{_TORCH}/alexnet-owt-7be5be79.pth", 244,
        "7be5be791159472b1fbf3c69796f7cb30dca7ad8466c2df70058c37116cdee02",
    ),
    "vgg": Published(
        "VGG-16", f"{_TORCH}/vgg16-397923af.pth", 553,
        "397923af8e79cdbb6a7127f12361acd7a2f83e06b05044ddf496e83de57a5bf0",
    ),
    "alex-lines": Published(
        "LPIPS's layers for AlexNet", f"{_LINES}/alex.pth", 1,
        "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0",
    ),
    "vgg-lines": Published(
        "LPIPS's layers for VGG-16", f"{_LINES}/vgg.pth", 1,
        "a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868",
    ),
}  # fmt: skip


def published_file(path: Path, name: str, *, allow_download: bool = False) -> Path:
    """`path`, after checking that the published file of that name is complete there.

    Its SHA-256 must be the published one, or that in PATH.sha256 where there is such a file, as `sha256sum` writes it.

    Args:
        path: Where it is, or where a download shall put it.
        name: A key of `PUBLISHED`.
        allow_download: Whether a missing file may be downloaded; what and how much is said on stderr first.

    Raises:
        InputError: it is missing, cannot be downloaded, or has another SHA-256.
    """
    known, there = PUBLISHED[name], path.exists()
    if not there:
        if not allow_download:
            raise InputError(
                f"{path}: expected {known.what}, found no such file; download {known.url} ({known.megabytes} MB) to "
                "this name, or add --allow-download."
            )
        _download(known, path)
    elif not path.is_file():
        raise InputError(f"{path}: expected {known.what}, found a folder; name the file in it.")
    try:
        check_digest(path, known)
    except InputError:
        if not there:
            path.unlink()
        raise
    return path


def check_digest(path: Path, known: Published) -> None:
    """Compare a file's SHA-256 with what PATH.sha256 says, else with the published one.

    Raises:
        InputError: it is another.
    """
    beside = path.with_name(path.name + ".sha256")
    recorded = beside.read_text(errors="replace").split()[:1] if beside.is_file() else []
    expected = recorded[0].lower() if recorded else known.sha256
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if digest != expected:
        raise InputError(
            f"{path}: expected {known.what} with the SHA-256 {expected[:16]}..., got {digest[:16]}...; it is cut short "
            f"or another file: download it again, or put its SHA-256 into {beside.name} if you trust it."
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
