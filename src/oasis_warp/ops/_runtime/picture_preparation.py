"""What float32 pictures of one kind on CUDA need: sizes, places in a workspace, kernels and their parameters."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from oasis_kernels import constants
from oasis_kernels.constants import Rules
from oasis_kernels.rasterize import projection_native, tiles_cuda
from oasis_kernels.runtime.cuda_native import CudaNative
from oasis_warp.ops._runtime import blend_cuda
from oasis_warp.ops._runtime.blend_tiles import MAX_PAIRS
from oasis_warp.ops._runtime.launch import block_count, cuda_launch, current_stream
from oasis_warp.ops._runtime.pair_counts import Counts
from oasis_warp.ops._runtime.picture_call import Options, Scene
from oasis_warp.ops._runtime.plans import CudaLaunch, Slot, lay_out
from oasis_warp.ops._runtime.projection_backends import as_float32
from oasis_warp.ops._runtime.records import Frame
from oasis_warp.ops.checks import FINITE_LIMIT

FIRST_PAIRS = 4
"""Pairs a Gaussian that the first call of a kind has memory for."""


class Preparation:
    """Sizes, workspace and kernels of pictures of one kind, for one thread; `Scene` and `Options` have been checked."""

    def __init__(self, scene: Scene, options: Options, rules: Rules) -> None:
        self.n, self.n_cameras = n, n_cameras = len(scene.means), len(scene.viewmats)
        self.total, self.options = n * n_cameras, options
        self.device = scene.means.device
        self._index = scene.means.get_device()
        self._warp_device = current_stream(self.device).device
        self.n_colors = scene.colors.shape[-1]
        depths = {"RGB": 0, "D": 1, "ED": 2, "RGB+D": 1, "RGB+ED": 2}[options.render_mode]
        self.draws_colors, self.n_depths = options.render_mode.startswith("RGB"), depths
        self.n_drawn = self.n_colors * self.draws_colors + depths
        self.channels = next(c for c in constants.CHANNELS if c >= self.n_drawn)
        self.as_given = self.n_depths == 0 and self.channels == self.n_drawn
        frame = Frame(options.width, options.height, options.tile_size)
        self._layout = blend_cuda.layout_of(n_cameras, n, self.channels, frame)
        self._spread = tiles_cuda.spread_of(self._layout.n_tiles)
        self._limits = (
            as_float32(options.near_plane), as_float32(options.far_plane), float(options.radius_clip),
            as_float32(options.eps2d), as_float32(rules.alpha_min), float(rules.extent_sigmas), FINITE_LIMIT,
        )  # fmt: skip
        self._kind = self.device, n_cameras, n, options.width, options.height
        self.expected = Counts(min(FIRST_PAIRS * self.total, MAX_PAIRS), tiles_cuda.LONGEST)
        self._color_step = n if scene.colors.dim() == 3 else 0
        self.numels = [-1 if tensor is None else tensor.numel() for tensor in scene]
        self._lay_out()
        self._load(rules)
        self.table: Any = None
        """This plan as the C++ node reads it, if that is there and draws such pictures."""

    def _lay_out(self) -> None:
        """Places of the arrays in a workspace [bytes]; those that only an adjoint reads come last."""
        total, tiles, pixels = self.total, self._layout.n_tiles, self._layout.pixels
        counters = 8 * tiles_cuda.COUNTERS + 4 * tiles * self._spread
        self._n_counters = counters // 4
        always = {
            "centers": 16 * total, "whitenings": 16 * total, "boxes": 16 * total, "sort_depths": 8 * total,
            "counters": counters, "means2d": 8 * total, "covars2d": 24 * total, "depths": 4 * total,
            "conics": 12 * total, "radii": 8 * total, "tiles": 16 * tiles, "cursors": 4 * self._spread * tiles,
            "pair_starts": 4 * total,
        }  # fmt: skip
        segments = self._layout.segments - 1
        kept = {
            "transmittance": 4 * pixels, "stops": 4 * pixels,
            "checkpoints": 4 * tiles * segments * (self.channels + 1) * tiles_cuda.TILE**2,
        }  # fmt: skip
        self._at, self._size = lay_out(always)
        self._at_kept, self._size_with_kept = lay_out(kept, self._size)
        self._at |= self._at_kept

    def _load(self, rules: Rules) -> None:
        """Kernels, and how many blocks of them run."""
        tiles, total = self._layout.n_tiles, self.total
        self._project_blocks = block_count(total, projection_native.BLOCK)
        self._unproject_blocks = block_count(self.n, projection_native.BLOCK)
        self._count_blocks = block_count(total, tiles_cuda.COUNT_BLOCK)
        self._place_blocks = block_count(tiles, tiles_cuda.PLACE_BLOCK)
        self._gather_blocks = block_count(total, tiles_cuda.GATHER_BLOCK)
        self._project = self._launch(projection_native.cuda_project)
        self._count = self._launch(tiles_cuda.count_pairs())
        self._place = self._launch(tiles_cuda.place_tiles())
        self._fill = self._launch(tiles_cuda.fill_tiles())
        self._sort_long = self._launch(tiles_cuda.sort_long_lists())
        self._blend = self._launch(tiles_cuda.blend(self.channels, self._layout.segments, rules))
        self._rules = rules

    def _launch(self, native: CudaNative) -> CudaLaunch:
        """This thread's launch of a kernel, whose parameters come in the order of `picture_call.ORDERS`."""
        return cuda_launch(native, self._warp_device)

    def adjoints(self, with_shape: bool, with_colors: bool) -> tuple[int, CudaLaunch, CudaLaunch | None]:
        """Numbers of a pair's record, and this thread's launches of the kernels that write and gather records."""
        # Adjoints run on a thread of autograd, which has launches of its own.
        channels, segments = self.channels, self._layout.segments
        back = self._launch(tiles_cuda.blend_backward(channels, segments, with_shape, with_colors, self._rules))
        gathers = with_shape or with_colors
        gather = self._launch(tiles_cuda.gather(channels, with_shape, with_colors)) if gathers else None
        return tiles_cuda.record_size(channels, with_shape, with_colors), back, gather

    def launches(self) -> dict[str, tuple[CudaLaunch, int]]:
        """Kernels that every picture or its adjoint needs, and their blocks."""
        tiles = self._layout.n_tiles
        return {
            "project": (self._project, self._project_blocks), "count": (self._count, self._count_blocks),
            "place": (self._place, self._place_blocks), "fill": (self._fill, self._count_blocks),
            "sort": (self._sort_long, tiles), "blend": (self._blend, tiles),
            "unproject": (self._launch(projection_native.cuda_project_backward), self._unproject_blocks),
        }  # fmt: skip

    def described_adjoints(self, with_shape: bool, with_colors: bool) -> tuple[int, list[tuple[CudaLaunch, int]]]:
        """What `adjoints` returns, and their blocks."""
        record, back, gather = self.adjoints(with_shape, with_colors)
        gathers = [] if gather is None else [(gather, self._gather_blocks)]
        return record, [(back, self._layout.n_tiles), *gathers]

    def sizes(self) -> dict[str, int]:
        """Sizes of pictures, workspace and lists."""
        return {
            "n": self.n, "n_cameras": self.n_cameras, "width": self.options.width, "height": self.options.height,
            "channels": self.channels, "n_tiles": self._layout.n_tiles, "size": self._size,
            "size_with_kept": self._size_with_kept, "longest_in_tile": tiles_cuda.LONGEST,
            "longest_in_run": tiles_cuda.RUN,
        }  # fmt: skip

    def parameters(self, slots: Mapping[str, int], report: int) -> dict[str, Slot | int | float]:
        """Parameters of the kernels by name, if pictures are drawn as given; in `slots`, what only a call knows."""
        layout, options = self._layout, self.options
        limits = "near", "far", "radius_clip", "eps2d", "alpha_min", "extent_sigmas", "largest"
        colors, backgrounds = self.numels[5], self.numels[8]
        return {
            **{name: Slot(place, 0) for name, place in slots.items()},
            **{name: Slot(slots["workspace"], start) for name, start in self._at.items()},
            **{name: Slot(slots["kept"], start) for name, start in self._at_kept.items()},
            **dict(zip(limits, self._limits, strict=True)),
            "n": self.n, "n_cameras": self.n_cameras, "total": self.total, "width": options.width,
            "height": options.height, "ortho": options.ortho, "n_counters": self._n_counters,
            "n_threads": self._project_blocks * projection_native.BLOCK, "n_colors": colors,
            "n_backgrounds": max(backgrounds, 0), "tiles_x": layout.tiles_x, "tiles_y": layout.tiles_y,
            "n_tiles": layout.n_tiles, "spread": self._spread, "report": report, "opacity_step": 0,
            "color_step": self._color_step, "opacities_given": self.n, "g_depths": 0,
            "g_cameras": 0,
        }  # fmt: skip

    def part(self, workspace: Tensor, name: str, dtype: torch.dtype, *row: int) -> Tensor:
        """An array of a workspace with a row for each camera and Gaussian, [C, N, *row]."""
        start, numbers = self._at[name], 1
        for size in row:
            numbers *= size
        flat = workspace[start : start + self.total * numbers * dtype.itemsize]
        return flat.view(dtype).view(self.n_cameras, self.n, *row)
