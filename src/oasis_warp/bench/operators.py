"""The operators as they are measured: how each is called on a scene, and by what its gradients are taken."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from oasis_warp.bench import torch_mesh, torch_rasterizer
from oasis_warp.bench.scenes import MeshScene, Scene
from oasis_warp.ops import (
    BlendWeights,
    blend_colors,
    blend_weights,
    depth_map,
    depth_visibility,
    face_rotations,
    pose_on_mesh,
    rasterization,
    skin,
)

Outputs = tuple[Tensor, ...]
Pass = Literal["forward", "forward + backward"]


class Results(NamedTuple):
    """What a call gave: its outputs, and in passes with one the gradients."""

    values: Outputs
    gradients: Outputs = ()

    @property
    def tensors(self) -> Outputs:
        """Both."""
        return *self.values, *self.gradients


def as_it_is(value: Any) -> Any:
    """The value."""
    return value


@dataclass(frozen=True)
class Weighted:
    """What `blend_colors` takes."""

    weights: BlendWeights
    colors: Tensor


@dataclass(frozen=True)
class Operator:
    """One public function of `oasis_warp.ops`, or, as "posing", face_rotations and pose_on_mesh in a row."""

    name: str
    scene: type[Scene] | type[MeshScene]
    call: Callable[..., Outputs]
    """From a scene (what `prepare` makes of it) and options to tensors; the first is the main one."""
    torch_peer: Callable[[Any], Outputs]
    """The same in torch."""
    leaves: tuple[str, ...] = ()
    """Fields of the scene that gradients are taken by; none where the operator has no gradient."""
    graded: int | None = None
    """How many of the outputs the loss is made of; all when None."""
    vectorised: bool = True
    """Whether it has other kernels for the CPU than vectorised ones."""
    image: bool = False
    """Whether the first output is an image in [0, 1]."""
    comparable: Callable[[Outputs], Outputs] = field(default=as_it_is)
    """Outputs as their errors are taken."""
    prepare: Callable[[Any], Any] = field(default=as_it_is)
    """From a scene to what `call` takes, which is not timed."""

    @property
    def passes(self) -> tuple[Pass, ...]:
        """Those that it has."""
        return ("forward", "forward + backward") if self.leaves else ("forward",)


def _rasterization(scene: Scene, **options: Any) -> Outputs:
    image, alphas, _ = rasterization(
        scene.means, scene.quats, scene.scales, scene.opacities, scene.colors, scene.viewmats, scene.Ks,
        scene.width, scene.height, backgrounds=scene.backgrounds, **options,
    )  # fmt: skip
    return image, alphas


def _torch_rasterization(scene: Scene) -> Outputs:
    picture = torch_rasterizer.draw(scene)
    return picture.image[None], picture.alpha[None]


def _blend_weights(scene: Scene, **options: Any) -> Outputs:
    weights = blend_weights(
        scene.means, scene.quats, scene.scales, scene.opacities, scene.viewmats[0], scene.Ks[0],
        scene.width, scene.height, **options,
    )  # fmt: skip
    return (weights.alphas[None],)


@torch.no_grad()
def _weighted(scene: Scene) -> Weighted:
    weights = blend_weights(
        scene.means, scene.quats, scene.scales, scene.opacities, scene.viewmats[0], scene.Ks[0],
        scene.width, scene.height,
    )  # fmt: skip
    return Weighted(weights, scene.colors)


def _torch_blend_colors(scene: Weighted) -> Outputs:
    return ((scene.weights.matrix @ scene.colors).view(1, *scene.weights.alphas.shape[:2], -1),)


def _depth_map(scene: MeshScene, **options: Any) -> Outputs:
    drawn = depth_map(
        scene.posed_vertices, scene.faces, scene.viewmat, scene.K, scene.width, scene.height, **options
    )  # fmt: skip
    return (drawn.depth,)


def _nearness(outputs: Outputs) -> Outputs:
    """Reciprocal depths: 0 where nothing is, instead of infinity."""
    return (outputs[0].reciprocal(),)


def _depth_visibility(scene: MeshScene, **options: Any) -> Outputs:
    seen = depth_visibility(
        scene.points, scene.posed_vertices, scene.faces, scene.K, scene.viewmat, scene.width, scene.height, **options
    )
    return (seen.visibility,)


def _face_rotations(scene: MeshScene, **options: Any) -> Outputs:
    return tuple(face_rotations(scene.rest_vertices, scene.posed_vertices, scene.faces, **options))


def _pose_on_mesh(scene: MeshScene, **options: Any) -> Outputs:
    return tuple(
        pose_on_mesh(
            scene.posed_vertices, scene.faces, scene.face_index, scene.barycentrics, scene.vertex_quats,
            scene.area_ratio, scene.quats, scene.scales, vertex_index=scene.vertex_index, offsets=scene.offsets,
            vertex_area_ratio=scene.vertex_area_ratio, **options,
        )
    )  # fmt: skip


def _skin(scene: MeshScene, **options: Any) -> Outputs:
    skinned = skin(scene.rest_vertices, scene.covars, scene.skin_weights, scene.transforms, **options)
    return tuple(part for part in skinned if part is not None)


def _posing(scene: MeshScene, **options: Any) -> Outputs:
    vertex_quats, _, area_ratio, vertex_area_ratio = _face_rotations(scene, **options)
    turned = replace(
        scene, vertex_quats=vertex_quats, area_ratio=area_ratio, vertex_area_ratio=vertex_area_ratio
    )  # fmt: skip
    return _pose_on_mesh(turned, **options)


OPERATORS = {
    operator.name: operator
    for operator in (
        Operator(
            "rasterization", Scene, _rasterization, _torch_rasterization,
            leaves=("means", "quats", "scales", "opacities", "colors"), graded=1, image=True,
        ),
        Operator(
            "blend_weights", Scene, _blend_weights, lambda scene: (torch_rasterizer.draw(scene).alpha[None],),
        ),
        Operator(
            "blend_colors", Scene, lambda scene: (blend_colors(scene.weights, scene.colors)[None],),
            _torch_blend_colors, leaves=("colors",), vectorised=False, image=True, prepare=_weighted,
        ),
        Operator(
            "depth_map", MeshScene, _depth_map, lambda scene: (torch_mesh.depth_map(scene).depth,),
            comparable=_nearness,
        ),
        Operator(
            "depth_visibility", MeshScene, _depth_visibility, lambda scene: (torch_mesh.depth_visibility(scene),),
            leaves=("points",),
        ),
        Operator(
            "face_rotations", MeshScene, _face_rotations, lambda scene: tuple(torch_mesh.face_rotations(scene)),
            leaves=("rest_vertices", "posed_vertices"),
        ),
        Operator(
            "pose_on_mesh", MeshScene, _pose_on_mesh, lambda scene: tuple(torch_mesh.pose_on_mesh(scene)),
            leaves=(
                "posed_vertices", "barycentrics", "vertex_quats", "area_ratio", "vertex_area_ratio", "offsets",
                "quats", "scales",
            ),
        ),
        Operator(
            "skin", MeshScene, _skin, lambda scene: tuple(torch_mesh.skin(scene)),
            leaves=("rest_vertices", "covars", "skin_weights", "transforms"), vectorised=False,
        ),
        Operator(
            "posing", MeshScene, _posing, lambda scene: tuple(torch_mesh.pose(scene)),
            leaves=("rest_vertices", "posed_vertices", "barycentrics", "offsets", "quats", "scales"),
        ),
    )
}  # fmt: skip


@torch.no_grad()
def forward(call: Callable[..., Outputs], scene: Any, options: Mapping[str, Any]) -> Outputs:
    """The outputs, with nothing kept for a backward pass."""
    return call(scene, **options)


def gradients(
    operator: Operator,
    call: Callable[..., Outputs],
    scene: Any,
    options: Mapping[str, Any],
    weights: Outputs,
) -> Outputs:
    """A forward and a backward pass: gradients of the outputs' sum, weighted, by the operator's leaves."""
    leaves = {name: getattr(scene, name).detach().requires_grad_(True) for name in operator.leaves}
    outputs = call(replace(scene, **leaves), **options)[: len(weights)]
    return torch.autograd.grad(outputs, tuple(leaves.values()), weights)


def repeated_gradients(
    operator: Operator, call: Callable[..., Outputs], scene: Any, options: Mapping[str, Any], weights: Outputs
) -> Callable[[], Results]:
    """`gradients` as a call to be made often, with the outputs: what a call need not do again is done before."""
    leaves = {name: getattr(scene, name).detach().requires_grad_(True) for name in operator.leaves}
    live, inputs = replace(scene, **leaves), tuple(leaves.values())

    def run() -> Results:
        outputs = call(live, **options)
        taken = torch.autograd.grad(outputs[: len(weights)], inputs, weights)
        return Results(tuple(output.detach() for output in outputs), taken)

    return run


class Exact(NamedTuple):
    """What results are compared with: the float64 kernels on the same float32 numbers, with gsplat's rules."""

    outputs: Outputs
    weights: Outputs
    """Of the loss whose gradients are taken: random signs, 0 where rounding decides what is drawn."""
    gradients: Outputs
    judged: Tensor | None
    """Pixels where no decision hangs on rounding; None where every result counts."""

    @property
    def fragile_percent(self) -> float | None:
        """Share of the pixels that are not judged [%]."""
        return None if self.judged is None else 100 * float((~self.judged).double().mean())


def exact(operator: Operator, scene: Any) -> Exact:
    """The exact results of `operator` on `scene` (float32)."""
    wide = scene.to(dtype=torch.float64)
    judged = None
    if isinstance(scene, Scene):
        with torch.no_grad():
            judged = ~torch.stack([torch_rasterizer.draw(view).fragile for view in wide.views()])
    wide = operator.prepare(wide)
    outputs = forward(operator.call, wide, {})
    generator = torch.Generator().manual_seed(scene.seed)
    weights = []
    for output in outputs[: operator.graded]:
        signs = (torch.randint(0, 2, output.shape, generator=generator) * 2.0 - 1).to(output)
        weights.append(signs if judged is None else signs * judged[..., None])
    taken = gradients(operator, operator.call, wide, {}, tuple(weights)) if operator.leaves else ()
    return Exact(operator.comparable(outputs), tuple(weights), taken, judged)
