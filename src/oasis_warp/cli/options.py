"""The options of every command; the text under a field is its `--help`.

Nothing heavy is imported here, so that `oasis --help` answers at once.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, dataclass_transform, get_args, get_origin, get_type_hints

from tyro.conf import Positional, arg

from oasis_warp.core.config import EditConfig, ReconstructConfig

# Options that several commands share, with their help.
Output = Annotated[Path, arg(aliases=["-o"], metavar="PATH")]
OutputFolder = Annotated[Path, arg(aliases=["-o"], metavar="PATH", help="Folder for the results.")]
AvatarFile = Positional[Annotated[Path, arg(metavar="AVATAR", help="avatar.safetensors of `oasis reconstruct`.")]]
JsonFile = Annotated[Path | None, arg(help="JSON file to write the numbers to.")]
Device = Annotated[Literal["cpu", "cuda"], arg(help="Device that computes.")]
Elevation = Annotated[float, arg(help="Degrees of the camera above the hand, towards its fingers.")]
Light = Annotated[
    Literal["photo", "even", "studio"] | Path,
    arg(help="Light: the photo's, even, a studio's, or an environment map (FILE.hdr)."),
]
LpipsWeights = Annotated[
    tuple[Path, Path] | None,
    arg(
        help="Weights of LPIPS: alexnet-owt-7be5be79.pth of torchvision and alex.pth of LPIPS, or vgg16-397923af.pth "
        "and vgg.pth. Without them LPIPS is not measured, and training uses a built-in term instead."
    ),
]
AllowDownload = Annotated[bool, arg(help="Download missing published weights from their authors.")]
Quiet = Annotated[bool, arg(aliases=["-q"], help="Print errors and warnings only.")]
Verbose = Annotated[bool, arg(aliases=["-v"], help="Print more, with tracebacks of errors.")]
Record = Annotated[Path | None, arg(help="JSON file that records the command, its outputs and its errors.")]
NamedPose = Literal["rest", "open", "relaxed", "fist", "pinch", "thumbs_up", "victory", "point", "ok"]
PoseName = Literal["photo"] | NamedPose


@dataclass_transform(kw_only_default=True, frozen_default=True)
def command(options: type) -> type:
    """A frozen dataclass of a command's options, and last those that all commands have."""
    for name, kind, default in (("json", Record, None), ("quiet", Quiet, False), ("verbose", Verbose, False)):
        if name not in options.__annotations__:
            options.__annotations__[name] = kind
            setattr(options, name, default)
    return plain_help(options)


@dataclass_transform(kw_only_default=True, frozen_default=True)
def plain_help(options: type) -> type:
    """A frozen dataclass whose `--help` names no default that says nothing: None, False or an empty list."""
    for name, kind in get_type_hints(options, include_extras=True).items():
        default = getattr(options, name, ...)
        if default is None or default is False or default in ((), ""):
            bare, *given = get_args(kind) if get_origin(kind) is Annotated else (kind,)
            kinds = [part for part in get_args(bare) if part is not NoneType]
            plain = arg(metavar=_metavar(kinds) if default is None else None, help_behavior_hint="")
            options.__annotations__[name] = Annotated[(bare, plain, *given)]  # pyright: ignore[reportInvalidTypeForm]
    return dataclass(frozen=True, kw_only=True)(options)


def _metavar(kinds: Sequence[Any]) -> str:
    """What the help shows for a value of one of these types."""
    names = []
    for kind in kinds:
        if get_origin(kind) is tuple:
            names.append(" ".join(_metavar([part]) for part in get_args(kind)))
        elif get_origin(kind) is Literal:
            names.append(f"{{{','.join(get_args(kind))}}}")
        else:
            names.append("PATH" if kind is Path else "TEXT" if kind is str else kind.__name__.upper())
    return "|".join(names)


@dataclass(frozen=True, kw_only=True)
class _Photos:
    photos: Positional[Annotated[tuple[Path, ...], arg(metavar="PHOTO ...", help_behavior_hint="")]]
    """JPEG, PNG, WebP, AVIF, BMP or TIFF files."""
    out: OutputFolder
    same_hand: bool = False
    """All photos show the same hand: make one avatar of them, in the light of the first."""
    keypoints: Annotated[Path | None, arg(aliases=["--fit"])] = None
    """Landmarks or pose to use instead of the detector's: a .json file, or the .npz or .pkl output of WiLoR or HaMeR.
    Works with one photo only."""
    lpips: LpipsWeights = None
    allow_download: AllowDownload = False


@command
class Reconstruct(ReconstructConfig, _Photos):
    """Turn photos of a hand into avatars: avatar.safetensors, summary.png, quality.png, turntable.mp4 and report.json.

    One photo: the files go into --out. Several photos: those of NAME.jpg go into --out/NAME. With --same-hand, several
    photos make one avatar in --out. Files of an earlier run are replaced; other files in the folder are kept.
    """


@dataclass(frozen=True, kw_only=True)
class _Batch:
    source: Positional[Annotated[Path, arg(metavar="FOLDER")]]
    """Folder with photos, also in subfolders, or a .txt file with the path of a photo on each line."""
    out: OutputFolder
    workers: int | None = None
    """Processes on this machine, each with one thread and about 1 GB of memory. Default: one per core."""
    scheduler: str | None = None
    """Address of a Dask scheduler, tcp://HOST:8786. Its workers must see the same folders."""
    pictures: bool = False
    """Also write summary.png, quality.png and turntable.mp4 for every photo."""


@command
class Batch(ReconstructConfig, _Batch):
    """Turn thousands of photos into avatars, on all cores or on a cluster. Needs the extra "batch".

    Each avatar has its own folder, named after a hash of the photo, the settings and the version.
    --out/manifest.jsonl lists the folder of each photo, or the reason why there is none. After an interruption, the
    same command continues with the missing photos.
    """


@command
class Render:
    """Render a picture of an avatar, in any pose, from any side and in any light."""

    avatar: AvatarFile
    out: Output
    """Picture to write: .png, .webp or .jpg."""
    pose: PoseName | Path = "photo"
    """Pose of the hand; "photo" is the pose in the photo. A file works too, as for --motion of `oasis animate`."""
    azimuth: float = 0.0
    """Degrees of the camera around the hand and its arm; 0 is the photo's side."""
    elevation: Elevation = 0.0
    size: int = 512
    """Side of the picture [px]."""
    light: Light = "photo"
    background: str = "white"
    """white, black, transparent, or a colour as six hex digits (RRGGBB)."""
    device: Device = "cpu"


@command
class Animate:
    """Make a video of an avatar: a turntable, a sequence of poses, or your own motion.

    Turntables and pose sequences loop. Two avatars are placed in one scene.
    """

    avatars: Positional[Annotated[tuple[Path, ...], arg(metavar="AVATAR ...", help_behavior_hint="")]]
    """avatar.safetensors of `oasis reconstruct`, one or two."""
    out: Output
    """Video to write: .mp4, .gif or .webp. A name without a suffix becomes a folder of PNG pictures."""
    motion: Literal["turntable", "poses"] | Path = "turntable"
    """A camera that circles the hand, a sequence of poses, or a motion file.
    Motion files: .bvh, a video of a hand, or .json and .npz with joint angles, MANO, WebXR or OpenXR."""
    wrist: Literal["still", "moves"] = "still"
    """The wrist stays as in the photo, or moves as in the motion file. Two hands then stand as in that file."""
    camera: Path | None = None
    """JSON file of the camera for poses and motion files: `viewmat`, `K`, `width` and `height`."""
    pose: PoseName | Path = "photo"
    """Pose of the hand on the turntable; a pose file works too."""
    poses: str = "open,fist,victory,point,ok"
    """Sequence of poses, separated by commas."""
    seconds: float = 4.0
    """Length of the video; a motion file has its own."""
    fps: float = 24.0
    """Frames per second."""
    loop: int = 0
    """How often a .gif or .webp repeats; 0 repeats forever."""
    elevation: Elevation = 0.0
    size: int = 384
    """Side of the picture [px]."""
    light: Light = "photo"
    background: str = "white"
    """white, black or a colour as six hex digits (RRGGBB); for .webp and folders also transparent."""
    device: Device = "cpu"


@command
class Info:
    """Show the contents of avatar files, one column each."""

    avatars: Positional[Annotated[tuple[Path, ...], arg(metavar="AVATAR ...", help_behavior_hint="")]]
    """avatar.safetensors of `oasis reconstruct`."""
    json: JsonFile = None


@command
class Compare:
    """Show how two avatars differ: settings, measures, contents, and PSNR between their pictures.

    Settings and measures are read from the report.json beside each avatar.
    """

    one: Positional[Annotated[Path, arg(metavar="AVATAR")]]
    """avatar.safetensors of `oasis reconstruct`."""
    other: Positional[Annotated[Path, arg(metavar="OTHER")]]
    """The avatar to compare it with."""
    out: Annotated[Path | None, arg(aliases=["-o"], metavar="PATH")] = None
    """Picture of both and their differences: .png, .webp or .jpg."""


@command
class Export:
    """Export an avatar for other programs; the suffix selects the format.

    Gaussians for splat viewers: .ply, .compressed.ply, .splat, .spz, .v4.spz, .sog, .splats.glb (glTF's
    KHR_gaussian_splatting), .splats.usdc, .splats.usdz.

    Rigged mesh with texture and named poses, for engines and Blender: .glb, .gltf, .usdc, .usdz.

    Mesh in one pose: .obj. Offline web page that turns, poses and lights the hand: .html. Shape, pose and camera as
    numbers: .json.
    """

    avatar: AvatarFile
    out: Output
    """File to write."""
    pose: PoseName | Literal["auto"] | Path = "auto"
    """Pose of the hand, or a pose file. "auto": the rest pose for rigged formats, the photo's pose for others."""
    light: Literal["auto", "baked", "none"] = "auto"
    """Bake the avatar's light into the colours, or leave it out for programs with their own lights.
    "auto" bakes it into Gaussians and leaves it out of meshes."""
    photo: Path | None = None
    """Photo to show beside the hand; for .html only."""


@command
class Serve:
    """Reconstruct photos in a browser form, one at a time. Ctrl-C ends it.

    The form is reachable from this machine only; its address holds a secret token. Photos and avatars are kept in
    --folder. A restart with the same folder continues with the photos that wait there.
    """

    folder: Path = Path("served")
    """Folder for photos and avatars."""
    port: int = 0
    """Port on 127.0.0.1; 0 selects a free one."""
    no_browser: bool = False
    """Print the address without opening a browser."""


@command
class View:
    """Show an avatar in the browser, where you can turn, pose and light it. Ctrl-C ends it.

    Gaussians of other programs can be shown and turned: .ply, .compressed.ply, .splat and .spz. The page is reachable
    from this machine only; its address holds a secret token. `oasis export -o hand.html` writes the page to a file.
    """

    avatar: Positional[Annotated[Path, arg(metavar="AVATAR")]]
    """avatar.safetensors of `oasis reconstruct`, or a file of Gaussians."""
    photo: Path | None = None
    """Photo to show beside it, e.g. the one it was made from."""
    port: int = 0
    """Port on 127.0.0.1; 0 selects a free one."""
    no_browser: bool = False
    """Print the address without opening a browser."""


@command
class Text:
    """Make an avatar from words, with your own image generator.

    First, depth, normals, edges and mask of a posed hand are written. The generator makes a picture that follows them.
    The picture is checked for this hand and pose, then reconstructed. Without --generator, only the files are written.
    """

    words: Positional[Annotated[str, arg(metavar="WORDS")]]
    """Description of the hand, e.g. "an old fisherman's tanned hand"."""
    out: OutputFolder
    generator: str | None = None
    """A finished picture, a folder with a diffusers ControlNet pipeline, hosted:MODEL for a model on a remote service,
    or a command that writes {out}; it may use {depth}, {normal}, {canny}, {mask}, {folder}, {prompt} and {seed}."""
    pose: NamedPose = "open"
    view: Literal["palm", "back"] = "palm"
    side: Literal["left", "right"] = "right"
    tries: int = 4
    """Most pictures to generate until one shows the hand."""
    seed: int = 0
    size: int = 1024
    """Side of the pictures [px]."""


@dataclass(frozen=True, kw_only=True)
class _Painting:
    avatar: AvatarFile
    painted: Positional[Annotated[Path, arg(metavar="PAINTED")]]
    """The painted photo. It may be scaled or saved as JPEG, but not cropped or rotated."""
    photo: Path | None = None
    """The photo that the avatar was made from; pixels that differ from it are paint."""
    mask: Path | None = None
    """Picture that is white where there is paint; can replace --photo."""
    out: Annotated[Path | None, arg(aliases=["-o"], metavar="PATH")] = None
    """Avatar file to write. Default: AVATAR-PAINTED.safetensors beside the avatar."""
    overwrite: bool = False
    """Replace files of an earlier edit."""
    device: Device = "cpu"


@command
class Edit(EditConfig, _Painting):
    """Transfer paint from an avatar's photo to the avatar.

    Paint on the photo in any program, save the whole picture under another name, and give both. The outputs are the new
    avatar, NAME.png with before and after, and NAME.json with the measures.
    """
