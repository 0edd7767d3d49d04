"""The bundled hand as an avatar: posed, drawn, and fitted to a picture, as the GPU is timed on them."""

from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.bench import torch_rasterizer
from oasis_warp.bench.operators import Results
from oasis_warp.bench.scenes import Scene, hand_parts
from oasis_warp.core.camera import orbit_camera
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import Camera, CanonicalGaussians, Gaussians, HandPose, PosedHand
from oasis_warp.hand.skinning import skin_surface
from oasis_warp.hand_avatar import Avatar
from oasis_warp.losses.image import masked_l1
from oasis_warp.ops import RestMesh, rest_mesh
from oasis_warp.render.render import render

CONTRAST = 0.2
"""By how much the picture to be learned differs from the one that is drawn, up or down at random."""
RESTLESS = 0.1
"""Standard deviation of the angles of many poses about those of one [rad]."""

Tensors = TypeVar("Tensors", bound=tuple)


def moved(tensors: Tensors, device: torch.device | str | None, dtype: torch.dtype | None) -> Tensors:
    """A named tuple with its tensors on a device, real numbers in a precision."""
    parts = (
        t.to(device=device, dtype=dtype if t.is_floating_point() else None) if isinstance(t, Tensor) else t
        for t in tensors
    )  # fmt: skip
    return type(tensors)(*parts)


@dataclass(frozen=True)
class AvatarScene:
    """The hand at rest and its pose, Gaussians on it, a camera, and a picture to learn."""

    seed: int
    hand: HandModel
    rest: PosedHand
    held: HandPose
    canonical: CanonicalGaussians
    camera: Camera
    target: Float[Tensor, "H W 3"]
    mask: Float[Tensor, "H W"]
    """0 where rounding decides what is drawn."""

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> "AvatarScene":
        """The same on another device or in another precision."""
        parts = (self.rest, self.held, self.canonical, self.camera)
        return AvatarScene(
            self.seed, self.hand.to(device, dtype), *(moved(part, device, dtype) for part in parts),
            self.target.to(device=device, dtype=dtype), self.mask.to(device=device, dtype=dtype),
        )  # fmt: skip

    def surface(self) -> RestMesh:
        """The mesh at rest, measured once for many poses."""
        return rest_mesh(self.rest.vertices, self.hand.faces, validate=False)


def avatar_scene(size: int = 512, seed: int = 0, device: torch.device | str = "cpu") -> AvatarScene:
    """The bundled hand with 36,881 Gaussians, open, in a picture of `size` pixels a side."""
    generator = torch.Generator().manual_seed(seed)
    hand, rest, held, posed, canonical = hand_parts(generator)
    camera = orbit_camera(posed, 0.0, size=size)
    signs = torch.randint(0, 2, (size, size, 3), generator=generator) * 2.0 - 1
    blank = torch.zeros(size, size)
    scene = AvatarScene(seed, hand, rest, held, canonical, camera, signs, blank).to(device=device)
    with torch.no_grad():
        wide = scene.to(dtype=torch.float64)
        camera = wide.camera
        shown = torch_rasterizer.draw(
            Scene(
                "avatar", seed, *pose(wide, wide.canonical, wide.surface()), camera.viewmat[None], camera.K[None],
                torch.zeros(1, 3).to(camera.K), size, size,
            )
        )  # fmt: skip
    target = shown.image.to(torch.float32) + CONTRAST * scene.target
    return replace(scene, target=target, mask=(~shown.fragile).to(torch.float32))


def pose(scene: AvatarScene, canonical: CanonicalGaussians, surface: RestMesh) -> Gaussians:
    """From joint angles to Gaussians: bones, skin, rotations, and what rides on them."""
    posed = skin_surface(scene.hand, scene.rest, scene.held)
    return pose_gaussians(canonical, scene.hand.faces, surface, posed)


def draw(scene: AvatarScene, canonical: CanonicalGaussians, surface: RestMesh) -> Float[Tensor, "1 H W 3"]:
    """Pose and rasterize over black."""
    return render(pose(scene, canonical, surface), scene.camera).image[None]


def many_poses(held: HandPose, n: int, seed: int) -> HandPose:
    """`n` poses about one."""
    noise = torch.randn(n, *held.angles.shape, generator=torch.Generator().manual_seed(seed))
    angles = held.angles + RESTLESS * noise.to(held.angles)
    return HandPose(angles, *(part.expand(n, *part.shape).contiguous() for part in held[1:]))


class Learning:
    """Steps of learning the target: pose, draw, compare, go back, move what is learned by Adam.

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
        """One step: the picture, and the gradients by what is learned."""
        self.optimizer.zero_grad(set_to_none=True)
        offsets, quats, log_scales, logit_opacities, colors = self.leaves
        canonical = self.scene.canonical._replace(
            offsets=offsets, quats=quats, scales=log_scales.exp(), opacities=logit_opacities.sigmoid(), colors=colors
        )
        image = draw(self.scene, canonical, self.surface)
        masked_l1(image[0], self.scene.target, self.scene.mask).backward()
        self.optimizer.step()
        return Results((image.detach(),), tuple(leaf.grad for leaf in self.leaves if leaf.grad is not None))


def exact_step(scene: AvatarScene) -> Results:
    """What a step has to give, from the float64 kernels: of the numbers that the float32 step stores."""
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
        source_pose=scene.held,
        source_camera=scene.camera,
    )
