"""Build the wrinkles that skin forms where poses compress it (`oasis_warp.avatar.wrinkles`).

    python asset_build/build_wrinkles.py --out src/oasis_warp/assets/hand/wrinkles.npz

Wrinkles run across the direction in which skin is compressed. That direction is the mean over `POSES` of the mean hand.
Wrinkles lie where a phase is a whole number. Its gradient is that direction over the distance between wrinkles, in the
least squares.
"""

import argparse
from pathlib import Path

import igl
import numpy as np
import scipy.sparse as sp
import torch
from hand_build.source import write_npz
from scipy.sparse.linalg import spsolve
from torch import Tensor

from oasis_warp.avatar.wrinkles import DEPTH_UNIT, PHASE_UNIT
from oasis_warp.core import surface
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import HandPose
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand.skinning import rest_hand, skin
from oasis_warp.hand.template import bundled_hand

POSES = ("fist", "point", "ok", "pinch", "relaxed", "victory")
MOST_PRESSED = 0.8
"""Largest logarithm of compression that counts in one pose."""
DIRECTION_PASSES = 80
"""Smoothings over the mesh of the direction of compression, about 18 mm."""
SPACING, WANDER = (0.0058, 0.0019), (0.7, 0.35)
"""Distances between wide and fine wrinkles on the open hand [m], and how far they wander [distances]."""
WANDER_PASSES, VARIETY_PASSES = 60, 25
"""Smoothings of the noise by which they wander, and of that by which their depth varies along them."""
DEPTH, VARIETY, DEEPEST = 0.5, 0.6, 1.5
"""Mean depth, its standard deviation, and its limit."""
STILL, MOVING = 0.4, 0.9
"""Sum of the logarithms of compression over the poses up to which skin has no wrinkles, and from which it has all."""
CALM = 0.02
"""Weight of the direction where nothing compresses the skin."""
LEVEL = 1e-9
"""Weight of values of 0, which a gradient does not tell from others."""
SEED = 3


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    print(write_npz(parser.parse_args().out, wrinkles(bundled_hand())))


def wrinkles(hand: HandModel) -> dict[str, np.ndarray]:
    """Phase and depth of wide and fine wrinkles at the vertices, [2, V]."""
    flat, faces = posed(hand, "open"), hand.faces.long()
    direction, pressed = compression(hand, flat)
    across = torch.where(direction[:, 2:] < 0, -direction, direction)  # one way over the whole palm
    phases, depths = [], []
    for k, (spacing, wander) in enumerate(zip(SPACING, WANDER, strict=True)):
        phase = potential(flat, faces, across / spacing, pressed + CALM)
        phases.append(phase + wander * noise(hand, SEED + 10 * k, WANDER_PASSES))
        depths.append((DEPTH + VARIETY * noise(hand, SEED + 10 * k + 1, VARIETY_PASSES)).clamp(0, DEEPEST))
    of_vertices = spread(hand, pressed[:, None])[:, 0]
    moving = ((of_vertices - STILL) / (MOVING - STILL)).clamp(0, 1) * (1 - hand.nail.clamp(0, 1))
    return {
        "phase": np.rint(torch.stack(phases).numpy() / PHASE_UNIT).astype(np.int16),
        "depth": np.rint((torch.stack(depths) * moving).numpy() / DEPTH_UNIT).astype(np.uint8),
    }


def posed(hand: HandModel, name: str) -> Tensor:
    """Vertices of the mean hand, [V, 3]."""
    rest = rest_hand(hand, torch.zeros(len(hand.shape_names)))
    return skin(hand, rest, HandPose(named_pose(hand, name), torch.eye(3), torch.zeros(3))).vertices


def compression(hand: HandModel, flat: Tensor) -> tuple[Tensor, Tensor]:
    """Unit direction along each face in which the poses compress it most, [F, 3], and the sum of its logarithms."""
    faces, normals = hand.faces.long(), surface.face_normals(flat, hand.faces)[0]
    total = torch.zeros(len(faces), 3, 3)
    for name in POSES:
        stretch, along = least_stretch(flat[faces], posed(hand, name)[faces])
        total += (-stretch.log()).clamp(0, MOST_PRESSED)[:, None, None] * along[:, :, None] * along[:, None, :]
    edges = surface.mesh_edges(hand.faces)
    smooth = surface.smooth_over_mesh(spread(hand, total.reshape(-1, 9)), edges, DIRECTION_PASSES)
    values, vectors = torch.linalg.eigh(smooth[faces].mean(1).reshape(-1, 3, 3))
    along = vectors[:, :, 2] - (vectors[:, :, 2] * normals).sum(1, keepdim=True) * normals
    return torch.nn.functional.normalize(along, dim=1), values[:, 2]


def least_stretch(before: Tensor, after: Tensor) -> tuple[Tensor, Tensor]:
    """Least stretch of triangles [F, 3, 3], and its direction before."""
    first, second = before[:, 1] - before[:, 0], before[:, 2] - before[:, 0]
    x = torch.nn.functional.normalize(first, dim=1)
    y = torch.nn.functional.normalize(second - (second * x).sum(1, keepdim=True) * x, dim=1)
    flat = torch.stack([torch.stack([(e * x).sum(1), (e * y).sum(1)], 1) for e in (first, second)], 2)
    gradient = (after[:, 1:] - after[:, :1]).transpose(1, 2) @ torch.linalg.inv(flat)
    values, vectors = torch.linalg.eigh(gradient.transpose(1, 2) @ gradient)
    return values[:, 0].clamp_min(1e-8).sqrt(), vectors[:, :1, 0] * x + vectors[:, 1:, 0] * y


def spread(hand: HandModel, of_faces: Tensor) -> Tensor:
    """Means at the vertices of values of the faces around them."""
    mesh = hand.template.double().numpy(), hand.faces.numpy()
    means = [igl.average_onto_vertices(*mesh, np.ascontiguousarray(values)) for values in of_faces.double().numpy().T]
    return torch.from_numpy(np.stack(means, 1)).float()


def potential(vertices: Tensor, faces: Tensor, gradient: Tensor, weight: Tensor) -> Tensor:
    """Values of vertices whose gradient along the faces is nearest to `gradient`; `weight` is that of each face."""
    points, corners = vertices.double().numpy(), faces.numpy()
    operator = igl.grad(points, corners)  # three blocks of rows: along x, y and z
    share = np.tile(igl.doublearea(points, corners) * weight.numpy(), 3)
    system = operator.T @ sp.diags(share) @ operator
    system += sp.eye(system.shape[0]) * LEVEL * system.diagonal().mean()
    found = spsolve(system.tocsc(), operator.T @ (share * gradient.T.double().numpy().reshape(-1)))
    return torch.from_numpy(found).float()


def noise(hand: HandModel, seed: int, passes: int) -> Tensor:
    """Smooth noise on the vertices, of mean 0 and deviation 1."""
    start = torch.randn(len(hand.template), 1, generator=torch.Generator().manual_seed(seed))
    smooth = surface.smooth_over_mesh(start, surface.mesh_edges(hand.faces), passes)[:, 0]
    return (smooth - smooth.mean()) / smooth.std()


if __name__ == "__main__":
    main()
