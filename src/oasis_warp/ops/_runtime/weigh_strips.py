"""The weights of `blend_weights` with the vector kernels: float32 on the CPU."""

import torch
from torch import Tensor

from oasis_kernels.rasterize import strips
from oasis_warp.ops._runtime.blend_strips import count, cut_strips
from oasis_warp.ops._runtime.launch import address, run_native
from oasis_warp.ops._runtime.registration import revealed
from oasis_warp.ops._runtime.rules import current_rules
from oasis_warp.ops._runtime.splats import Splats
from oasis_warp.ops._runtime.weigh_tiles import SparseWeights, check_weights


def weigh(splats: Splats, width: int, height: int, tile_size: int) -> SparseWeights:
    """Weight alpha T of every Gaussian in every pixel, for one camera. Colours and backgrounds are not read.

    Raises:
        ValueError: more weights than int32 can count.
    """
    n, n_pixels = splats.opacities.shape[1], width * height
    s = cut_strips(1, n, width, height, tile_size, tiles_across=-(-width // tile_size))
    assert s.across == 1
    counted = count(splats, s)
    n_pairs, ids = counted.n_pairs, revealed(counted.lists.ids)
    entries = torch.empty(2 * n_pairs, dtype=torch.int64)
    members = torch.empty(n_pairs, dtype=torch.int32)
    pair_weights = torch.empty(n_pairs, dtype=torch.int32)
    pixel_weights = torch.empty(n_pixels, dtype=torch.int32)
    state = torch.zeros(strips.STATE, dtype=torch.int64)
    words = counted.words | {
        "state": address(state, torch.int64, strips.STATE),
        "entries": address(entries, torch.int64, 2 * n_pairs),
        "ids": address(ids, torch.int32, n_pairs),
        "members": address(members, torch.int32, n_pairs),
        "pair_weights": address(pair_weights, torch.int32, n_pairs),
        "pixel_weights": address(pixel_weights, torch.int32, n_pixels),
    }
    n_tasks = max(s.n_chunks, s.n_strips)
    run_native(strips.count_weights(current_rules()), words, n_tasks)

    pair_places = _starts(pair_weights)
    n_weights = int(pair_places[-1])
    check_weights(n_weights)
    pixel_starts = _starts(pixel_weights).to(torch.int32)
    places = pixel_starts[:-1].clone()
    pixels, gaussians = (torch.empty(n_weights, dtype=torch.int32) for _ in range(2))
    by_gaussian, by_pixel, alphas = torch.empty(n_weights), torch.empty(n_weights), torch.empty(n_pixels)
    state = torch.zeros(strips.STATE, dtype=torch.int64)
    words |= {
        "state": address(state, torch.int64, strips.STATE),
        "pair_places": address(pair_places, torch.int64, n_pairs + 1),
        "pixel_places": address(places, torch.int32, n_pixels),
        "gaussian_pixels": address(pixels, torch.int32, n_weights),
        "gaussian_weights": address(by_gaussian, torch.float32, n_weights),
        "pixel_gaussians": address(gaussians, torch.int32, n_weights),
        "pixel_values": address(by_pixel, torch.float32, n_weights),
        "alphas": address(alphas, torch.float32, n_pixels),
    }
    run_native(strips.fill_weights(current_rules()), words, n_tasks)
    # A Gaussian without pairs starts where the next one does.
    starts = pair_places[torch.cat([counted.lists.pair_starts.long(), torch.tensor([n_pairs])])]
    return SparseWeights(pixel_starts, gaussians, by_pixel, starts.to(torch.int32), pixels, by_gaussian, alphas)


def _starts(counts: Tensor) -> Tensor:
    """Where each of consecutive parts begins, and at the end the sum of all."""
    starts = torch.zeros(len(counts) + 1, dtype=torch.int64)
    torch.cumsum(counts, 0, out=starts[1:])
    return starts
