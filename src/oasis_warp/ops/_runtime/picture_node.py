"""Float32 `rasterization` on CUDA as one node of autograd, for eager calls without special options."""

import weakref
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import Function

from oasis_kernels.rasterize.tiles_cuda import INDEX_BITS
from oasis_warp.core.tracing import is_traced
from oasis_warp.ops._runtime.launch import start
from oasis_warp.ops._runtime.pair_counts import Counts
from oasis_warp.ops._runtime.picture_call import Drawn, Gradients, Needs, Options, Scene
from oasis_warp.ops._runtime.picture_extension import add_adjoints, table_of
from oasis_warp.ops._runtime.picture_plan import Plan, polled_words
from oasis_warp.ops._runtime.plans import Plans, differentiable_once, shapes_of
from oasis_warp.ops._runtime.rasterization_checks import check_cameras, check_colors, check_gaussians
from oasis_warp.ops._runtime.rules import current_rules
from oasis_warp.ops._runtime.transforms import in_forward_mode

_plans = Plans()


def plan_for(scene: Scene, options: Options) -> Plan | None:
    """The plan for a call; None where the separate operators must draw it.

    Raises:
        TypeError: an argument is of the wrong kind.
        ValueError: shapes, types, devices or numbers that do not belong together.
    """
    if is_traced() or in_forward_mode():
        return None
    index = scene.means.get_device()
    shapes = shapes_of(scene, index)
    if shapes is None:
        return None
    key = index, options, current_rules(), *shapes
    if (scene.Ks.requires_grad and torch.is_grad_enabled()) or torch.cuda.is_current_stream_capturing():
        return None
    try:
        plan = _plans.plans.get(key)
    except TypeError:  # an option that is not a number, which the checks refuse
        return None
    return plan or _checked_plan(scene, options, key)


def _checked_plan(scene: Scene, options: Options, key: tuple[Any, ...]) -> Plan | None:
    means, quats, scales, covars, opacities, colors, viewmats, Ks, backgrounds = scene
    check_gaussians(means, quats, scales, covars, opacities)
    check_cameras(viewmats, Ks, means, *options[:7])
    check_colors(colors, backgrounds, means, len(viewmats))
    if not (len(means) and len(viewmats)) or len(means) > 1 << INDEX_BITS:
        return None
    start()
    plan = Plan(scene, options, current_rules())
    plan.table = table_of(plan, polled_words())
    return _plans.keep(key, plan)


def draw(plan: Plan, scene: Scene, validate: bool) -> tuple[Tensor, Tensor, "Meta"] | None:
    """Images as blended, alpha and meta; None where `validate` finds a bad value."""
    tracked = torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in scene)
    if plan.table is not None:
        bad, pairs, longest, image, alphas, workspace, call = plan.table.draw(
            plan, plan.stream(), *plan.expected, validate, tracked, scene
        )
        if bad:
            return None
        plan.learn(Counts(pairs, longest))
        if image is not None:
            return image, alphas, Meta(plan, scene, workspace, call)
        # There was no memory for as many pairs, and is now.
    tracking = _Tracked() if tracked else None
    if tracking is not None:
        image, alphas = _draw(plan, validate, tracking, *scene)
        if tracking.workspace is None:
            return None
        workspace = tracking.workspace
    else:
        drawn = plan.draw(scene, keep=False, validate=validate)
        if drawn is None:
            return None
        image, alphas, workspace = drawn.image, drawn.alphas, drawn.workspace
        assert image is not None and alphas is not None
    if plan.n_drawn < plan.channels:
        image = image[..., : plan.n_drawn]
    return image, alphas, Meta(plan, scene, workspace, tracking)


class _Tracked:
    """What the adjoint needs from the picture's `meta` and workspace."""

    def __init__(self) -> None:
        self.means2d: Callable[[], Tensor | None] | None = None
        """The `means2d` that `meta` has computed, if it was read."""
        self.workspace: Tensor | None = None


def _retaining(looked_at: Callable[[], Tensor | None] | None) -> Tensor | None:
    """The `means2d` that retains its gradient, if any."""
    means2d = looked_at() if looked_at is not None else None
    if means2d is None:
        return None
    if means2d._backward_hooks:
        raise RuntimeError(
            "meta['means2d']: expected retain_grad(), got a hook, which would see no gradient of the picture. "
            "Draw with absgrad=True, or read means2d.grad after backward."
        )
    return means2d if means2d.retains_grad else None


class _Draw(Function):
    @staticmethod
    def forward(ctx: Any, plan: Plan, validate: bool, tracking: _Tracked, *tensors: Tensor | None) -> tuple[Any, ...]:
        scene = Scene(*tensors)  # pyright: ignore[reportArgumentType]
        drawn = plan.draw(scene, keep=True, validate=validate)
        if drawn is None:
            return None, None
        image, alphas, channels, backgrounds, tracking.workspace, *saved = drawn
        ctx.save_for_backward(*tensors, channels, backgrounds)
        ctx.plan, ctx.tracking, ctx.saved = plan, tracking, saved
        ctx.set_materialize_grads(False)
        return image, alphas

    @staticmethod
    def backward(ctx: Any, g_image: Tensor | None, g_alphas: Tensor | None) -> tuple[Any, ...]:
        if g_image is None and g_alphas is None:
            return (None,) * (3 + len(Scene._fields))
        *tensors, channels, backgrounds = ctx.saved_tensors
        tracking, needed = ctx.tracking, ctx.needs_input_grad
        drawn = Drawn(None, None, channels, backgrounds, tracking.workspace, *ctx.saved)
        gradients = _differentiate(
            ctx.plan, tracking.means2d, Needs(*needed[3:10], needed[11]), Scene(*tensors), drawn, g_image, g_alphas
        )
        return None, None, None, *gradients


def _differentiate(
    plan: Plan, looked_at: Callable[[], Tensor | None] | None, needs: Needs, scene: Scene, drawn: Drawn,
    g_image: Tensor | None, g_alphas: Tensor | None,
) -> Any:  # fmt: skip
    means2d = _retaining(looked_at)
    gradients, gradient = plan.draw_backward(scene, drawn, g_image, g_alphas, needs, means2d is not None)
    if means2d is not None and gradient is not None:
        means2d.grad = gradient.clone() if means2d.grad is None else means2d.grad + gradient
    return differentiable_once("rasterization", scene, gradients)


def differentiate_for_extension(
    plan: Plan, looked_at: Callable[[], Tensor | None] | None, needed: Sequence[bool], tensors: Sequence[Tensor | None],
    saved: tuple[Tensor, Tensor, int], *incoming: Tensor | None,
) -> Any:  # fmt: skip
    """Gradients by the tensors of a scene that the C++ node has drawn: of a kind that is new to it, or rare.

    Args:
        plan: Plan of the picture.
        looked_at: As `_Tracked.means2d`.
        needed: By tensor of the scene, whether its gradient is wanted.
        tensors: The scene.
        saved: Workspace, lists and the number of pairs.
        *incoming: Gradients by image and alpha.
    """
    scene, needs = Scene(*tensors), Needs(*needed[:7], needed[8])  # pyright: ignore[reportArgumentType]
    channels, backgrounds = scene.colors.contiguous(), scene.backgrounds
    backgrounds = None if backgrounds is None else backgrounds.contiguous()
    add_adjoints(plan, plan.table, any(needs[:5]) or needs.viewmats, needs.colors)
    drawn = Drawn(None, None, channels, backgrounds, *saved)
    return _differentiate(plan, looked_at, needs, scene, drawn, *incoming)


# Below Function.apply, which takes 3 us to look for functorch: `is_traced` has.
_draw: Callable[..., Any] = super(Function, _Draw).apply  # pyright: ignore[reportAttributeAccessIssue]


class _Project(Function):
    """The projected Gaussians of a picture, for uses besides drawing."""

    @staticmethod
    def forward(ctx: Any, plan: Plan, workspace: Tensor, versions: list[int], *tensors: Tensor | None) -> Any:
        ctx.save_for_backward(workspace, *tensors)
        ctx.plan, ctx.unchanged = plan, versions == _versions(tensors)
        ctx.set_materialize_grads(False)
        return plan.part(workspace, "means2d", torch.float32, 2), plan.part(workspace, "depths", torch.float32)

    @staticmethod
    def backward(ctx: Any, g_means2d: Tensor | None, g_depths: Tensor | None) -> tuple[Any, ...]:
        workspace, *tensors = ctx.saved_tensors
        if not ctx.unchanged:
            raise RuntimeError(
                "meta: expected the arguments as they were drawn, got some that were changed in place before the first "
                "look at means2d or depths. Look before, or give copies."
            )
        scene, needs = Scene(*tensors), Needs(*ctx.needs_input_grad[3:10], False)
        incoming = [None if g is None else g.contiguous() for g in (g_means2d, g_depths)]
        by_means2d, by_depths = (0 if g is None else g.data_ptr() for g in incoming)
        *shapes, viewmats = ctx.plan.unproject(scene, workspace, by_means2d, 0, by_depths, needs)
        return (
            None,
            None,
            None,
            *differentiable_once("rasterization", scene, Gradients(*shapes, None, None, viewmats, None, None)),
        )


def _versions(tensors: Any) -> list[int]:
    return [tensor._version for tensor in tensors if tensor is not None]


UNPROJECTED = "colors", "backgrounds"
"""Tensors of a scene that are not arguments of the projection."""
UNMADE = {"means2d": "_project", "depths": "_project", "opacities": "_opacities", "conics": "_read", "radii": "_read"}
"""How `Meta` makes its tensors. By name: a bound method would keep a picture alive until garbage is collected."""


class Meta(dict[str, Any]):
    """gsplat's `meta` of a picture: a dictionary whose tensors are computed when they are first read."""

    def __init__(self, plan: Plan, scene: Scene, workspace: Tensor, tracking: Any) -> None:
        options = plan.options
        super().__init__(
            camera_ids=None, gaussian_ids=None, means2d=None, depths=None, conics=None, radii=None, opacities=None,
            tile_size=options.tile_size, width=options.width, height=options.height, n_cameras=plan.n_cameras,
        )  # fmt: skip
        versions = [] if tracking is None else _versions((*scene[:5], *scene[6:8]))
        self._unmade = dict(UNMADE)
        self._call = plan, scene, workspace, tracking, versions

    def _project(self) -> None:
        plan, scene, workspace, tracking, versions = self._call
        with torch.enable_grad() if tracking is not None else torch.no_grad():
            projected = [None if name in UNPROJECTED else t for name, t in zip(Scene._fields, scene, strict=True)]
            means2d, depths = _Project.apply(plan, workspace, versions, *projected)  # pyright: ignore[reportGeneralTypeIssues]
        if tracking is not None:
            tracking.means2d = weakref.ref(means2d)
        for name, tensor in (("means2d", means2d), ("depths", depths)):
            if self._unmade.pop(name, None):
                super().__setitem__(name, tensor)

    def _opacities(self) -> None:
        plan, scene, _, tracking, _ = self._call
        with torch.enable_grad() if tracking is not None else torch.no_grad():
            self["opacities"] = scene.opacities.expand(plan.n_cameras, -1)

    def _read(self) -> None:
        plan, _, workspace, _, _ = self._call
        with torch.no_grad():
            for name, dtype, size in (("conics", torch.float32, 3), ("radii", torch.int32, 2)):
                if self._unmade.pop(name, None):
                    super().__setitem__(name, plan.part(workspace, name, dtype, size))

    def _make_all(self) -> None:
        while self._unmade:
            getattr(self, next(iter(self._unmade.values())))()

    def __getitem__(self, key: str) -> Any:
        make = self._unmade.get(key)
        if make is not None:
            getattr(self, make)()
        return super().__getitem__(key)

    def __setitem__(self, key: str, value: Any) -> None:
        self._unmade.pop(key, None)
        super().__setitem__(key, value)

    def __reduce__(self) -> tuple[Any, ...]:
        return dict, (dict(self),)

    def __iter__(self) -> Iterator[str]:  # without it, dict(meta) and **meta would read past __getitem__
        return super().__iter__()


def _reading(name: str) -> Callable[..., Any]:
    """The method of dict, after all tensors are made."""
    method = getattr(dict, name)

    def read(self: Meta, *arguments: Any, **named: Any) -> Any:
        self._make_all()
        return method(self, *arguments, **named)

    return read


for _name in ("get", "values", "items", "pop", "popitem", "setdefault", "copy", "update", "clear", "__delitem__",
              "__eq__", "__ne__", "__or__", "__ror__", "__ior__", "__repr__"):  # fmt: skip
    setattr(Meta, _name, _reading(_name))
