"""The rasterizer written out densely: every pixel against every Gaussian.

Thresholds are the float32 constants of gsplat 1.5.3, spelled out again.
"""

import numpy as np
import torch
from torch import Tensor

CAP = float(np.float32(0.999))
FAINTEST = float(np.float32(1 / 255))
STOP = float(np.float32(1e-4))
EPS2D = float(np.float32(0.3))
NEAR = float(np.float32(0.01))


def rotation_matrices(quats: Tensor) -> Tensor:
    """Of quaternions wxyz of any positive norm."""
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    return torch.stack([
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ], -1).reshape(-1, 3, 3)  # fmt: skip


def image_rows(means, viewmat, K, width, height):
    """Centres [n, 2], rows of the map from the world to the image round each [n, 2, 3], and depths [n], all > 0."""
    R, t = viewmat[:3, :3], viewmat[:3, 3]
    x, y, z = (means @ R.T + t).unbind(-1)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    margin_x, margin_y = 0.3 * 0.5 * width / fx, 0.3 * 0.5 * height / fy
    u = torch.clamp(x / z, min=float(-cx / fx - margin_x), max=float((width - cx) / fx + margin_x))
    v = torch.clamp(y / z, min=float(-cy / fy - margin_y), max=float((height - cy) / fy + margin_y))
    zero = torch.zeros_like(z)
    J = torch.stack([fx / z, zero, -fx * u / z, zero, fy / z, -fy * v / z], -1).reshape(-1, 2, 3)
    return torch.stack([fx * x / z + cx, fy * y / z + cy], -1), J @ R, z


def project(means, quats, scales, viewmat, K, width, height, eps2d):
    """Centres [n, 2], rows p and q of M [n, 3] with covariance M M^T + eps2d, and depths [n]."""
    centre, rows, z = image_rows(means, viewmat, K, width, height)
    M = rows @ rotation_matrices(quats) * scales[:, None, :]
    return centre, M[:, 0], M[:, 1], z


def covariances(quats, scales, rows, eps2d):
    """Entries a, b, c of the covariance in the image, and its determinant, which does not cancel (Cauchy-Binet)."""
    M = rows @ rotation_matrices(quats) * scales[:, None, :]
    p, q = M[:, 0], M[:, 1]
    a, b, c = (p * p).sum(-1), (p * q).sum(-1), (q * q).sum(-1)
    det = torch.linalg.cross(p, q).square().sum(-1) + eps2d * (a + c) + eps2d**2
    return a + eps2d, b, c + eps2d, det


def given_covariances(covars, rows, eps2d):
    """The same from covariances in the world, of which the symmetric part counts."""
    image = rows @ ((covars + covars.transpose(1, 2)) / 2) @ rows.transpose(1, 2)
    a, b, c = image[:, 0, 0] + eps2d, image[:, 0, 1], image[:, 1, 1] + eps2d
    return a, b, c, a * c - b * b


def layers(
    means, quats, scales, opacities, viewmat, K, width, height, near=0.01, far=1e10, eps2d=0.3, covars=None, decide=True
):
    """Alphas [pixels, n] of the Gaussians `order` [n], front to back; not cut or capped unless `decide`."""
    near, far, eps2d = (float(np.float32(v)) for v in (near, far, eps2d))
    z = (means @ viewmat[:3, :3].T + viewmat[:3, 3])[:, 2]
    kept = ((z >= near) & (z <= far) & (opacities >= FAINTEST)).nonzero()[:, 0]
    centre, image, z = image_rows(means[kept], viewmat, K, width, height)
    if covars is None:
        a, b, c, det = covariances(quats[kept], scales[kept], image, eps2d)
    else:
        a, b, c, det = given_covariances(covars[kept], image, eps2d)
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    pixels = torch.stack([columns, rows], -1).reshape(-1, 1, 2).to(means.dtype) + 0.5
    dx, dy = (pixels - centre).unbind(-1)
    # Cholesky solve, pivoted on the larger variance.
    wide = a >= c
    along, across = torch.where(wide, dx, dy), torch.where(wide, dy, dx)
    pivot = torch.where(wide, a, c)
    sigma = 0.5 * (along**2 / pivot + (across - b / pivot * along) ** 2 * pivot / det)
    alpha = opacities[kept] * torch.exp(-sigma)
    order = torch.argsort(z, stable=True)
    alpha = alpha[:, order]
    return decided(alpha) if decide else alpha, kept[order]


def decided(alpha: Tensor) -> Tensor:
    """Alphas of layers: skipped where too faint, capped where too strong."""
    return torch.where(alpha >= FAINTEST, torch.clamp(alpha, max=CAP), 0)


def blend_weights(alpha: Tensor) -> tuple[Tensor, Tensor]:
    """Weights alpha T [pixels, n] and the transmittance left at the end [pixels]."""
    after = torch.cumprod(1 - alpha, -1)
    alpha = torch.where(after > STOP, alpha, 0)  # the layer that would end the pixel and all behind it
    after = torch.cumprod(1 - alpha, -1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], -1)
    return alpha * before, after[:, -1] if after.shape[1] else torch.ones_like(alpha.sum(-1))


def rasterization(
    means, quats, scales, opacities, colors, viewmats, Ks, width, height, backgrounds=None, render_mode="RGB", **options
):
    """Images [C, H, W, X] and alphas [C, H, W, 1]."""
    return drawn(
        means, quats, scales, opacities, colors, viewmats, Ks, width, height, backgrounds, render_mode, **options
    )[:2]


def drawn(
    means, quats, scales, opacities, colors, viewmats, Ks, width, height, backgrounds=None, render_mode="RGB",
    slack=1.0, **options,
):  # fmt: skip
    """Images, alphas, and which pixels [C, H, W] are not `fragile`."""
    images, alphas, sound = [], [], []
    for c, (viewmat, K) in enumerate(zip(viewmats, Ks, strict=True)):
        alpha, order = layers(
            means, quats, scales, opacities, viewmat, K, width, height, decide=False, **options
        )
        sound.append(~fragile(alpha.detach(), slack).reshape(height, width))
        weights, left = blend_weights(decided(alpha))
        seen = (colors[c] if colors.dim() == 3 else colors)[order]
        depths = (means @ viewmat[:3, :3].T + viewmat[:3, 3])[order, 2:]
        image = weights @ seen
        if backgrounds is not None:
            image = image + left[:, None] * backgrounds[c]
        depth = weights @ depths
        if "ED" in render_mode:
            covered = left < 1
            depth = torch.where(covered[:, None], depth / torch.where(covered, 1 - left, 1)[:, None], 0)
        image = {"RGB": [image], "D": [depth], "ED": [depth]}.get(render_mode, [image, depth])
        images.append(torch.cat(image, -1).reshape(height, width, -1))
        alphas.append((1 - left).reshape(height, width, 1))
    return torch.stack(images), torch.stack(alphas), torch.stack(sound)


def fragile(alpha: Tensor, slack: float = 1.0) -> Tensor:
    """Pixels where a decision hangs on rounding: an alpha at the cut-off or the cap, a transmittance at the stop.

    `alpha` are the undecided ones of `layers`; `slack` widens what counts as close.
    """
    after = torch.cumprod(1 - decided(alpha), -1)
    near_edge = torch.zeros(len(alpha), dtype=torch.bool)
    for value, edge, width in [(alpha, FAINTEST, 3e-4), (alpha, CAP, 3e-4), (after, STOP, 2e-3)]:
        near_edge |= ((value - edge).abs() < slack * width * edge).any(-1)
    return near_edge
