"""Sum rows that belong to the same item: the transpose of a gather, without atomics.

One thread an item. An item adds its rows in the order of its list, so the bits never change.
"""

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def sum_rows(
    first: int,
    rows: wp.array2d[Any],
    offsets: wp.array[wp.int32],
    entries: wp.array[wp.int32],
    out: wp.array2d[Any],
):
    """out[i] = sum of rows[entries[j]] for offsets[i] <= j < offsets[i + 1]; in float64."""
    i = first + wp.tid()
    begin = offsets[i]
    end = offsets[i + 1]
    for column in range(out.shape[1]):
        total = wp.float64(0.0)
        for j in range(begin, end):
            total += wp.float64(rows[entries[j], column])
        out[i, column] = out.dtype(total)


for real in (wp.float32, wp.float64):
    wp.overload(sum_rows, {"rows": wp.array2d[real], "out": wp.array2d[real]})
