"""The depth buffer on the CPU in vectors: `depth_buffer.cpp` and `visibility.cpp`, in float32 and in float64."""

import ctypes
import functools
import re
from typing import Any, NamedTuple

import warp as wp

from oasis_kernels.runtime.native import cpu_options
from oasis_kernels.runtime.source import defined, header_source, kernel_source

VERTICES_A_TASK = 16384
POINTS_A_TASK = 2048
QUADS_A_TASK = 8
"""Rows of blocks that `write` takes at a time."""
SPARE_COLUMNS = 4
"""Columns of a buffer past the picture's last, for blocks that reach beyond it."""
CONSTANTS = {
    "VERTICES_A_TASK": VERTICES_A_TASK,
    "POINTS_A_TASK": POINTS_A_TASK,
    "QUADS_A_TASK": QUADS_A_TASK,
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
        return wp.func_native(defined({"SCALAR": dtype, **CONSTANTS}, kernel_source(file, stage).body))(stub)

    transform_natively, draw_natively, write_natively = (
        native(f"depth/{file}.cpp", stage)
        for file, stage in (("depth_buffer", "transform"), ("depth_buffer", "draw"), ("depth_write", "write"))
    )
    score_natively, pull_natively = (native("depth/visibility.cpp", stage) for stage in ("score", "pull"))

    def transform(address: wp.uint64):
        transform_natively(address)

    def draw(address: wp.uint64):
        draw_natively(address)

    def write(address: wp.uint64):
        write_natively(address)

    def score(address: wp.uint64):
        score_natively(address)

    def pull(address: wp.uint64):
        pull_natively(address)

    def transform_draw_write_score(address: wp.uint64):
        transform_natively(address)
        draw_natively(address)
        write_natively(address)
        score_natively(address)

    functions = (transform, draw, write, score, pull, transform_draw_write_score)
    return Kernels(*(wp.Kernel(function, module=module) for function in functions))
