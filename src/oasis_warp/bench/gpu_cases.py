"""What is timed on a GPU: pictures of several sizes, posing, visibility, an avatar's frame, and a step of learning."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from oasis_warp.bench.avatar_scene import (
    AvatarScene,
    Learning,
    avatar_scene,
    draw,
    exact_step,
    make_avatar,
    many_poses,
    pose,
)
from oasis_warp.bench.operators import (
    OPERATORS,
    Operator,
    Outputs,
    Pass,
    Results,
    exact,
    forward,
    repeated_gradients,
)
from oasis_warp.bench.scenes import HAND_GAUSSIANS, MeshScene, Scene, hand_scenes, surfels
from oasis_warp.core.config import BLACK
from oasis_warp.ops import RecordedRasterization

OURS = "warp"
TRUSTED = {"validate": False}
"""Options of our operators: looking at the values waits for the GPU, and other rasterizers do not look."""
Draw = Callable[[Scene], Outputs]


class Way(NamedTuple):
    """How a case is computed."""

    run: Callable[[], Results]
    captured: Callable[[], Results] | None
    """What a graph holds; None where no graph can."""


@dataclass(frozen=True)
class Case:
    """Something to be timed, in one or more ways."""

    name: str
    pass_: str
    gaussians: int
    faces: int | None
    views: int
    width: int
    height: int
    seed: int
    ways: Mapping[str, Way]
    """Ours is the first."""
    truth: Results
    """From the float64 kernels, on the same device."""
    judged: Tensor | None = None
    """Pixels [C, H, W] where no decision hangs on rounding; None where every value counts."""
    image: bool = False
    """Whether the first value is a picture [C, H, W, 3]."""


class Named(NamedTuple):
    """A case that has not been made yet."""

    name: str
    pass_: str
    make: Callable[[torch.device, int, Mapping[str, Draw]], Case]
    """From a device, a seed, and other rasterizers by name."""


def size_name(gaussians: int, size: int, n_views: int = 1) -> str:
    """What a picture is called."""
    views = f"{n_views} views of " if n_views > 1 else ""
    return f"{views}{round(gaussians / 1000)}k at {size} x {size}"


def picture(gaussians: int, size: int, n_views: int, pass_: Pass) -> Named:
    """Gaussians of the hand, rasterized; enlarged where they are fewer than it has."""

    def make(device: torch.device, seed: int, peers: Mapping[str, Draw]) -> Case:
        if gaussians == HAND_GAUSSIANS:
            scene = hand_scenes(size, seed, n_views)[0]
        else:
            scene = surfels(gaussians, size, seed)
        operator = replace(OPERATORS["rasterization"], graded=1)
        return operator_case(name, operator, scene.to(device=device), pass_, peers)

    name = size_name(gaussians, size, n_views)
    return Named(name, pass_, make)


def recorded_picture(gaussians: int, size: int, pass_: Pass) -> Named:
    """The same by a `RecordedRasterization`, under torch's autograd."""

    def make(device: torch.device, seed: int, _: Mapping[str, Draw]) -> Case:
        scene = hand_scenes(size, seed)[0] if gaussians == HAND_GAUSSIANS else surfels(gaussians, size, seed)
        draw_recorded = RecordedRasterization(size, size)

        def call(scene: Scene) -> Outputs:
            return draw_recorded(
                scene.means, scene.quats, scene.scales, scene.opacities, scene.colors, scene.viewmats, scene.Ks,
                scene.backgrounds,
            )  # fmt: skip

        operator = replace(OPERATORS["rasterization"], graded=1)
        return operator_case(name, operator, scene.to(device=device), pass_, {}, call)

    name = f"{size_name(gaussians, size)}, recorded"
    return Named(name, pass_, make)


def visibility(size: int, pass_: Pass) -> Named:
    """The hand's vertices, moved about, past its own surface."""

    def make(device: torch.device, seed: int, _: Mapping[str, Draw]) -> Case:
        mesh = hand_scenes(size, seed)[1].to(device=device)
        return operator_case(name, OPERATORS["depth_visibility"], mesh, pass_, {})

    name = f"visibility at {size} x {size}"
    return Named(name, pass_, make)


def operator_case(
    name: str,
    operator: Operator,
    scene: Scene | MeshScene,
    pass_: Pass,
    peers: Mapping[str, Draw],
    recorded: Callable[..., Outputs] | None = None,
) -> Case:
    """A pass of an operator on a scene; `peers` do the same, and so does `recorded`, which is timed in its place."""
    truth = exact(operator, scene)
    weights = tuple(w.to(torch.float32) for w in truth.weights)

    def call_of(call: Callable[..., Outputs], options: Mapping[str, Any]) -> Callable[[], Results]:
        if pass_ == "forward":
            return lambda: Results(forward(call, scene, options))
        return repeated_gradients(operator, call, scene, options, weights)

    ours = call_of(operator.call, TRUSTED)
    way = Way(ours, ours) if recorded is None else Way(call_of(recorded, {}), None)
    others = {peer: Way(call_of(call, {}), None) for peer, call in peers.items()}
    return Case(
        name=name,
        pass_=pass_,
        gaussians=len(scene.means if isinstance(scene, Scene) else scene.quats),
        faces=len(scene.faces) if isinstance(scene, MeshScene) else None,
        views=len(scene.viewmats) if isinstance(scene, Scene) else 1,
        width=scene.width,
        height=scene.height,
        seed=scene.seed,
        ways={OURS: way, **others},
        truth=Results(truth.outputs, truth.gradients if pass_ != "forward" else ()),
        judged=truth.judged,
        image=operator.image,
    )


def avatar_case(what: str, name: str, pass_: str, size: int = 512, n_poses: int = 1) -> Named:
    """The bundled hand as an avatar: "pose" its Gaussians, draw a "frame", or make a "step" of learning."""

    def make(device: torch.device, seed: int, _: Mapping[str, Draw]) -> Case:
        scene = avatar_scene(size, seed, device)
        if n_poses > 1:
            scene = replace(scene, held=many_poses(scene.held, n_poses, seed))
        way, truth = {"pose": posing, "frame": frame, "step": learning}[what](scene)
        return Case(
            name=name,
            pass_=pass_,
            gaussians=n_poses * len(scene.canonical.quats),
            faces=n_poses * len(scene.hand.faces),
            views=1,
            width=size,
            height=size,
            seed=seed,
            ways={OURS: way},
            truth=truth,
            judged=scene.mask[None] > 0,
            image=what != "pose",
        )

    return Named(name, pass_, make)


def posing(scene: AvatarScene) -> tuple[Way, Results]:
    """From joint angles to Gaussians, and what they are."""

    def call(scene: AvatarScene) -> Callable[[], Results]:
        surface = scene.surface()
        return without_gradients(lambda: Results(pose(scene, scene.canonical, surface)[:3]))

    return Way(call(scene), call(scene)), call(scene.to(dtype=torch.float64))()


def frame(scene: AvatarScene) -> tuple[Way, Results]:
    """A picture of an avatar as a user asks for it; a graph holds the same without a look at the values."""
    avatar, surface, wide = make_avatar(scene), scene.surface(), scene.to(dtype=torch.float64)
    way = Way(
        without_gradients(lambda: Results((avatar.render(scene.camera, scene.held, BLACK).image[None],))),
        without_gradients(lambda: Results((draw(scene, scene.canonical, surface),))),
    )
    return way, without_gradients(lambda: Results((draw(wide, wide.canonical, wide.surface()),)))()


def learning(scene: AvatarScene) -> tuple[Way, Results]:
    """A whole step."""
    step = Learning(scene).step
    return Way(step, step), exact_step(scene)


def without_gradients(run: Callable[[], Results]) -> Callable[[], Results]:
    """The same call with nothing kept for a backward pass."""
    return torch.no_grad()(run)


PASSES: tuple[Pass, ...] = ("forward", "forward + backward")
CASES: tuple[Named, ...] = (
    *(
        picture(gaussians, size, n_views, pass_)
        for gaussians, size, n_views in (
            (HAND_GAUSSIANS, 512, 1), (12_000, 256, 1), (HAND_GAUSSIANS, 256, 1), (HAND_GAUSSIANS, 512, 8),
        )
        for pass_ in PASSES
    ),
    *(
        recorded_picture(gaussians, size, pass_)
        for gaussians, size in ((HAND_GAUSSIANS, 512), (12_000, 256)) for pass_ in PASSES
    ),
    avatar_case("pose", "posing 37k", "forward"),
    avatar_case("pose", "1000 poses of 37k", "forward", n_poses=1000),
    *(visibility(448, pass_) for pass_ in PASSES),
    avatar_case("frame", "avatar at 512 x 512", "pose + draw"),
    avatar_case("step", "learning at 512 x 512", "pose + draw + loss + backward + Adam"),
)  # fmt: skip


def choose(pattern: str) -> list[Named]:
    """Cases whose name or pass holds `pattern`; all for an empty one."""
    return [case for case in CASES if pattern.lower() in f"{case.name}, {case.pass_}".lower()]
