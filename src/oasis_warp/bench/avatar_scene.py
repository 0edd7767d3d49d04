"""The bundled hand as an avatar: posed, drawn, and fitted to an image, as the GPU is timed on it."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.bench.operators import Results
from oasis_warp.bench.scenes import TensorBundle, hand_parts
from oasis_warp.core.camera import orbit_camera
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import Camera, CanonicalGaussians, Gaussians, HandPose, PosedHand
from oasis_warp.hand.skinning import skin_surface
from oasis_warp.hand_avatar import Avatar
from oasis_warp.losses.image import masked_l1
from oasis_warp.ops import RestMesh, rest_mesh
from oasis_warp.reference import rasterization
from oasis_warp.render.render import render

CONTRAST = 0.2
"""By how much the target image differs from the one that is drawn, up or down at random."""
POSE_NOISE = 0.1
"""Standard deviation of the joint angles of many poses about those of one [rad]."""


@dataclass(frozen=True)
class AvatarScene(TensorBundle):
    """The hand at rest and its pose, Gaussians on it, a camera, and a target image."""

    seed: int
    hand: HandModel
    rest: PosedHand
    hand_pose: HandPose
    canonical: CanonicalGaussians
    camera: Camera
    target: Float[Tensor, "H W 3"]
    mask: Float[Tensor, "H W"]
    """0 where rounding decides what is drawn."""

    def surface(self) -> RestMesh:
        """The mesh at rest, measured once for many poses."""
        return rest_mesh(self.rest.vertices, self.hand.faces, validate=False)


def avatar_scene(size: int = 512, seed: int = 0, device: torch.device | str = "cpu") -> AvatarScene:
    """The bundled hand with 36,881 Gaussians, open, in an image of `size` pixels a side."""
    generator = torch.Generator().manual_seed(seed)
    hand, rest, hand_pose, posed, canonical = hand_parts(generator)
    camera = orbit_camera(posed, 0.0, size=size)
    signs = torch.randint(0, 2, (size, size, 3), generator=generator) * 2.0 - 1
    blank = torch.zeros(size, size)
    scene = AvatarScene(seed, hand, rest, hand_pose, canonical, camera, signs, blank).to(device=device)
    with torch.no_grad():
        wide = scene.to(dtype=torch.float64)
        *gaussians, colors = pose_avatar(wide, wide.canonical, wide.surface())
        shown = rasterization.draw(rasterization.Gaussians(*gaussians), colors, wide.camera)
    target = shown.image.to(torch.float32) + CONTRAST * scene.target
    return replace(scene, target=target, mask=(~shown.fragile).to(torch.float32))


def pose_avatar(scene: AvatarScene, canonical: CanonicalGaussians, surface: RestMesh) -> Gaussians:
    """From joint angles to Gaussians: bones, skin, rotations, and the Gaussians on the mesh."""
    posed = skin_surface(scene.hand, scene.rest, scene.hand_pose)
    return pose_gaussians(canonical, scene.hand.faces, surface, posed)


def draw_avatar(scene: AvatarScene, canonical: CanonicalGaussians, surface: RestMesh) -> Float[Tensor, "1 H W 3"]:
    """Pose and rasterize over black."""
    return render(pose_avatar(scene, canonical, surface), scene.camera).image[None]


def many_poses(hand_pose: HandPose, n: int, seed: int) -> HandPose:
    """`n` poses about one."""
    noise = torch.randn(n, *hand_pose.angles.shape, generator=torch.Generator().manual_seed(seed))
    angles = hand_pose.angles + POSE_NOISE * noise.to(hand_pose.angles)
    return HandPose(angles, *(part.expand(n, *part.shape).contiguous() for part in hand_pose[1:]))


class Learning:
    """Optimisation steps towards the target: pose, draw, loss, backward, Adam.

    The learning rate is 0, so that every step draws the same: Adam's work does not depend on it.
    """

    def __init__(self, scene: AvatarScene):
        canonical, self.scene, self.surface = scene.canonical, scene, scene.surface()
        stored = (
            canonical.offsets, canonical.quats, canonical.scales.log(), canonical.opacities.logit(), canonical.colors
        )
        self.leaves = [part.detach().clone().requires_grad_(True) for part in stored]
        self.optimizer = torch.optim.Adam(self.leaves, lr=0.0, fused=True, capturable=scene.target.is_cuda)

    def step(self) -> Results:
        """One step: the image, and the gradients of the leaves."""
        self.optimizer.zero_grad(set_to_none=True)
        offsets, quats, log_scales, logit_opacities, colors = self.leaves
        canonical = self.scene.canonical._replace(
            offsets=offsets, quats=quats, scales=log_scales.exp(), opacities=logit_opacities.sigmoid(), colors=colors
        )
        image = draw_avatar(self.scene, canonical, self.surface)
        masked_l1(image[0], self.scene.target, self.scene.mask).backward()
        self.optimizer.step()
        return Results((image.detach(),), tuple(leaf.grad for leaf in self.leaves if leaf.grad is not None))


def exact_step(scene: AvatarScene) -> Results:
    """A step by the float64 kernels, from the numbers that the float32 step stores."""
    wide, learning = Learning(scene.to(dtype=torch.float64)), Learning(scene)
    with torch.no_grad():
        for leaf, stored in zip(wide.leaves, learning.leaves, strict=True):
            leaf.copy_(stored)
    return wide.step()


def make_avatar(scene: AvatarScene) -> Avatar:
    """The same hand as a user has it."""
    return Avatar(
        side="right",
        shape=scene.canonical.scales.new_zeros(len(scene.hand.shape_names)),
        surface_offsets=torch.zeros_like(scene.rest.vertices),
        gaussians=scene.canonical,
        source_pose=scene.hand_pose,
        source_camera=scene.camera,
    )
