"""The bundled hand as an avatar: posed, drawn, and fitted to a picture, as the GPU is timed on them."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.bench import torch_rasterizer
from oasis_warp.bench.operators import Results
from oasis_warp.bench.scenes import Scene, _Tensors, hand_parts
from oasis_warp.core.types import Camera, CanonicalGaussians, Gaussians, HandPose
from oasis_warp.hand.correctives import corrected_rest
from oasis_warp.hand.skinning import bone_transforms
from oasis_warp.hand.template import bundled_hand
from oasis_warp.hand_avatar import Avatar
from oasis_warp.losses.image import masked_l1
from oasis_warp.ops import rasterization, skin
from oasis_warp.render.cameras import orbit_camera

LEARNED = "offsets", "quats", "log_scales", "logit_opacities", "colors"
"""What a step of learning moves."""
CONTRAST = 0.2
"""By how much the picture to be learned differs from the one that is drawn, up or down at random."""


@dataclass(frozen=True)
class AvatarScene(_Tensors):
    """The hand at rest, its bones, Gaussians on it, a camera, and a picture to learn."""

    name: str
    seed: int
    angles: Float[Tensor, "15 3"]
    orientation: Float[Tensor, "3 3"]
    translation: Float[Tensor, "3"]
    rest_vertices: Float[Tensor, "V 3"]
    bent_vertices: Float[Tensor, "V 3"]
    """The same with what the pose corrects, to be skinned."""
    faces: Int[Tensor, "F 3"]
    skin_weights: Float[Tensor, "V J"]
    transforms: Float[Tensor, "J 3 4"]
    """Of the bones, rest to posed."""
    vertex_index: Int[Tensor, "P"]
    offsets: Float[Tensor, "P 3"]
    face_index: Int[Tensor, "Q"]
    barycentrics: Float[Tensor, "Q 3"]
    quats: Float[Tensor, "N 4"]
    log_scales: Float[Tensor, "N 3"]
    logit_opacities: Float[Tensor, "N"]
    colors: Float[Tensor, "N 3"]
    viewmat: Float[Tensor, "4 4"]
    K: Float[Tensor, "3 3"]
    backgrounds: Float[Tensor, "1 3"]
    target: Float[Tensor, "H W 3"]
    mask: Float[Tensor, "H W"]
    """0 where rounding decides what is drawn."""
    width: int
    height: int

    def canonical(self) -> CanonicalGaussians:
        """The Gaussians at rest."""
        return CanonicalGaussians(
            self.vertex_index, self.offsets, self.face_index, self.barycentrics, self.quats, self.log_scales.exp(),
            self.logit_opacities.sigmoid(), self.colors,
        )  # fmt: skip


def avatar_scene(size: int = 512, seed: int = 0, device: torch.device | str = "cpu") -> AvatarScene:
    """The bundled hand with 36,881 Gaussians, open, in a picture of `size` pixels a side."""
    generator = torch.Generator().manual_seed(seed)
    hand, rest, held, posed, canonical = hand_parts(generator)
    rotations, translations = bone_transforms(hand, rest.joints, held)
    camera = orbit_camera(posed, 0.0, size=size)
    signs = torch.randint(0, 2, (size, size, 3), generator=generator) * 2.0 - 1
    scene = AvatarScene(
        "avatar", seed, *held, rest.vertices, corrected_rest(hand, rest.vertices, held.angles), hand.faces,
        hand.weights, torch.cat([rotations, translations[..., None]], -1), canonical.vertex_index, canonical.offsets,
        canonical.face_index, canonical.barycentrics, canonical.quats, canonical.scales.log(),
        canonical.opacities.logit(), canonical.colors, camera.viewmat, camera.K, torch.zeros(1, 3),
        torch.zeros(size, size, 3), torch.zeros(size, size), size, size,
    ).to(device=device)  # fmt: skip
    with torch.no_grad():
        wide = scene.to(dtype=torch.float64)
        shown = torch_rasterizer.draw(as_scene(wide, pose(wide, wide.canonical())))
    target = shown.image.to(torch.float32) + CONTRAST * signs.to(device)
    return replace(scene, target=target, mask=(~shown.fragile).to(torch.float32))


def as_scene(scene: AvatarScene, gaussians: Gaussians) -> Scene:
    """Posed Gaussians before the scene's camera, over black."""
    return Scene(
        scene.name, scene.seed, *gaussians, scene.viewmat[None], scene.K[None], scene.backgrounds, scene.width,
        scene.height,
    )  # fmt: skip


def pose(scene: AvatarScene, canonical: CanonicalGaussians) -> Gaussians:
    """Skin, turn and carry along: from the transforms of the bones to Gaussians."""
    posed = skin(scene.bent_vertices, None, scene.skin_weights, scene.transforms, validate=False).means
    return pose_gaussians(canonical, scene.faces, scene.rest_vertices, posed)


def draw(scene: AvatarScene, canonical: CanonicalGaussians) -> tuple[Tensor, Tensor]:
    """Pose and rasterize: image [1, H, W, 3] and alpha [1, H, W, 1]."""
    gaussians = pose(scene, canonical)
    image, alphas, _ = rasterization(
        *gaussians, scene.viewmat[None], scene.K[None], scene.width, scene.height, backgrounds=scene.backgrounds,
        validate=False,
    )  # fmt: skip
    return image, alphas


class Learning:
    """Steps of learning the target: pose, draw, compare, go back, move what is learned by Adam.

    The learning rate is 0, so that every step draws the same: Adam's work does not depend on it.
    """

    def __init__(self, scene: AvatarScene):
        self.leaves = [getattr(scene, name).detach().clone().requires_grad_(True) for name in LEARNED]
        self.scene = replace(scene, **dict(zip(LEARNED, self.leaves, strict=True)))
        self.optimizer = torch.optim.Adam(self.leaves, lr=0.0, fused=True, capturable=scene.target.is_cuda)

    def step(self) -> Results:
        """One step: the picture, and the gradients by what is learned."""
        self.optimizer.zero_grad(set_to_none=True)
        image, _ = draw(self.scene, self.scene.canonical())
        masked_l1(image[0], self.scene.target, self.scene.mask).backward()
        self.optimizer.step()
        return Results((image.detach(),), tuple(leaf.grad for leaf in self.leaves if leaf.grad is not None))


def exact_step(scene: AvatarScene) -> Results:
    """What a step has to give, from the float64 kernels."""
    learning = Learning(scene.to(dtype=torch.float64))
    return learning.step()


def make_avatar(scene: AvatarScene) -> tuple[Avatar, Camera, HandPose]:
    """The same hand as a user has it, with a camera and a pose to draw it in."""
    canonical = scene.canonical()
    camera = Camera(scene.viewmat, scene.K, scene.width, scene.height)
    held = HandPose(scene.angles, scene.orientation, scene.translation)
    avatar = Avatar(
        side="right",
        shape=canonical.scales.new_zeros(len(bundled_hand().shape_names)),
        surface_offsets=torch.zeros_like(scene.rest_vertices),
        gaussians=canonical,
        source_pose=held,
        source_camera=camera,
    )
    return avatar, camera, held
