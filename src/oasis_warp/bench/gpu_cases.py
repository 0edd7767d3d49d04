"""What is timed on a GPU: images of several sizes, posing, visibility, an avatar's frame, and a step of learning.

The avatar is the bundled hand: posed, drawn, and fitted to an image.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.bench.operators import OPERATORS, Call, Exact, Operator, Pass, Results, exact, one_pass
from oasis_warp.bench.scenes import (
    HAND_GAUSSIANS,
    GaussianScene,
    MeshScene,
    TensorBundle,
    hand_parts,
    hand_scenes,
    surfels,
)
from oasis_warp.core.camera import orbit_camera
from oasis_warp.core.config import BLACK
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import Camera, CanonicalGaussians, Gaussians, HandPose, PosedHand
from oasis_warp.hand.skinning import skin_surface
from oasis_warp.hand_avatar import Avatar
from oasis_warp.losses import masked_l1
from oasis_warp.ops import RecordedRasterization, RestMesh, rest_mesh
from oasis_warp.reference import rasterization
from oasis_warp.render import render

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
        loss = masked_l1(image.squeeze(0), self.scene.target, self.scene.mask)
        with torch.autograd.set_multithreading_enabled(False):  # on CUDA to change threads costs more than the kernels
            loss.backward()
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


OURS = "warp"
UNVALIDATED = {"validate": False}
"""Options of our operators while a graph is captured, which cannot check values. Eager calls check them."""
RASTERIZATION = OPERATORS["rasterization"]
PASSES: tuple[Pass, ...] = ("forward", "forward + backward")
Peers = Mapping[str, Call]
"""Other rasterizers, by name."""


class Implementation(NamedTuple):
    """How a case is computed."""

    run: Callable[[], Results]
    captured: Callable[[], Results] | None
    """What a graph holds; None where no graph can."""


@dataclass(frozen=True)
class GpuCase:
    """Something to time, in one or more implementations."""

    name: str
    pass_: str
    gaussians: int
    faces: int | None
    views: int
    width: int
    height: int
    seed: int
    implementations: Mapping[str, Implementation]
    """Ours is the first."""
    truth: Exact
    """From the float64 kernels, on the same device."""
    image: bool = False
    """Whether the first value is an image [C, H, W, 3]."""


class CaseMaker(NamedTuple):
    """A case before its scene is made."""

    name: str
    pass_: str
    make: Callable[[torch.device, int, Peers], GpuCase]
    """From a device, a seed, and other rasterizers."""


def size_name(gaussians: int, size: int, n_views: int = 1) -> str:
    """The name of an image size."""
    views = f"{n_views} views of " if n_views > 1 else ""
    return f"{views}{round(gaussians / 1000)}k at {size} x {size}"


def image_case(gaussians: int, size: int, pass_: Pass, n_views: int = 1, recorded: bool = False) -> CaseMaker:
    """Gaussians of the hand, enlarged where they are fewer than it has, rasterized; by CUDA graphs if `recorded`."""
    name = size_name(gaussians, size, n_views) + (", recorded" if recorded else "")

    def make(device: torch.device, seed: int, peers: Peers) -> GpuCase:
        full = gaussians == HAND_GAUSSIANS
        scene = hand_scenes(size, seed, n_views)[0] if full else surfels(gaussians, size, seed)
        draw = RecordedRasterization(size, size) if recorded else None

        def draw_recorded(scene: GaussianScene) -> tuple[torch.Tensor, ...]:
            assert draw is not None
            return draw(
                scene.means, scene.quats, scene.scales, scene.opacities, scene.colors, scene.viewmats, scene.Ks,
                scene.backgrounds,
            )  # fmt: skip

        case = operator_case(name, RASTERIZATION, scene.to(device=device), pass_, {} if recorded else peers)
        if recorded:
            run = one_pass(RASTERIZATION, draw_recorded, scene.to(device=device), pass_, {}, case.truth.weights)
            return replace(case, implementations={OURS: Implementation(run, None)})
        return case

    return CaseMaker(name, pass_, make)


def visibility_case(size: int, pass_: Pass) -> CaseMaker:
    """The vertices of the hand, moved at random, against its own surface."""
    name = f"visibility at {size} x {size}"

    def make(device: torch.device, seed: int, _: Peers) -> GpuCase:
        mesh = hand_scenes(size, seed)[1].to(device=device)
        return operator_case(name, OPERATORS["depth_visibility"], mesh, pass_, {})

    return CaseMaker(name, pass_, make)


def operator_case(
    name: str, operator: Operator, scene: GaussianScene | MeshScene, pass_: Pass, peers: Peers
) -> GpuCase:
    """A pass of an operator on a scene; `peers` do the same."""
    truth = exact(operator, scene)

    def run(call: Call, options: Mapping[str, Any]) -> Callable[[], Results]:
        return one_pass(operator, call, scene, pass_, options, truth.weights)

    ours = Implementation(run(operator.call, {}), run(operator.call, UNVALIDATED))
    others = {name: Implementation(run(call, {}), None) for name, call in peers.items()}
    drawn = isinstance(scene, GaussianScene)
    return GpuCase(
        name=name,
        pass_=pass_,
        gaussians=len(scene.means if drawn else scene.quats),
        faces=None if drawn else len(scene.faces),
        views=len(scene.viewmats) if drawn else 1,
        width=scene.width,
        height=scene.height,
        seed=scene.seed,
        implementations={OURS: ours, **others},
        truth=truth if pass_ != "forward" else truth._replace(gradients=()),
        image=operator.image,
    )


def avatar_case(what: str, name: str, pass_: str, size: int = 512, n_poses: int = 1) -> CaseMaker:
    """The bundled hand as an avatar: "pose" its Gaussians, draw a "frame", or make a "step" of learning."""

    def make(device: torch.device, seed: int, _: Peers) -> GpuCase:
        scene = avatar_scene(size, seed, device)
        if n_poses > 1:
            scene = replace(scene, hand_pose=many_poses(scene.hand_pose, n_poses, seed))
        implementation, truth = {"pose": posing, "frame": frame, "step": learning}[what](scene)
        image = what != "pose"
        return GpuCase(
            name=name,
            pass_=pass_,
            gaussians=n_poses * len(scene.canonical.quats),
            faces=n_poses * len(scene.hand.faces),
            views=1,
            width=size,
            height=size,
            seed=seed,
            implementations={OURS: implementation},
            truth=Exact(truth.values, truth.gradients, judged=scene.mask[None] > 0 if image else None),
            image=image,
        )

    return CaseMaker(name, pass_, make)


def posing(scene: AvatarScene) -> tuple[Implementation, Results]:
    """From joint angles to Gaussians, and the exact ones."""

    def call(scene: AvatarScene) -> Callable[[], Results]:
        surface = scene.surface()
        return torch.no_grad()(lambda: Results(pose_avatar(scene, scene.canonical, surface)[:3]))

    return Implementation(call(scene), call(scene)), call(scene.to(dtype=torch.float64))()


def frame(scene: AvatarScene) -> tuple[Implementation, Results]:
    """An image of an avatar as a user draws it; a graph holds the same without a check of the values."""
    avatar, surface, wide = make_avatar(scene), scene.surface(), scene.to(dtype=torch.float64)
    no_grad = torch.no_grad()
    implementation = Implementation(
        no_grad(lambda: Results((avatar.render(scene.camera, scene.hand_pose, BLACK).image[None],))),
        no_grad(lambda: Results((draw_avatar(scene, scene.canonical, surface),))),
    )
    return implementation, no_grad(lambda: Results((draw_avatar(wide, wide.canonical, wide.surface()),)))()


def learning(scene: AvatarScene) -> tuple[Implementation, Results]:
    """A whole step."""
    step = Learning(scene).step
    return Implementation(step, step), exact_step(scene)


CASES: tuple[CaseMaker, ...] = (
    *(
        image_case(gaussians, size, pass_, n_views)
        for gaussians, size, n_views in (
            (HAND_GAUSSIANS, 512, 1), (12_000, 256, 1), (HAND_GAUSSIANS, 256, 1), (HAND_GAUSSIANS, 512, 8),
        )
        for pass_ in PASSES
    ),
    *(
        image_case(gaussians, size, pass_, recorded=True)
        for gaussians, size in ((HAND_GAUSSIANS, 512), (12_000, 256)) for pass_ in PASSES
    ),
    avatar_case("pose", "posing 37k", "forward"),
    avatar_case("pose", "1000 poses of 37k", "forward", n_poses=1000),
    *(visibility_case(448, pass_) for pass_ in PASSES),
    avatar_case("frame", "avatar at 512 x 512", "pose + draw"),
    avatar_case("step", "learning at 512 x 512", "pose + draw + loss + backward + Adam"),
)  # fmt: skip


def choose(pattern: str) -> list[CaseMaker]:
    """Cases whose name or pass contains `pattern`; all for an empty one."""
    return [case for case in CASES if pattern.lower() in f"{case.name}, {case.pass_}".lower()]
