"""The optional C++ node of pictures on CUDA, `picture_node.cpp`: built when asked for, loaded where it is built.

It draws the bits of the node in Python, which does the same without it, in less time on the host.
"""

import ctypes
import functools
import hashlib
import importlib.util
import os
import shutil
import sysconfig
import tempfile
import threading
import warnings
from pathlib import Path
from typing import Any

import torch
import warp as wp

from oasis_warp.ops._runtime.kernel_cache import is_damaged, kernel_cache, remove_abandoned, write_digests
from oasis_warp.ops._runtime.picture_preparation import Preparation

VARIABLE = "OASIS_WARP_EXTENSION"
"""Environment variable: 0 leaves the node aside, 1 builds it before its first use where it is not built."""
NAME = "oasis_warp_picture_node"
SOURCES = [Path(__file__).with_name(name) for name in ("picture_node.cpp", "picture_table.h")]
IN_ORDER = "project", "count", "place", "fill", "sort", "blend"
"""Kernels of a picture, as the node launches them."""
_lock = threading.Lock()


class NotBuiltError(RuntimeError):
    """The node could not be built: a sentence says why."""


def extension_folder() -> Path:
    """Where the node is kept for this source, torch and Python."""
    text = [source.read_text() for source in SOURCES]
    parts = text, torch.__version__, sysconfig.get_config_var("SOABI"), sysconfig.get_platform()
    return kernel_cache() / f"extension_{hashlib.sha256(repr(parts).encode()).hexdigest()[:16]}"


def is_built() -> bool:
    """Whether the node is there as it was built."""
    folder = extension_folder()
    return any(folder.glob("*.so")) and not is_damaged(folder)


def build() -> Path:
    """Compile the node with torch's own loader, in half a minute; the folder that holds it.

    Raises:
        NotBuiltError: there is no compiler, or it fails.
    """
    target = extension_folder()
    try:
        from torch.utils import cpp_extension

        target.parent.mkdir(parents=True, exist_ok=True)
        remove_abandoned(target.parent)
        # Named after process and thread, as kernels under construction are, so that one that is killed is removed
        # later; not wp_..., which Warp takes for a kernel of an earlier version. A process of its own builds in a
        # folder of its own: torch's lock would outlive a killed build.
        prefix = f"{target.name}_p{os.getpid()}_t"
        with tempfile.TemporaryDirectory(prefix=prefix, dir=target.parent) as place:
            # Loaded as a library only, because Python would bind its types to this path.
            cpp_extension.load(
                NAME, [str(SOURCES[0])], extra_cflags=["-O2"], build_directory=place, is_python_module=False
            )  # fmt: skip
            made = Path(place, "made")
            made.mkdir()
            for library in Path(place).glob("*.so"):
                shutil.copy(library, made)
            write_digests(made)
            shutil.rmtree(target, ignore_errors=True)
            made.rename(target)
    except (ImportError, OSError, RuntimeError, SystemExit) as error:
        if not is_built():  # else another process was faster
            raise NotBuiltError(_reason(error)) from error
    return target


def _reason(error: BaseException) -> str:
    """The line of an error of torch's loader that says what is wrong."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()] or [type(error).__name__]
    return next((line for line in lines if "error:" in line), lines[0])


def loaded() -> Any | None:
    """The node's module; None where it is not built, or shall not be used.

    Raises:
        ValueError: `OASIS_WARP_EXTENSION` is neither 0 nor 1.
    """
    with _lock:
        return _load()


@functools.cache
def _load() -> Any | None:
    wanted = os.environ.get(VARIABLE, "")
    if wanted not in ("", "0", "1"):
        raise ValueError(f"{VARIABLE}: expected 0, 1 or nothing, got {wanted!r}. 1 builds the C++ node, 0 avoids it.")
    try:
        if wanted == "0" or not (is_built() or wanted):
            return None
        if not is_built():
            build()
        path = next(extension_folder().glob("*.so"))  # torch numbers the names of several builds in one process
        spec = importlib.util.spec_from_file_location(path.stem, path)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module
    except (NotBuiltError, ImportError, OSError) as error:
        warnings.warn(
            f"The C++ node for rasterization cannot be used ({_reason(error)}); the Python node gives the same result.",
            RuntimeWarning, stacklevel=2,
        )  # fmt: skip
        return None


def table_of(plan: Preparation, report: int) -> Any | None:
    """The table of a plan; None where Python's node draws: without the C++ one, and with depths or padded channels.

    Args:
        plan: Plan of the calls.
        report: Address of three words of host memory that kernels write to: pairs, longest list, bad values.
    """
    extension = loaded() if plan.as_given else None
    if extension is None:
        return None
    core = wp._src.context.runtime.core
    table = extension.Table()
    table.launcher, table.error = map(_address, (core.wp_cuda_launch_kernel, core.wp_get_error_string))
    parameters, launches = _parameters(extension, plan, report), plan.launches()
    described = {name: extension.Launch(*launch.described(n, parameters)) for name, (launch, n) in launches.items()}
    table.forward, table.unproject = [described[name] for name in IN_ORDER], described["unproject"]
    table.report, table.numels = report, plan.numels
    for name, value in plan.sizes().items():
        setattr(table, name, value)
    return table


def add_adjoints(plan: Preparation, table: Any, with_shape: bool, with_colors: bool) -> None:
    """Tell a table the kernels of an adjoint with these gradients: the node leaves its first one to Python."""
    extension = loaded()
    assert extension is not None
    parameters = _parameters(extension, plan, table.report)
    record, launches = plan.described_adjoints(with_shape, with_colors)
    described = [extension.Launch(*launch.described(n, parameters)) for launch, n in launches]
    table.set_backward(with_shape, with_colors, record, described)


def _parameters(extension: Any, plan: Preparation, report: int) -> dict[str, Any]:
    return plan.parameters({name: place for place, name in enumerate(extension.SLOTS.split(", "))}, report)


def _address(function: Any) -> int:
    return ctypes.cast(function, ctypes.c_void_p).value or 0
