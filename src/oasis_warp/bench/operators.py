"""The operators as they are measured: calls on scenes, the same in torch, gradients, and exact results."""

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from oasis_warp import ops, reference
from oasis_warp.bench.scenes import GaussianScene, MeshScene
from oasis_warp.ops import BlendWeights, blend_colors, blend_weights
from oasis_warp.reference import rasterization, visibility
from oasis_warp.reference.errors import relative_error
from oasis_warp.reference.rasterization import GSPLAT, Picture, Rules

Outputs = tuple[Tensor, ...]
Pass = Literal["forward", "forward + backward"]
Call = Callable[..., Outputs]
"""From a scene and options to tensors; the first is the main one."""
FIELDS = {"vertices": "posed_vertices", "means": "rest_vertices", "weights": "skin_weights"}
"""Fields of a mesh scene by names of arguments, where they differ."""


class Results(NamedTuple):
    """The outputs of a call, and its gradients in passes that take some."""

    values: Outputs
    gradients: Outputs = ()

    @property
    def tensors(self) -> Outputs:
        """Both."""
        return *self.values, *self.gradients


def unchanged(value: Any) -> Any:
    """The value."""
    return value


@dataclass(frozen=True)
class WeightedColors:
    """Arguments of `blend_colors`."""

    weights: BlendWeights
    colors: Tensor


@dataclass(frozen=True)
class Operator:
    """One public function of `oasis_warp.ops`, or, as "posing", face_rotations and pose_on_mesh in a row."""

    name: str
    scene: type[GaussianScene] | type[MeshScene]
    call: Call
    """Takes what `prepare` makes of a scene."""
    torch_call: Callable[[Any], Outputs]
    """The same in torch."""
    leaves: tuple[str, ...] = ()
    """Fields of the scene that gradients are taken by; none where the operator has no gradient."""
    graded: int | None = None
    """How many of the outputs the loss is made of; all when None."""
    vectorised: bool = True
    """Whether it has generic kernels for the CPU beside vectorised ones."""
    image: bool = False
    """Whether the first output is an image in [0, 1]."""
    comparable: Callable[[Outputs], Outputs] = unchanged
    """Outputs in the form that errors are taken of."""
    prepare: Callable[[Any], Any] = unchanged
    """Untimed work on a scene before calls."""

    @property
    def passes(self) -> tuple[Pass, ...]:
        """Those that it has."""
        return ("forward", "forward + backward") if self.leaves else ("forward",)


def calling(
    function: Callable[..., Any], scene_type: type, arguments_of: Callable[..., Any] | None = None,
    n_outputs: int | None = None,
) -> Call:  # fmt: skip
    """A call with the fields of a scene as arguments; names are those of the parameters, or as in `FIELDS`.

    Args:
        function: An operator or its reference.
        scene_type: The scenes.
        arguments_of: The function whose parameters count; `function` when None.
        n_outputs: How many of the results to return; all tensors when None.
    """
    known = {field.name for field in fields(scene_type)}
    parameters = inspect.signature(arguments_of or function).parameters
    sources = {name: name if name in known else FIELDS.get(name, "") for name in parameters}
    sources = {name: source for name, source in sources.items() if source in known}

    def call(scene: Any, **options: Any) -> Outputs:
        results = function(**{name: getattr(scene, source) for name, source in sources.items()}, **options)
        return tuple(result for result in results[:n_outputs] if isinstance(result, Tensor))

    return call


def declared(name: str, scene_type: type, n_outputs: int | None = None, **about: Any) -> Operator:
    """A public operator and the reference of its declaration, which takes the same arguments.

    Gradients are taken by all inputs that have one and that the scenes hold, if `about` does not say otherwise.
    """
    declaration, known = ops.DECLARATIONS[name], {field.name for field in fields(scene_type)}
    inputs = (name if name in known else FIELDS.get(name) for name in declaration.differentiable)
    about = {"leaves": tuple(name for name in inputs if name is not None)} | about
    torch_call = calling(reference.named(declaration.reference), scene_type, declaration.function, n_outputs)
    return Operator(name, scene_type, calling(declaration.function, scene_type, None, n_outputs), torch_call, **about)


def draw_in_torch(scene: GaussianScene, rules: Rules = GSPLAT) -> Picture:
    """The images of a scene by the reference rasterizer."""
    return rasterization.rasterization(
        scene.means, scene.quats, scene.scales, scene.opacities, scene.colors, scene.viewmats, scene.Ks,
        scene.width, scene.height, scene.backgrounds, **rules._asdict(),
    )  # fmt: skip


def _blend_weights(scene: GaussianScene, **options: Any) -> BlendWeights:
    return blend_weights(
        scene.means, scene.quats, scene.scales, scene.opacities, scene.viewmats[0], scene.Ks[0],
        scene.width, scene.height, **options,
    )  # fmt: skip


@torch.no_grad()
def _weighted(scene: GaussianScene) -> WeightedColors:
    return WeightedColors(_blend_weights(scene), scene.colors)


def _blend_colors_in_torch(scene: WeightedColors) -> Outputs:
    return ((scene.weights.matrix @ scene.colors).view(1, *scene.weights.alphas.shape[:2], -1),)


def _inverse_depth(outputs: Outputs) -> Outputs:
    """Reciprocal depths: 0 over the background, instead of infinity."""
    return (outputs[0].reciprocal(),)


def _depths_in_torch(scene: MeshScene) -> Outputs:
    return (visibility.depth_map(scene.posed_vertices, scene.faces, scene.camera, dense=False).depth,)


def _visibility_in_torch(scene: MeshScene) -> Outputs:
    return (visibility.depth_visibility(scene.points, scene.posed_vertices, scene.faces, scene.camera, dense=False),)


def _posing(face_rotations: Call, pose_on_mesh: Call) -> Call:
    """`face_rotations`, and `pose_on_mesh` by its results."""

    def call(scene: MeshScene, **options: Any) -> Outputs:
        vertex_quats, _, area_ratio, vertex_area_ratio = face_rotations(scene, **options)
        rotated = replace(
            scene, vertex_quats=vertex_quats, area_ratio=area_ratio, vertex_area_ratio=vertex_area_ratio
        )  # fmt: skip
        return pose_on_mesh(rotated, **options)

    return call


FACE_ROTATIONS = declared("face_rotations", MeshScene, 4)
POSE_ON_MESH = declared("pose_on_mesh", MeshScene)
OPERATORS = {
    operator.name: operator
    for operator in (
        declared(
            "rasterization", GaussianScene, 2,
            leaves=("means", "quats", "scales", "opacities", "colors"), graded=1, image=True,
        ),
        Operator(
            "blend_weights", GaussianScene, lambda scene, **options: (_blend_weights(scene, **options).alphas[None],),
            lambda scene: (draw_in_torch(scene).alphas,),
        ),
        Operator(
            "blend_colors", GaussianScene, lambda scene: (blend_colors(scene.weights, scene.colors)[None],),
            _blend_colors_in_torch, leaves=("colors",), vectorised=False, image=True, prepare=_weighted,
        ),
        Operator(
            "depth_map", MeshScene, calling(ops.depth_map, MeshScene, n_outputs=1), _depths_in_torch,
            comparable=_inverse_depth,
        ),
        Operator(
            "depth_visibility", MeshScene, calling(ops.depth_visibility, MeshScene, n_outputs=1),
            _visibility_in_torch, leaves=("points",),
        ),
        FACE_ROTATIONS,
        POSE_ON_MESH,
        declared("skin", MeshScene, vectorised=False),
        Operator(
            "posing", MeshScene, _posing(FACE_ROTATIONS.call, POSE_ON_MESH.call),
            _posing(FACE_ROTATIONS.torch_call, POSE_ON_MESH.torch_call),
            leaves=("rest_vertices", "posed_vertices", "barycentrics", "offsets", "quats", "scales"),
        ),
    )
}  # fmt: skip


@torch.no_grad()
def forward(call: Call, scene: Any, options: Mapping[str, Any]) -> Outputs:
    """The outputs, with nothing saved for a backward pass."""
    return call(scene, **options)


def with_gradients(
    operator: Operator, call: Call, scene: Any, options: Mapping[str, Any], weights: Outputs
) -> Callable[[], Results]:
    """A forward and a backward pass to repeat: gradients of the weighted outputs by the operator's leaves."""
    leaves = {name: getattr(scene, name).detach().requires_grad_(True) for name in operator.leaves}
    live, inputs = replace(scene, **leaves), tuple(leaves.values())

    def run() -> Results:
        outputs = call(live, **options)
        taken = torch.autograd.grad(outputs[: len(weights)], inputs, weights)
        return Results(tuple(output.detach() for output in outputs), taken)

    return run


def one_pass(
    operator: Operator, call: Call, scene: Any, pass_: str, options: Mapping[str, Any], weights: Outputs
) -> Callable[[], Results]:
    """A pass of a call on a scene, to repeat; `weights` are those of the loss."""
    if pass_ == "forward":
        return lambda: Results(forward(call, scene, options))
    return with_gradients(operator, call, scene, options, weights)


class Exact(NamedTuple):
    """What results are compared with: the float64 kernels on the same float32 numbers, with gsplat's rules."""

    values: Outputs
    """In comparable form."""
    gradients: Outputs
    weights: Outputs = ()
    """Weights of the loss whose gradients are taken: random signs in float32, 0 where rounding decides what is
    drawn."""
    judged: Tensor | None = None
    """Pixels [C, H, W] where no decision depends on rounding; None where every result counts."""
    comparable: Callable[[Outputs], Outputs] = unchanged

    @property
    def fragile_percent(self) -> float | None:
        """Share of the pixels that are not judged [%]."""
        return None if self.judged is None else 100 * float((~self.judged).double().mean())

    def value_error(self, outputs: Outputs) -> float:
        """Largest relative error of any output, over the judged pixels."""
        judged = None if self.judged is None else self.judged[..., None]
        return max(
            relative_error(o, e, None if judged is None else judged.expand_as(e))
            for o, e in zip(self.comparable(outputs), self.values, strict=True)
        )

    def gradient_error(self, gradients: Outputs) -> float | None:
        """Largest relative error of any gradient; None where there is none."""
        return max(map(relative_error, gradients, self.gradients), default=None)


def exact(operator: Operator, scene: Any) -> Exact:
    """The exact results of `operator` on `scene` (float32)."""
    wide = scene.to(dtype=torch.float64)
    judged = None
    if isinstance(scene, GaussianScene):
        with torch.no_grad():
            judged = torch.cat([~draw_in_torch(view).fragile for view in wide.views()])
    wide = operator.prepare(wide)
    outputs = forward(operator.call, wide, {})
    generator = torch.Generator().manual_seed(scene.seed)
    weights = []
    for output in outputs[: operator.graded]:
        signs = (torch.randint(0, 2, output.shape, generator=generator) * 2.0 - 1).to(output)
        weights.append(signs if judged is None else signs * judged[..., None])
    taken = with_gradients(operator, operator.call, wide, {}, tuple(weights))().gradients if operator.leaves else ()
    single = tuple(w.to(torch.float32) for w in weights)
    return Exact(operator.comparable(outputs), taken, single, judged, operator.comparable)
