"""What is timed on a GPU: images of several sizes, posing, visibility, an avatar's frame, and a step of learning."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch

from oasis_warp.bench.avatar_scene import (
    AvatarScene,
    Learning,
    avatar_scene,
    draw_avatar,
    exact_step,
    make_avatar,
    many_poses,
    pose_avatar,
)
from oasis_warp.bench.operators import OPERATORS, Call, Exact, Operator, Pass, Results, exact, one_pass
from oasis_warp.bench.scenes import HAND_GAUSSIANS, GaussianScene, MeshScene, hand_scenes, surfels
from oasis_warp.core.config import BLACK
from oasis_warp.ops import RecordedRasterization

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
