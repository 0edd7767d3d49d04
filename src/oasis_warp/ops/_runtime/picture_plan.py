"""The plan of float32 pictures on CUDA: calls of one kind share it, so that a call only launches kernels."""

import threading
from typing import Any

import torch
from torch import Tensor

from oasis_kernels.rasterize import projection_native, tiles_cuda
from oasis_warp.ops._runtime.blend_tiles import MAX_PAIRS, check_pairs
from oasis_warp.ops._runtime.pair_counts import SORTED, Counts, PolledCounters, remember
from oasis_warp.ops._runtime.picture_call import Drawn, Gradients, Needs, Scene
from oasis_warp.ops._runtime.picture_preparation import Preparation
from oasis_warp.ops._runtime.plans import ALIGNMENT
from oasis_warp.ops._runtime.projection_backends import fill_viewmats

SLACK = 1.25
"""Memory for pairs of a Gaussian and a tile, relative to what the last call of a kind had."""


class Plan(Preparation):
    """How pictures of one kind are drawn by one thread."""

    def stream(self) -> int:
        """Handle of torch's current stream."""
        return torch._C._cuda_getCurrentRawStream(self._index)

    def _blended(self, scene: Scene, workspace: Tensor) -> tuple[Tensor, Tensor | None]:
        """Colours and backgrounds to blend, with depths and padded as the kernels want them."""
        colors, backgrounds = scene.colors.contiguous(), scene.backgrounds
        if self.as_given:
            return colors, None if backgrounds is None else backgrounds.contiguous()
        shape = self.n_cameras, self.n
        parts = []
        if self.draws_colors:
            parts.append(colors.expand(*shape, self.n_colors))
        if self.n_depths:
            parts.append(self.part(workspace, "depths", torch.float32, 1))
        if self.n_depths == 2:
            parts.append(colors.new_ones(*shape, 1))
        if self.channels > self.n_drawn:
            parts.append(colors.new_zeros(*shape, self.channels - self.n_drawn))
        if backgrounds is not None and self.draws_colors:
            backgrounds = torch.nn.functional.pad(backgrounds, (0, self.channels - self.n_colors))
        else:
            backgrounds = None
        return torch.cat(parts, -1), backgrounds

    def draw(self, scene: Scene, keep: bool, validate: bool) -> Drawn | None:
        """The picture; None where `validate` finds a bad value. Waits for the count of pairs, not for the picture."""
        options, at, layout = self.options, self._at, self._layout
        n, total, n_cameras = self.n, self.total, self.n_cameras
        stream = self.stream()
        means, quats, scales, covars, opacities, colors, viewmats, Ks, backgrounds = _contiguous(scene)
        workspace = torch.empty(self._size_with_kept if keep else self._size, dtype=torch.uint8, device=self.device)
        base = workspace.data_ptr()
        polled = _polled.counters
        values, report = polled.values, polled.address
        values[0] = values[1] = -1
        values[2] = 0
        bad = report + 16 if validate else 0
        behind, n_behind = (0, 0) if backgrounds is None else (backgrounds.data_ptr(), backgrounds.numel())
        try:
            boxes, counters = base + at["boxes"], base + at["counters"]
            centers, whitenings = base + at["centers"], base + at["whitenings"]
            self._project(
                self._project_blocks, stream, n, n_cameras, options.width, options.height, means.data_ptr(),
                quats.data_ptr() if quats is not None else 0, scales.data_ptr() if scales is not None else 0,
                covars.data_ptr() if covars is not None else 0, viewmats.data_ptr(), Ks.data_ptr(), options.ortho,
                opacities.data_ptr(), *self._limits, base + at["means2d"], base + at["covars2d"], base + at["depths"],
                base + at["conics"], base + at["radii"], base + at["sort_depths"], centers, whitenings, boxes, counters,
                self._n_counters, self._project_blocks * projection_native.BLOCK, bad,
                colors.data_ptr(), colors.numel(), behind, n_behind,
            )  # fmt: skip
            if not self.as_given:
                colors, backgrounds = self._blended(scene, workspace)
                behind = 0 if backgrounds is None else backgrounds.data_ptr()
            image = torch.empty(
                (n_cameras, options.height, options.width, self.channels), dtype=torch.float32, device=self.device
            )
            alphas = torch.empty((n_cameras, options.height, options.width, 1), dtype=torch.float32, device=self.device)
            color_step = n if colors.dim() == 3 else 0
            capacity, longest = self.expected
            while True:
                long = longest > tiles_cuda.LONGEST
                # One more than there may be, as an empty tensor has no address.
                keys = torch.empty(capacity + 1, dtype=torch.int64, device=self.device)
                lists = torch.empty(capacity + 1, dtype=torch.int32, device=self.device) if keep or long else None
                order = 0 if lists is None else lists.data_ptr()
                self._count(
                    self._count_blocks, stream, n, total, boxes, layout.tiles_x, layout.tiles_y,
                    base + at["pair_starts"], self._spread, counters,
                )  # fmt: skip
                self._place(
                    self._place_blocks, stream, layout.n_tiles, layout.tiles_x, capacity, longest, counters,
                    base + at["tiles"], self._spread, base + at["cursors"], report,
                )  # fmt: skip
                self._fill(
                    self._count_blocks, stream, n, total, boxes, base + at["sort_depths"], layout.tiles_x,
                    layout.tiles_y, capacity, self._spread, base + at["cursors"], keys.data_ptr(),
                )  # fmt: skip
                if long:
                    spare = torch.empty_like(keys) if longest > tiles_cuda.RUN else None
                    self._sort_long(
                        layout.n_tiles, stream, n, base + at["tiles"], layout.tiles_y, keys.data_ptr(),
                        0 if spare is None else spare.data_ptr(), order,
                    )  # fmt: skip
                self._blend(
                    layout.n_tiles, stream, n, base + at["tiles"], n_cameras, centers, whitenings, opacities.data_ptr(),
                    colors.data_ptr(), 0, color_step, behind, layout.tiles_x, layout.tiles_y, options.width,
                    options.height, order, *self._kept(base, keep), keys.data_ptr(), image.data_ptr(),
                    alphas.data_ptr(),
                )  # fmt: skip
                polled.wait(self._index)
                counts = Counts(values[0], values[1])
                if values[2]:
                    return None
                self.learn(counts)
                if counts.pairs <= capacity and counts.longest <= longest:
                    break
                capacity = max(capacity, counts.pairs)
                longest = _sorted(max(longest, counts.longest))
                values[0] = values[1] = -1
        except BaseException:  # kernels that are on their way still write to the words
            torch.cuda.current_stream(self._index).synchronize()
            raise
        return Drawn(image, alphas, colors, backgrounds, workspace, lists, counts.pairs)

    def learn(self, counts: Counts) -> None:
        """Expect the next picture to need what this one did, and some more."""
        check_pairs(counts.pairs)
        remember(self._kind, counts)
        self.expected = Counts(min(int(SLACK * counts.pairs) + ALIGNMENT, MAX_PAIRS), _sorted(counts.longest))

    def _kept(self, base: int, keep: bool) -> tuple[int, int, int]:
        """Addresses of what blending keeps for its adjoint."""
        at = self._at
        return (base + at["transmittance"], base + at["stops"], base + at["checkpoints"]) if keep else (0, 0, 0)

    def draw_backward(
        self, scene: Scene, drawn: Drawn, g_image: Tensor | None, g_alphas: Tensor | None, needs: Needs,
        retains: bool,
    ) -> tuple[Gradients, Tensor | None]:  # fmt: skip
        """Gradients, None where they are not wanted; and with `retains` that by means2d, [C, N, 2]."""
        with_shape = any(needs[:5]) or needs.viewmats
        with_colors = (needs.colors and self.draws_colors) or (with_shape and self.n_depths > 0)
        record, back, gather = self.adjoints(with_shape, with_colors)
        options, at, layout, device = self.options, self._at, self._layout, self.device
        n, total, n_cameras = self.n, self.total, self.n_cameras
        stream = self.stream()
        base = drawn.workspace.data_ptr()
        opacities = scene.opacities.contiguous()
        channels, behind, lists = drawn.channels, drawn.backgrounds, drawn.lists
        g_image = None if g_image is None else _padded(g_image, self.channels).contiguous()
        g_alphas = None if g_alphas is None else g_alphas.contiguous()
        shared = scene.colors.dim() == 2
        # One tensor for all that is only passed on: by covars2d (float64) and means2d, then the records.
        passed = torch.empty(8 * total * with_shape + drawn.pairs * record + 4, dtype=torch.float32, device=device)
        g_covars2d = passed.data_ptr() if with_shape else 0
        g_means2d = g_covars2d and g_covars2d + 24 * total
        records = passed.data_ptr() + 32 * total * with_shape
        by_tile = None
        if needs.backgrounds:
            by_tile = torch.empty((n_cameras, layout.n_tiles // n_cameras, self.channels), device=device)
        back(
            layout.n_tiles, stream, n, base + at["tiles"], n_cameras, base + at["centers"], base + at["whitenings"],
            opacities.data_ptr(), channels.data_ptr(), 0, n if channels.dim() == 3 else 0,
            0 if behind is None else behind.data_ptr(), layout.tiles_x, layout.tiles_y, options.width, options.height,
            0 if lists is None else lists.data_ptr(), *self._kept(base, True), base + at["pair_starts"],
            base + at["boxes"], 0 if g_image is None else g_image.data_ptr(),
            0 if g_alphas is None else g_alphas.data_ptr(), records,
            0 if by_tile is None else by_tile.data_ptr(),
        )  # fmt: skip
        one, only = n_cameras == 1, n_cameras == 1 and shared and self.as_given
        g_opacities = g_channels = None
        if with_shape:
            g_opacities = torch.empty((n,) if one else (n_cameras, n), dtype=torch.float32, device=device)
        if with_colors:
            shape = (n, self.channels) if only else (n_cameras, n, self.channels)
            g_channels = torch.empty(shape, dtype=torch.float32, device=device)
        if gather is not None:
            gather(
                self._gather_blocks, stream, total, drawn.pairs, base + at["boxes"], base + at["pair_starts"],
                records, base + at["whitenings"], opacities.data_ptr(), n, g_means2d, g_covars2d,
                0 if g_opacities is None else g_opacities.data_ptr(),
                0 if g_channels is None else g_channels.data_ptr(),
            )  # fmt: skip
        g_depths = None
        if g_channels is not None and self.n_depths and with_shape:
            g_depths = g_channels[..., self.n_drawn - self.n_depths].contiguous()
        means, quats, scales, covars, viewmats = self.unproject(
            scene, drawn.workspace, g_means2d, g_covars2d, 0 if g_depths is None else g_depths.data_ptr(), needs
        )
        g_colors = None
        if needs.colors and self.draws_colors and g_channels is not None:
            g_colors = g_channels if self.as_given else g_channels[..., : self.n_colors]
            g_colors = _over_cameras(g_colors) if shared and not only else g_colors
        if g_opacities is not None and not one:
            g_opacities = g_opacities.sum(0)
        g_backgrounds = None
        if by_tile is not None and self.draws_colors:
            g_backgrounds = by_tile.sum(1)[:, : self.n_colors]
        gradients = Gradients(
            means, quats, scales, covars, g_opacities if needs.opacities else None, g_colors, viewmats, None,
            g_backgrounds,
        )  # fmt: skip
        by_means2d = passed[6 * total : 8 * total] if with_shape and retains else None
        return gradients, None if by_means2d is None else by_means2d.view(n_cameras, n, 2)

    def unproject(
        self, scene: Scene, workspace: Tensor, g_means2d: int, g_covars2d: int, g_depths: int, needs: Needs
    ) -> tuple[Tensor | None, ...]:
        """Gradients by means, quats, scales, covars and viewmats from those by the projection: addresses, or 0."""
        means, quats, scales, covars, _, _, viewmats, Ks, _ = _contiguous(scene)
        wanted: list[Tensor | None] = [None] * 4
        for k, tensor in enumerate((means, quats, scales, covars)):
            if needs[k] and tensor is not None:
                wanted[k] = torch.empty(tensor.shape, dtype=torch.float32, device=self.device)
        sums = g_viewmats = None
        if needs.viewmats:
            sums = torch.empty((self.total, 12), dtype=torch.float64, device=self.device)
        if needs.viewmats or any(gradient is not None for gradient in wanted):
            unproject = self._launch(projection_native.cuda_project_backward)
            unproject(
                self._unproject_blocks, self.stream(), self.n, self.n_cameras,
                self.options.width, self.options.height,
                *[0 if t is None else t.data_ptr() for t in (means, quats, scales, covars, viewmats, Ks)],
                self.options.ortho, workspace.data_ptr() + self._at["radii"], g_means2d, g_covars2d, g_depths,
                *[0 if t is None else t.data_ptr() for t in (*wanted, sums)],
            )  # fmt: skip
        if sums is not None:
            g_viewmats = torch.empty(viewmats.shape, dtype=torch.float32, device=self.device)
            fill_viewmats(g_viewmats, sums, self.n)
        return *wanted, g_viewmats


class _Polled(threading.local):
    """Words that this thread's kernels write and it polls."""

    def __init__(self) -> None:
        self._counters: PolledCounters | None = None

    @property
    def counters(self) -> PolledCounters:
        if self._counters is None:  # not at import: page-locked memory needs a device
            self._counters = PolledCounters(3)
        return self._counters


_polled = _Polled()


def polled_words() -> int:
    """Address of this thread's three words: pairs, the longest list, and whether a value is bad."""
    return _polled.counters.address


def _contiguous(scene: Scene) -> Any:
    return [t if t is None or t.is_contiguous() else t.contiguous() for t in scene]


def _sorted(longest: int) -> int:
    """Capacity class of the sort for a list of this length."""
    return next(limit for limit in SORTED if limit >= longest)


def _padded(tensor: Tensor, channels: int) -> Tensor:
    missing = channels - tensor.shape[-1]
    return torch.nn.functional.pad(tensor, (0, missing)) if missing else tensor


def _over_cameras(gradient: Tensor) -> Tensor:
    """The sum of a gradient [C, ...] over the cameras."""
    return gradient[0] if len(gradient) == 1 else gradient.sum(0)
