"""The Gaussians that splat files hold: posed, in the photo's axes, with values that every viewer can draw."""

from collections.abc import Iterable

import numpy as np
import torch
from jaxtyping import Float
from numpy.polynomial import Chebyshev, Polynomial, legendre
from torch import Tensor
from torch.nn.functional import normalize

from oasis_warp.core import rotation
from oasis_warp.core.errors import InputError
from oasis_warp.core.logging import logger
from oasis_warp.core.types import Camera, Gaussians
from oasis_warp.data.splat_files import SH_C0
from oasis_warp.export.request import ExportRequest
from oasis_warp.ops import spherical_harmonics

MIN_SCALE, MAX_SCALE = 1e-6, 0.02
"""Standard deviations that leave [m]: thinner than any skin, wider than a finger. Viewers hang on huge ones."""
HALF_TURN = (1.0, -1.0, -1.0)
"""Diagonal of the half turn about x, from y down and z forward to y up and z to the viewer, and back."""


@torch.no_grad()
def posed_splats(request: ExportRequest) -> Gaussians:
    """The hand upright as in its photo: x right, y up, z to the viewer [m], the wrist at the origin. On the CPU.

    Raises:
        InputError: a value is not finite.
    """
    avatar, pose = request.avatar, request.pose or request.avatar.source_pose
    shown = avatar.in_even_light() if request.light == "none" else avatar
    to_photo, wrist = photo_axes(avatar.source_camera), avatar.mesh(pose).joints[0]
    return checked(moved(shown.pose(pose), to_photo, wrist))


SIDE_LOBES = 0.15
"""Largest share of the photo's shade beyond the main lobe."""
DEGREE = 3
"""Highest degree of spherical harmonics that viewers draw."""


@torch.no_grad()
def view_harmonics(request: ExportRequest) -> Float[Tensor, "N K 3"] | None:
    """Spherical harmonics of the colours of `posed_splats`, in axes of `y_down`; None where no view changes them.

    From the photo's side they have the photo's shade, from others they have not (`avatar.vertex_light.view_shares`).
    The share is the polynomial of degree 3 of the cosine with the narrowest lobe (Dolph and Chebyshev): 1 at the
    photo's side, a half at 32 degrees, and at most `SIDE_LOBES` from 48 degrees on.
    """
    avatar, light, pose = request.avatar, request.avatar.parts.light, request.pose or request.avatar.source_pose
    if request.light == "none" or light is None or light.photo_eye is None:
        return None
    axes, middle = torch.eye(4).to(light.photo_eye), avatar.mesh(pose).vertices.mean(0)
    axes[:3, 3] = light.photo_eye - middle  # a camera behind the hand, from where only its place matters
    near, far = avatar.pose(pose).colors, avatar.pose(pose, camera=avatar.source_camera._replace(viewmat=axes)).colors
    if torch.equal(near, far):
        return None
    y_down_axes = torch.diag(axes.new_tensor(HALF_TURN)) @ photo_axes(avatar.source_camera).to(axes)
    toward = -(y_down_axes @ normalize(light.photo_eye, dim=0))  # harmonics are of the direction from the camera
    count = (DEGREE + 1) ** 2
    basis = spherical_harmonics(DEGREE, toward.expand(count, 3), torch.eye(count).to(axes)[..., None].expand(-1, -1, 3))
    degrees = torch.arange(count).float().sqrt().floor().long()
    zonal = axes.new_tensor(narrow_lobe() * 4 * np.pi / (2 * np.arange(DEGREE + 1) + 1))
    share = zonal[degrees.to(zonal.device)] * basis[:, 0]
    harmonics = (near - far)[:, None] * share[:, None]
    harmonics[:, 0] += (far - 0.5) / SH_C0
    return harmonics.cpu()


def narrow_lobe() -> np.ndarray:
    """Legendre coefficients of the polynomial of the cosine that is 1 at 1 and then stays within `SIDE_LOBES`."""
    wide = np.cosh(np.arccosh(1 / SIDE_LOBES) / DEGREE)  # where Chebyshev's polynomial is 1 / SIDE_LOBES
    stretched = Polynomial([(wide - 1) / 2, (wide + 1) / 2])  # from -1 and 1 to -1 and there
    return SIDE_LOBES * legendre.poly2leg(Chebyshev.basis(DEGREE).convert(kind=Polynomial)(stretched).coef)


def photo_axes(camera: Camera) -> Float[Tensor, "3 3"]:
    """Rotation from the world to the axes of the photo's picture: x right, y up, z to the viewer."""
    return torch.diag(camera.viewmat.new_tensor(HALF_TURN)) @ camera.viewmat[:3, :3]


def moved(gaussians: Gaussians, R: Float[Tensor, "3 3"], origin: Float[Tensor, "3"]) -> Gaussians:
    """The same in axes rotated by `R`, about `origin`; on the CPU, quaternions with w >= 0."""
    means = (gaussians.means - origin) @ R.to(gaussians.means).T
    about = rotation.from_matrix(R).to(gaussians.quats).expand_as(gaussians.quats)
    quats = rotation.multiply(about, gaussians.quats)
    quats = quats / quats.norm(dim=-1, keepdim=True)
    quats = torch.where(quats[..., :1] < 0, -quats, quats)
    return Gaussians(*(part.cpu() for part in gaussians._replace(means=means, quats=quats)))


def y_down(gaussians: Gaussians) -> Gaussians:
    """Half a turn about x: what files of trained scenes have, whose y points down and z forward."""
    half_turn = torch.diag(gaussians.means.new_tensor(HALF_TURN))
    return moved(gaussians, half_turn, gaussians.means.new_zeros(3))


def checked(gaussians: Gaussians) -> Gaussians:
    """The same with scales and opacities within limits.

    Raises:
        InputError: a value is not finite.
    """
    check_finite(gaussians)
    scales = gaussians.scales.clamp(MIN_SCALE, MAX_SCALE)
    if changed := int((scales != gaussians.scales).any(1).sum()):
        limits = f"{MIN_SCALE * 1e3:g} to {MAX_SCALE * 1e3:g} mm"
        logger.warning("%d of %d Gaussians are held to standard deviations of %s", changed, len(scales), limits)
    return gaussians._replace(scales=scales, opacities=gaussians.opacities.clamp(0, 1))


def check_finite(parts: Iterable[Tensor]) -> None:
    """Check values of Gaussians, a row each.

    Raises:
        InputError: some are not finite.
    """
    finite = torch.stack([part.flatten(1).isfinite().all(1) for part in (p.unflatten(0, (-1, 1)) for p in parts)])
    if bad := int((~finite.all(0)).sum()):
        raise InputError(f"export: expected finite Gaussians, got {bad} that are not; reconstruct the avatar again.")


def morton_order(means: np.ndarray) -> np.ndarray:
    """Indices that sort points, [N, 3], along a Morton curve: neighbours in files are neighbours in space."""
    least, most = means.min(0), means.max(0)
    cells = ((means - least) / np.maximum(most - least, 1e-12).max() * 1023).astype(np.uint64)
    key = np.zeros(len(means), np.uint64)
    for bit in range(10):
        for axis in range(3):
            key |= (cells[:, axis] >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(key, kind="stable")


def largest_component(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index of the largest component of unit quaternions, [N], and the other three in order where it is positive."""
    largest = np.abs(quats).argmax(1)
    positive = quats * np.where(np.take_along_axis(quats, largest[:, None], 1) < 0, -1, 1)
    return largest, positive[np.arange(4) != largest[:, None]].reshape(-1, 3)
