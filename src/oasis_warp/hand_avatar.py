"""`Avatar`: one person's hand, ready to be posed and drawn. No image, network or estimator is needed."""

from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.avatar.anchors import gaussian_corners
from oasis_warp.avatar.creases import Creases, find_creases
from oasis_warp.avatar.folds import Folds, find_folds
from oasis_warp.avatar.pose import Bend, in_even_light, light_around, mean_albedo, pose_gaussians
from oasis_warp.avatar.sky import NOTHING_HIDDEN
from oasis_warp.avatar.vertex_light import (
    SurfaceLight,
    mirror_surface_light,
    offset_to_camera,
    view_shares,
    with_photo,
    with_todays_light,
)
from oasis_warp.avatar.wrist import hand_up
from oasis_warp.core.camera import camera_center, orbit_camera
from oasis_warp.core.color import plain_background
from oasis_warp.core.config import WHITE
from oasis_warp.core.devices import check_device
from oasis_warp.core.hand_model import MANO_SHAPES, HandModel
from oasis_warp.core.mirror import (
    mirror_camera,
    mirror_canonical,
    mirror_hand,
    mirror_light,
    mirror_points,
    mirror_pose,
)
from oasis_warp.core.types import (
    Camera,
    CanonicalGaussians,
    Color,
    Gaussians,
    HandLight,
    HandPose,
    PosedHand,
    Render,
    Side,
)
from oasis_warp.data.avatar_file import DARK_HOLLOWS, load_avatar, save_avatar
from oasis_warp.data.stored_avatar import StoredAvatar, from_file, to_header, to_tensors
from oasis_warp.hand.contact import Touching, resolve_contact
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand.skinning import rest_hand, skin, skin_surface
from oasis_warp.hand.template import bundled_hand, chosen_hand
from oasis_warp.ops import check_finite, rest_mesh
from oasis_warp.ops.checks import check_shape
from oasis_warp.ops.cuda_graph import CapturedGraph, GraphCache, replayable, replayed
from oasis_warp.render import render


class AvatarParts(NamedTuple):
    """What is posed and drawn; of a left hand all of it in the mirror, where faces wind the other way."""

    hand: HandModel
    rest: PosedHand
    gaussians: CanonicalGaussians
    light: SurfaceLight | None
    folds: Folds | None
    """Which open in `light` when fingers bend."""
    creases: Creases | None
    """Which go flat in `light` when skin is stretched."""


class Avatar:
    """A hand made from a photo; see `oasis_warp.reconstruct`.

    A left hand is stored as its mirror image (x -> -x), a right one; its mirror image is what is posed. So a pose means
    the same on both sides: positive flexion closes, positive abduction goes to the thumb.

    `mesh` and `pose` take many poses at once: with an axis of size B before every part of the pose, their results have
    that axis too. Attributes are fixed; `with_looks`, `in_light` and `to` give other avatars.
    """

    def __init__(
        self,
        *,
        side: Side,
        shape: Float[Tensor, "S"],
        surface_offsets: Float[Tensor, "V 3"],
        gaussians: CanonicalGaussians,
        source_pose: HandPose,
        source_camera: Camera,
        light: HandLight | None = None,
        invented: Float[Tensor, "V"] | None = None,
        hand: HandModel | None = None,
    ):
        self.side: Side = side
        self.shape = shape
        """Shape coefficients of the hand model [standard deviations]."""
        self.surface_offsets = surface_offsets
        """From the model's surface at rest to the one that carries Gaussians [m]: onto the photo's outline, below
        the skin (`avatar.anchors.inset_offsets`), and by what the drawn outline still missed."""
        self._gaussians = gaussians
        self.source_pose = source_pose
        """The pose in the photo, in the frame of `source_camera`."""
        self.source_camera = source_camera
        """The camera of the square crop that the avatar was fitted to."""
        self.light = light
        """The photo's light, in which the hand is posed and drawn; of a left hand in the mirror. None where light is
        part of the colours, or even."""
        self.invented = invented
        """Share of each vertex's skin that is painted because no photo shows it; None where none is."""
        self.hand = (hand or bundled_hand()).to(self.device)
        plain = rest_hand(self.hand, shape)
        self.rest = plain._replace(vertices=plain.vertices + surface_offsets)
        """The right-handed surface at rest [m]."""

        left = side == "left"
        self._model = mirror_hand(self.hand) if left else self.hand
        self._rest = PosedHand(*map(mirror_points, self.rest)) if left else self.rest
        self._canonical = mirror_canonical(gaussians) if left else gaussians
        vertices = self._rest.vertices
        self._rest_mesh = vertices if vertices.requires_grad else rest_mesh(vertices, self.hand.faces, validate=False)
        self._light = self._folds = self._creases = None
        if light is not None:
            camera = mirror_camera(source_camera) if left else source_camera
            center = camera_center(camera.viewmat.to(vertices))
            photo = self._photo_surface()
            flat = self._surface_in(source_pose._replace(angles=named_pose(self.hand, "open")))  # as painted skin is
            corners = gaussian_corners(self.hand.faces, gaussians)
            known = with_photo(light, self.rest.vertices, photo, self.hand.faces, center)._replace(corners=corners)
            self._light = mirror_surface_light(known) if left else known
            self._folds = find_folds(self.hand, gaussians, invented, source_pose.angles.to(vertices))
            self._creases = find_creases(self.hand, gaussians, invented, photo, flat, self._folds)
        self._fixed = *(part for part in self._canonical if part is not None), vertices, self._rest.joints
        self._source_angles = source_pose.angles.to(self.shape)
        self._graphs = GraphCache()
        self._held: dict[str, Tensor] = {}
        self._made = True

    def __setattr__(self, name: str, value: Any) -> None:
        if "_made" in self.__dict__ and not name.startswith("_"):
            raise AttributeError(f"Avatar.{name}: attributes are fixed; use `with_looks` or make another Avatar.")
        super().__setattr__(name, value)

    def __repr__(self) -> str:
        return f"Avatar({self.side} hand, {len(self.gaussians.colors)} Gaussians, on {self.device})"

    def _photo_surface(self) -> Float[Tensor, "V 3"]:
        """Vertices in the photo's pose; of a left hand in the mirror, where faces wind outwards."""
        source = mirror_pose(self.source_pose) if self.side == "left" else self.source_pose
        return self._surface_in(source)

    def _surface_in(self, pose: HandPose) -> Float[Tensor, "V 3"]:
        """Vertices of the right-handed surface in a pose, without contact."""
        return skin_surface(self.hand, self.rest, HandPose(*(part.to(self.shape) for part in pose)))

    @property
    def gaussians(self) -> CanonicalGaussians:
        """Canonical, on the right-handed rest surface."""
        return self._gaussians

    @property
    def parts(self) -> AvatarParts:
        """The inputs of `pose`, for programs with a posing of their own."""
        return AvatarParts(self._model, self._rest, self._canonical, self._light, self._folds, self._creases)

    @property
    def device(self) -> torch.device:
        """Where the avatar's tensors are."""
        return self.gaussians.colors.device

    def held(self, name: str) -> HandPose:
        """The pose called `name`, one of `hand.poses.POSE_NAMES`, turned and placed as the hand in the photo.

        Fingers of every shape touch each other and the palm where those of the mean hand do.

        Raises:
            ValueError: no pose has that name.
        """
        if name not in self._held:
            self._held[name] = named_pose(self.hand, name, self.rest)
        return self.source_pose._replace(angles=self._held[name].to(self.source_pose.angles))

    def as_pose(self, pose: HandPose | str) -> HandPose:
        """A pose itself, or the one of that name, as `held`; a TypeError if it is neither."""
        if isinstance(pose, str):
            return self.held(pose)
        if not isinstance(pose, HandPose):
            raise TypeError(f"pose: expected a HandPose or a pose's name, got {type(pose).__name__}.")
        return pose

    def _checked(self, pose: HandPose | str, validate: bool) -> HandPose:
        """The pose in the avatar's precision and place."""
        pose = self.as_pose(pose)
        batch, sizes = ("B",) if pose.angles.ndim == 3 else (), {}
        hint = "One row for each joint but the wrist."
        check_shape("pose.angles", pose.angles, *batch, 15, 3, sizes=sizes, hint=hint)
        check_shape("pose.orientation", pose.orientation, *batch, 3, 3, sizes=sizes)
        check_shape("pose.translation", pose.translation, *batch, 3, sizes=sizes)
        if validate:
            check_finite(angles=pose.angles, orientation=pose.orientation, translation=pose.translation)
        return HandPose(*(part.to(self.shape) for part in pose))

    def _resolve_contact(self, vertices: Float[Tensor, "*B V 3"], pose: HandPose) -> Touching:
        """Posed vertices after contact: nothing gives way in the photo's pose, whose colours were learned there."""
        changes = (pose.angles.detach() - self._source_angles).flatten(-2)
        return resolve_contact(self.hand, vertices, self.side, changes)

    def mesh(self, pose: HandPose | str, *, validate: bool = True) -> PosedHand:
        """The surface that carries Gaussians, in `pose` [m]; the faces of a left hand wind the other way.

        Fingers and palm give way to each other where they touch, as in `hand.contact.resolve_contact`: a constant to
        derivatives. In the photo's pose they do not, and more and more up to `hand.contact.FREE` away from it.

        Args:
            pose: One, or with an axis in front of every part many; or the name of one, as in `held`.
            validate: Look at the pose's values too. Waits for a CUDA device if they are there.

        Raises:
            TypeError: `pose` is neither a pose nor a name.
            ValueError: a part of the pose has another shape or is not finite, or no pose has that name.
        """
        pose = self._checked(pose, validate)
        posed = skin(self._model, self._rest, pose)
        return posed._replace(vertices=self._resolve_contact(posed.vertices, pose).vertices)

    def pose(self, pose: HandPose | str, *, camera: Camera | None = None, validate: bool = True) -> Gaussians:
        """The Gaussians in `pose`, in the world of its orientation and translation, where its light stays too.

        Args:
            pose: One, or with an axis in front of every part many: then means, quats and scales have it too, and
                colours where there is a `light`. Or the name of one, as in `held`.
            camera: What will see them: the photo's shade fades as it leaves the photo's side. Without one, colours do
                not depend on the view: they are those seen from some degrees beside the photo's camera, without the
                photo's shade near the outlines of fingers.
            validate: Look at the pose's values too. Waits for a CUDA device if they are there.

        Raises:
            TypeError: `pose` is neither a pose nor a name.
            ValueError: a part of the pose has another shape or is not finite, or no pose has that name.
        """
        checked = self._checked(pose, validate)
        center = None
        if camera is not None:
            check_shape("camera.viewmat", camera.viewmat, 4, 4)
            if validate:
                check_finite(viewmat=camera.viewmat)
            center = camera_center(camera.viewmat.to(self.shape))
        posed = self._resolve_contact(skin_surface(self._model, self._rest, checked), checked)
        bend = None
        if self._folds is not None and self._creases is not None:
            bend = Bend(self._folds, checked.angles, self._creases)
        return pose_gaussians(
            self._canonical, self.hand.faces, self._rest_mesh, posed.vertices, self._light, center, bend,
            posed.closeness,
        )  # fmt: skip

    @torch.no_grad()
    def orbit_camera(self, pose: HandPose | str, azimuth: float, elevation: float = 0.0, size: int = 256) -> Camera:
        """A camera that frames the hand in one `pose`, as `core.camera.orbit_camera` does; it moves around the arm.

        Raises as `mesh`.
        """
        pose = self._checked(pose, validate=True)
        check_shape("pose.angles", pose.angles, 15, 3, hint="One pose a camera.")
        vertices = self.mesh(pose, validate=False).vertices
        return orbit_camera(vertices, azimuth, elevation, size, up=hand_up(self.hand, vertices))

    @torch.no_grad()
    def shade_shares(self, vertices: Float[Tensor, "V 3"], camera: Camera) -> tuple[float, float]:
        """How much of the photo's shade a picture of the posed `vertices` by `camera` shows: two numbers from 0 to 1.

        The first is for all shade. Where the photo may show another part of the hand (`HandLight.doubt`), the shade of
        Gaussians is also multiplied by the second. Pictures with the same two numbers have the same colours.
        """
        if self._light is None or self._light.photo_eye is None:
            return 1.0, 1.0
        eye = offset_to_camera(vertices, camera_center(camera.viewmat.to(vertices)))
        anywhere, in_doubt = view_shares(self._light.photo_eye, eye).tolist()
        return anywhere, in_doubt

    def render(
        self, camera: Camera, pose: HandPose | str, background: Color = WHITE, *, validate: bool = True
    ) -> Render:
        """A picture of the hand in `pose` over a plain `background`; differentiable in the pose and the camera.

        On CUDA the first picture of a size is recorded, and where no gradient is wanted the next ones replay it.

        Args:
            camera: What sees the hand.
            pose: One pose, or the name of one, as in `held`.
            background: What is seen beside it, and through it.
            validate: Look at the values of camera and pose too. Waits for a CUDA device if they are there.

        Raises:
            TypeError: `pose` is neither a pose nor a name.
            ValueError: a part of the pose or the camera has another shape or is not finite, or no pose has that name.
        """
        pose = self.as_pose(pose)
        check_shape("pose.angles", pose.angles, 15, 3, hint="One pose a picture.")
        check_shape("pose.orientation", pose.orientation, 3, 3)
        check_shape("pose.translation", pose.translation, 3)
        check_shape("camera.viewmat", camera.viewmat, 4, 4)
        check_shape("camera.K", camera.K, 3, 3)
        color = background if isinstance(background, Tensor) else torch.tensor(background)
        check_shape("background", color, 3)
        if validate:
            check_finite(background=color)
        if not isinstance(background, Tensor):
            color = plain_background(tuple(background), 1, like=self.shape)[0]
        named = {**pose._asdict(), "viewmat": camera.viewmat, "K": camera.K}
        inputs = (*named.values(), color)

        def draw(*parts: Tensor) -> tuple[Tensor, ...]:
            *posed, viewmat, K, color = (part.to(self.shape) for part in parts)
            camera = Camera(viewmat, K, *size)
            gaussians = self.pose(HandPose(*posed), camera=camera, validate=False)
            return tuple(render(gaussians, camera, background=color))

        size = camera.width, camera.height
        if self.shape.dtype == torch.float32 and replayable(self.device, (*inputs, *self._fixed)):

            def record() -> CapturedGraph:
                return CapturedGraph(draw, inputs, self.shape, len(named))

            return Render(*replayed(self._graphs, size, record, draw, inputs, tuple(named) if validate else ()))
        if validate:
            check_finite(**named)
        return Render(*draw(*inputs))

    def in_even_light(self) -> "Avatar":
        """The same hand without its photo's light, as far as that is known."""
        return self.with_looks(in_even_light(self.gaussians, self.light) if self.light else self.gaussians, None)

    def in_light(self, harmonics: Float[Tensor, "9 3"]) -> "Avatar":
        """The same hand in another light instead of its photo's, as bright on average.

        The photo's shade stays where skin faces as in the photo. Light that is part of the colours stays too.

        Args:
            harmonics: Result of `oasis_warp.environment_light` or `studio_light`, in the photo's camera's world.

        Raises:
            ValueError: of another shape, or not finite.
        """
        check_shape("harmonics", harmonics, 9, 3)
        check_finite(harmonics=harmonics)
        light = light_around(self.gaussians, self.light, harmonics)
        light = mirror_light(light) if self.side == "left" else light
        if self.light is not None:
            light = light._replace(shade=self.light.shade, facing=self.light.facing, doubt=self.light.doubt)
        return self.with_looks(self.gaussians, light)

    def with_looks(self, gaussians: CanonicalGaussians, light: HandLight | None) -> "Avatar":
        """The same hand with other Gaussians, in `light`."""
        return Avatar(**self._stored()._replace(gaussians=gaussians, light=light)._asdict(), hand=self.hand)

    def to(self, device: torch.device | str) -> "Avatar":
        """The same hand on `device`, without gradients; itself if nothing changes."""
        stored = self._stored()
        tensors = to_tensors(stored)
        if not any(tensor.requires_grad or tensor.device != torch.device(device) for tensor in tensors.values()):
            return self
        moved = {name: tensor.detach().to(device) for name, tensor in tensors.items()}
        return Avatar(**from_file(moved, to_header(stored, self.hand))._asdict(), hand=self.hand)

    def _stored(self) -> StoredAvatar:
        return StoredAvatar(*(getattr(self, name) for name in StoredAvatar._fields))

    def save(self, path: Path | str) -> None:
        """Write the avatar file (safetensors, versioned; see docs/avatar_file.md)."""
        stored = self._stored()
        save_avatar(Path(path), to_tensors(stored), to_header(stored, self.hand))

    @classmethod
    def load(
        cls, path: Path | str, device: torch.device | str = "cpu", *, mano_dir: Path | str | None = None
    ) -> "Avatar":
        """Read an avatar file.

        Args:
            path: Path of the file.
            device: Where its tensors shall be.
            mano_dir: Folder with MANO's files, for an avatar that was made with them; see `chosen_hand`.

        Raises:
            InputError: not an avatar file, damaged, of a newer version, or made with a hand model that is not here; or
                there is no such device.
        """
        check_device(device)
        hand = bundled_hand()
        sizes = {"S": hand.shape_basis.shape[2], "V": len(hand.template), "F": len(hand.faces)}
        tensors, header = load_avatar(Path(path), {hand.name: sizes, "mano": sizes | {"S": MANO_SHAPES}})
        if header["hand_model"] != hand.name:
            hand = chosen_hand("mano", mano_dir)
        stored = from_file({name: value.to(device) for name, value in tensors.items()}, header)
        avatar = cls(**stored._asdict(), hand=hand)
        return avatar._with_todays_light(header["version"]) if header["version"] < DARK_HOLLOWS else avatar

    @torch.no_grad()
    def _with_todays_light(self, version: int) -> "Avatar":
        """An avatar of a file of an older version, whose light followed other rules. The photo's own view stays."""
        if self.light is None or (self.light.albedo is None and version > NOTHING_HIDDEN):
            return self
        albedo = mean_albedo(self.gaussians, self.light)
        photo = self._photo_surface()
        light = with_todays_light(version, self.light, albedo, self.rest.vertices, photo, self.hand.faces)
        return self.with_looks(self.gaussians, light)
