"""The nouns: what one stage hands to the next.

Conventions, once for all of them: metres, radians, pixels with centres at .5; OpenCV cameras (x right, y down, z
forward); quaternions wxyz; images are sRGB as in the photo, in [0, 1] once they are float.
"""

from typing import Literal, NamedTuple

from jaxtyping import Float, Int, UInt8
from torch import Tensor

Side = Literal["left", "right"]
Color = tuple[float, float, float] | Float[Tensor, "3"]
"""sRGB in [0, 1]."""


class Photo(NamedTuple):
    """An upright colour photo."""

    rgb: UInt8[Tensor, "H W 3"]
    """sRGB, EXIF orientation applied."""
    alpha: Float[Tensor, "H W"] | None
    """The file's own alpha channel in [0, 1], where it says anything."""
    focal: float | None
    """Focal length [px] of this array, from EXIF."""
    name: str
    """What to call it in messages: the file's name."""
    shrink: float
    """Size of this array over the size of the file, 1 unless a huge file was scaled down."""


class Landmarks(NamedTuple):
    """The 21 points of one hand: wrist, then base to tip of thumb, index, middle, ring, little."""

    xy: Float[Tensor, "21 2"]
    """Photo coordinates [px]."""
    world: Float[Tensor, "21 3"] | None
    """Metric points of a mean hand [m]: x right, y down, z away from the camera; None when the user gave 2D only."""
    side: Side
    side_score: float
    """Confidence in the side, 0.5 to 1."""
    presence: float
    """The network's probability that there is a hand, 0 to 1."""
    source: str
    """How it was found: "network", "network (margin)", "file" ..."""


class Camera(NamedTuple):
    """A pinhole camera (OpenCV axes)."""

    viewmat: Float[Tensor, "4 4"]
    """World to camera."""
    K: Float[Tensor, "3 3"]
    """Intrinsics [px]."""
    width: int
    height: int


class HandPose(NamedTuple):
    """Joint angles and the place of one hand; a left hand's pose describes the mirrored model (x -> -x)."""

    angles: Float[Tensor, "15 3"]
    """Flexion, abduction, twist [rad] of joints 1 to 15 about `HandModel.pose_axes`, 0 at rest."""
    orientation: Float[Tensor, "3 3"]
    """Rotation from the hand's frame to the world."""
    translation: Float[Tensor, "3"]
    """Where the origin of the hand's frame lies in the world [m]."""


class PosedHand(NamedTuple):
    """The surface of the hand at rest or in a pose, in metres."""

    vertices: Float[Tensor, "V 3"]
    joints: Float[Tensor, "16 3"]
    tips: Float[Tensor, "5 3"]


class SurfaceReading(NamedTuple):
    """Place and colour of the skin that each pixel shows, as a network reads the photo; a square of R x R samples."""

    places: Float[Tensor, "R R 3"]
    """On the bundled hand at rest [m]."""
    spread: Float[Tensor, "R R"]
    """Scale of their error [m]; infinite where the network sees no hand."""
    albedo: Float[Tensor, "R R 3"]
    """sRGB colour of the skin in even white light."""
    left: float
    top: float
    side: float
    """Side of the square [px of the photo]."""


class HandFit(NamedTuple):
    """One hand of a photo, explained by the model. All in the photo's own frame, a left hand included."""

    side: Side
    shape: Float[Tensor, "S"]
    """Shape coefficients in standard deviations."""
    pose: HandPose
    """In the camera's frame: the camera's viewmat is the identity."""
    camera: Camera
    landmarks: Landmarks
    mask: Float[Tensor, "H W"]
    """Share of each pixel that is hand, cut a little below the wrist."""
    reprojection: float
    """Mean distance of the 21 points to the model's [% of the longer side of their box]."""
    worst_point: float
    """Largest of those distances [%]."""
    mask_iou: float
    """Intersection over union of the posed mesh and the mask, above the wrist."""
    cost: float
    """Cost of the least-squares fit: the sum of squared residuals in units of their sigmas."""
    warnings: tuple[str, ...]
    """What makes this fit doubtful, in words; empty when nothing does."""
    reading: SurfaceReading | None = None
    """What a network reads in the photo; None where none was asked."""


class HandCrop(NamedTuple):
    """What a prior may look at to guess the whole hand; a left hand has been mirrored."""

    image: Float[Tensor, "S S 3"]
    """Square crop around the hand."""
    mask: Float[Tensor, "S S"]
    """Share of each pixel that is hand."""
    above_wrist: Float[Tensor, "S S"]
    """1 on the hand's side of the wrist line: below it mask and surface end at different places."""
    camera: Camera
    """Camera of the crop."""
    rest: PosedHand
    """The fitted surface at rest."""
    posed: PosedHand
    """The fitted surface in the photo's pose, in the world of `camera`."""
    reading: Float[Tensor, "S S 7"] | None = None
    """Places, spread and albedo of `SurfaceReading` at the crop's pixels."""


class Gaussians(NamedTuple):
    """3D Gaussians ready to be drawn."""

    means: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]
    """Unit, wxyz."""
    scales: Float[Tensor, "N 3"]
    """Standard deviations [m]."""
    opacities: Float[Tensor, "N"]
    colors: Float[Tensor, "N 3"]


class CanonicalGaussians(NamedTuple):
    """Gaussians bound to the hand's surface: P to vertices, then Q to faces; N = P + Q."""

    vertex_index: Int[Tensor, "P"]
    offsets: Float[Tensor, "P 3"]
    """Shift of each vertex Gaussian from its vertex, in the rest frame of the surface [m]."""
    face_index: Int[Tensor, "Q"]
    barycentrics: Float[Tensor, "Q 3"]
    """Weights of a face's three corners; rows sum to one."""
    quats: Float[Tensor, "N 4"]
    scales: Float[Tensor, "N 3"]
    opacities: Float[Tensor, "N"]
    colors: Float[Tensor, "N 3"]
    shade: Float[Tensor, "N 3"] | None = None
    """Factor of `colors` where skin faces as in the photo; gone where it has turned (`avatar.pose`)."""


class Render(NamedTuple):
    """A drawn image."""

    image: Float[Tensor, "H W 3"]
    alpha: Float[Tensor, "H W"]


class HandLight(NamedTuple):
    """Light that falls on a hand; it stays in the world when the hand turns.

    Colours are multiplied, as light, with the harmonics in the direction n that the skin faces, in the world of the
    photo's camera, kept within `limits`; and with the share of this light that the hand lets through in its pose
    (`avatar.sky`). What this does not explain, such as gloss and wrinkles, is shade: `shade` here and that of the
    Gaussians. It stays on skin as long as the skin faces as in the photo and sees as much of the sky.
    """

    harmonics: Float[Tensor, "K 3"]
    """Irradiance of 1, x, y, z, and if K = 9 of xy, yz, 3 z^2 - 1, xz, x^2 - y^2; a column a colour."""
    limits: Float[Tensor, "2 3"]
    """Least and most of it that the photo shows, above 0: no more is guessed of what it does not show."""
    even: Float[Tensor, "3"]
    """Light as bright as that on what the photo shows on average, from all around."""
    shade: Float[Tensor, "V 3"] | None = None
    """Factor of the sRGB colours of vertices that face as in the photo, where that may show something else there."""
    facing: Float[Tensor, "V 3"] | None = None
    """Where they faced there, unit; comes with any shade."""
    albedo: Float[Tensor, "3"] | None = None
    """Mean reflectance of the skin, from which light bounces into the hollows of the hand. None: nothing is hidden."""
    doubt: Float[Tensor, "V"] | None = None
    """How far that photo may show something else there, 0 to 1: all shade ends there when the sky nearby opens, and
    that of the Gaussians in next to any other view."""


class TrainingBatch(NamedTuple):
    """B hands, each with one photo and the T pictures that a prior is trained to draw of it.

    Right hands (left ones mirrored), all pictures square; vertices are those of one hand model. `posed` and `viewmat`
    of the photo may have an estimator's error. `rest` and the targets are true, so that the prior learns colours in
    their true places.
    """

    image: Float[Tensor, "B S S 3"]
    """Crop of the photo around the hand, its background included."""
    mask: Float[Tensor, "B S S"]
    """Share of each of its pixels that is hand."""
    posed: Float[Tensor, "B V 3"]
    """The surface in the photo's pose [m]."""
    viewmat: Float[Tensor, "B 4 4"]
    """World to camera of the photo."""
    K: Float[Tensor, "B 3 3"]
    """Intrinsics of the photo [px]."""
    rest: Float[Tensor, "B V 3"]
    """The surface at rest [m]."""
    target_images: Float[Tensor, "B T H H 3"]
    """Over black: what is not hand is 0."""
    target_masks: Float[Tensor, "B T H H"]
    """Share of each pixel that is hand."""
    target_known: Float[Tensor, "B T H H"]
    """Share that says whether there is hand; less than 1 where an arm or clothes may hide it."""
    target_posed: Float[Tensor, "B T V 3"]
    """The surface in each target's pose [m]."""
    target_viewmats: Float[Tensor, "B T 4 4"]
    target_Ks: Float[Tensor, "B T 3 3"]
