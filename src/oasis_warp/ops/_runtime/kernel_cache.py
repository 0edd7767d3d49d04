"""The folder of compiled kernels: damaged ones are built anew, and if it cannot be written, another folder is used."""

import hashlib
import os
import shutil
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import warp as wp

DIGESTS = "sha256"
"""File beside the compiled files of a module: their digests."""
ABANDONED = 3600.0
"""Age after which no process is still building a kernel [s]."""


def kernel_cache() -> Path:
    """Folder that holds the compiled kernels: $OASIS_WARP_CACHE, else $XDG_CACHE_HOME/oasis_warp, else ~/.cache/..."""
    explicit = os.environ.get("OASIS_WARP_CACHE")
    if explicit:
        return Path(explicit)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "oasis_warp"


def writable_cache() -> Path:
    """`kernel_cache`, or where it cannot be written, with a warning, a folder that goes with the process."""
    try:
        cache = kernel_cache()
        cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=cache):
            remove_abandoned(cache)
            return cache
    except (OSError, RuntimeError) as error:  # RuntimeError: no home
        return _temporary_cache(str(error))


def remove_abandoned(cache: Path) -> None:
    """Remove what builds have left that were killed: folders named after a process and a thread, an hour old.

    Warp's kernels are in a folder for each version of it. A clock that jumps ahead makes all folders old: those of
    processes that live stay.
    """
    for folder in (*cache.glob("*_p*_t*"), *cache.glob("*/wp_*_p*_t*")):
        process = folder.name.rpartition("_t")[0].rpartition("_p")[2]
        try:
            if time.time() - folder.stat().st_mtime > ABANDONED and not Path("/proc", process).is_dir():
                shutil.rmtree(folder, ignore_errors=True)
        except OSError:
            pass  # its own process has just renamed it


_temporary: list[tempfile.TemporaryDirectory[str]] = []


def _temporary_cache(why: str) -> Path:
    _temporary.append(tempfile.TemporaryDirectory(prefix="oasis_warp_kernels_"))
    warnings.warn(
        f"the kernel cache cannot be used ({why}); every run compiles kernels again, into {_temporary[-1].name}. "
        "Set OASIS_WARP_CACHE to a folder that can be written.",
        RuntimeWarning,
        stacklevel=2,
    )
    return Path(_temporary[-1].name)


def load_module(module: Any, device: Any, block_dim: int) -> None:
    """Load a Warp module, compiled or from the cache; it is built once more if its files are not as they were written.

    A flipped bit of a compiled kernel may draw something else without a word, so the files' digests are checked, too. A
    module without them, of a run that was killed, is taken if it loads.
    """
    folder = Path(wp.config.kernel_cache_dir) / module.get_module_identifier(block_dim)
    if is_damaged(folder):
        shutil.rmtree(folder, ignore_errors=True)
    try:
        _load(module, device, block_dim)
    except Exception:
        shutil.rmtree(folder, ignore_errors=True)
        try:
            _load(module, device, block_dim)
        except OSError as error:  # a full disk
            wp.config.kernel_cache_dir = str(_temporary_cache(str(error)))
            _load(module, device, block_dim)
    write_digests(Path(wp.config.kernel_cache_dir) / folder.name)


def _load(module: Any, device: Any, block_dim: int) -> None:
    module.failed_builds.clear()
    if module.load(device, block_dim) is None:
        raise RuntimeError(f"the kernel {module.name} does not compile")


def _digests(folder: Path) -> list[str]:
    """A line for each of a module's files: digest and name."""
    files = sorted(path for path in folder.iterdir() if not path.name.startswith(DIGESTS))
    return [f"{hashlib.sha256(path.read_bytes()).hexdigest()} {path.name}" for path in files]


def is_damaged(folder: Path) -> bool:
    """Whether a file of a module has changed since its digest was written; other processors may have added files."""
    try:
        written = (folder / DIGESTS).read_text(errors="replace").splitlines()
        return not set(written) <= set(_digests(folder))
    except OSError:
        return False


def write_digests(folder: Path) -> None:
    """Write the digests of a module's files, if they are not there yet and the folder can be written."""
    try:
        text = "".join(f"{line}\n" for line in _digests(folder))
        if not (folder / DIGESTS).is_file() or (folder / DIGESTS).read_text() != text:
            beside = folder / f"{DIGESTS}.{os.getpid()}"
            beside.write_text(text)
            beside.replace(folder / DIGESTS)
    except OSError:
        pass  # the kernel is loaded; the next run goes without the check
