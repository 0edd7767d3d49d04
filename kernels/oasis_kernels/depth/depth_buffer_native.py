"""The depth buffer on the CPU in vectors: `depth_buffer.cpp` and `visibility.cpp`, in float32 and in float64."""

import ctypes
import functools
import re
from typing import Any, NamedTuple

import warp as wp

from oasis_kernels.runtime.native import cpu_options, defined, header_source, kernel_source

VERTICES_PER_TASK = 16384
POINTS_PER_TASK = 2048
QUADS_PER_TASK = 8
"""Rows of blocks that `write` takes at a time."""
SPARE_COLUMNS = 4
"""Columns of a buffer past the picture's last, for blocks that reach beyond it."""
CONSTANTS = {
    "VERTICES_PER_TASK": VERTICES_PER_TASK,
    "POINTS_PER_TASK": POINTS_PER_TASK,
    "QUADS_PER_TASK": QUADS_PER_TASK,
    "SPARE_COLUMNS": SPARE_COLUMNS,
}
C_TYPES = {"long long": ctypes.c_longlong, "int": ctypes.c_int, "double": ctypes.c_double}


def _job_fields() -> list[tuple[str, Any]]:
    """The fields of `struct Job` in `vectors.h`."""
    declared = header_source("depth/vectors.h").split("struct Job {")[1].split("};")[0]
    found = re.findall(r"^\s*(long long|int|double) (\w+);", declared, re.MULTILINE)
    return [(name, C_TYPES[kind]) for kind, name in found]


class Job(ctypes.Structure):
    """Arguments of all kernels, as `vectors.h` declares them."""

    _fields_ = _job_fields()


class Kernels(NamedTuple):
    """Kernels of one scalar type. Their one argument is the address of a `Job`."""

    transform: Any
    draw: Any
    write: Any
    score: Any
    pull: Any
    all: Any
    """`transform`, `draw`, `write` and `score`, one after the other, for a single thread."""


@functools.cache
def kernels(dtype: str) -> Kernels:
    """The kernels for inputs of C type "float" or "double"."""
    module = wp.get_module(f"{__name__}.{dtype}")
    wp.set_module_options(cpu_options(), module=module)

    def native(file: str, stage: str) -> Any:
        def stub(address: wp.uint64): ...

        stub.__name__ = stub.__qualname__ = f"{stage}_natively"
        text = defined({"SCALAR": dtype, **CONSTANTS}, kernel_source(f"depth/{file}.cpp", stage).body)
        return wp.func_native(text)(stub)

    def kernel(stage: str, run: Any) -> Any:
        def launch(address: wp.uint64):
            run(address)

        launch.__name__ = launch.__qualname__ = stage
        return wp.Kernel(launch, module=module)

    transform, draw = (native("depth_buffer", stage) for stage in ("transform", "draw"))
    write = native("depth_write", "write")
    score, pull = (native("visibility", stage) for stage in ("score", "pull"))

    def transform_draw_write_score(address: wp.uint64):
        transform(address)
        draw(address)
        write(address)
        score(address)

    stages = {"transform": transform, "draw": draw, "write": write, "score": score, "pull": pull}
    return Kernels(*(kernel(*stage) for stage in stages.items()), wp.Kernel(transform_draw_write_score, module=module))
