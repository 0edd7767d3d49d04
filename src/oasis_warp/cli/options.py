"""The options of every command; the text under a field is its `--help`.

Nothing heavy is imported here, so that `oasis --help` answers at once.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, dataclass_transform

from tyro.conf import Positional, arg

from oasis_warp.core.config import EditConfig, ReconstructConfig

# Options that several commands share, with their help.
Output = Annotated[Path, arg(aliases=["-o"], metavar="PATH")]
OutputFolder = Annotated[Path, arg(aliases=["-o"], metavar="PATH", help="Folder for the results.")]
AvatarFile = Positional[Annotated[Path, arg(help="avatar.safetensors of `oasis reconstruct`.")]]
JsonFile = Annotated[Path | None, arg(help="File to write the numbers to as well.")]
Device = Annotated[Literal["cpu", "cuda"], arg(help="Where to compute.")]
Elevation = Annotated[float, arg(help="Degrees above the hand.")]
Light = Annotated[
    Literal["photo", "even", "studio"] | Path,
    arg(
        help="The photo's light, as far as it is known apart from the skin; even light; that of a studio; or of an "
        "environment map, a file such as FILE.hdr."
    ),
]
LpipsWeights = Annotated[
    tuple[Path, Path] | None,
    arg(
        help="Weights of LPIPS: alexnet-owt-7be5be79.pth of torchvision and alex.pth of LPIPS, or vgg16-397923af.pth "
        "and vgg.pth. Without them LPIPS is not measured, and training has a term of its own in its place."
    ),
]
AllowDownload = Annotated[bool, arg(help="Download published weights that are missing from where their authors are.")]
Quiet = Annotated[bool, arg(help="Say only what is wrong.")]
Verbose = Annotated[bool, arg(help="Say more, and where in the program an error arose.")]
Record = Annotated[Path | None, arg(help="JSON file for what was done: the command, what it wrote, what went wrong.")]
NamedPose = Literal["rest", "open", "relaxed", "fist", "pinch", "thumbs_up", "victory", "point", "ok"]
PoseName = Literal["photo"] | NamedPose


@dataclass_transform(kw_only_default=True, frozen_default=True)
def command(options: type) -> type:
    """A frozen dataclass of a command's options, and last those that all commands have."""
    for name, kind, default in (("json", Record, None), ("quiet", Quiet, False), ("verbose", Verbose, False)):
        if name not in options.__annotations__:
            options.__annotations__[name] = kind
            setattr(options, name, default)
    return dataclass(frozen=True, kw_only=True)(options)


@dataclass(frozen=True, kw_only=True)
class _Photos:
    photos: Positional[tuple[Path, ...]]
    """JPEG, PNG, WebP, AVIF, BMP or TIFF files."""
    out: OutputFolder
    same_hand: bool = False
    """All photos show one hand: make one avatar of them, in the first one's light."""
    keypoints: Annotated[Path | None, arg(aliases=["--fit"])] = None
    """JSON file with 21 landmarks, or with pose and camera, or what WiLoR or HaMeR found, as .npz or .pkl, to use
    instead of the networks; for one photo only."""
    lpips: LpipsWeights = None
    allow_download: AllowDownload = False


@command
class Reconstruct(ReconstructConfig, _Photos):
    """Turn photos of a hand into avatars: avatar.safetensors, summary.png, quality.png, turntable.mp4 and report.json.

    One photo's files go into the folder --out itself, those of several into a folder each, --out/NAME for NAME.jpg.
    With --same-hand several photos make one avatar, in --out itself. Files of an earlier run are replaced, all other
    files in the folder stay.
    """


@dataclass(frozen=True, kw_only=True)
class _Batch:
    source: Positional[Path]
    """Folder with photos, at any depth, or a text file with the name of a photo on each line."""
    out: OutputFolder
    workers: int | None = None
    """Processes on this machine, of one thread and about 1 GB each; as many as it has cores when not given."""
    scheduler: str | None = None
    """Address of a Dask scheduler, tcp://HOST:8786, whose workers take the photos; all see the same folders."""
    pictures: bool = False
    """Write summary.png, quality.png and turntable.mp4 of every photo too."""


@command
class Batch(ReconstructConfig, _Batch):
    """Turn thousands of photos into avatars, on all cores or on a cluster. Needs the extra "batch".

    A photo's results go into a folder whose name is made from the photo, the settings and the version;
    --out/manifest.jsonl says which, or in words why there is none. Whatever stops the work, the same command goes on
    with the photos that are missing.
    """


@command
class Render:
    """Draw an avatar: one picture of any pose from any side."""

    avatar: AvatarFile
    out: Output
    """Picture to write: .png, .webp or .jpg."""
    pose: PoseName | Path = "photo"
    """Pose of the hand; "photo" is the one in the photo. Or a file with one, as --motion of `oasis animate` takes."""
    azimuth: float = 0.0
    """Degrees around the hand; 0 is where the photo was taken from."""
    elevation: Elevation = 0.0
    size: int = 512
    """Side of the picture [px]."""
    light: Light = "photo"
    background: str = "white"
    """white, black, transparent, or a colour as rrggbb."""
    device: Device = "cpu"


@command
class Animate:
    """Make a film of an avatar: a turn around it, a walk through poses, or a motion of your own. The first two loop.

    Two avatars come into one scene.
    """

    avatars: Positional[tuple[Path, ...]]
    """avatar.safetensors of `oasis reconstruct`, one or two."""
    out: Output
    """Film to write: .mp4, .gif, .webp, or a folder of PNG pictures if the name has no ending."""
    motion: Literal["turntable", "poses"] | Path = "turntable"
    """Turn around the hand in one pose, or stand still and change poses, or play a file: joint angles, MANO's
    parameters or tracked joints of WebXR and OpenXR in .json or .npz, a .bvh, or a video of a hand."""
    wrist: Literal["still", "moves"] = "still"
    """Whether the wrist stays as in the photo, or moves as the file says; then two hands stand as in the file."""
    camera: Path | None = None
    """JSON file with `viewmat`, `K`, `width` and `height` of a camera to see a motion or poses from."""
    pose: PoseName | Path = "photo"
    """Pose of the hand on the turntable, or a file with one."""
    poses: str = "open,fist,victory,point,ok"
    """Poses to walk through, with commas between them."""
    seconds: float = 4.0
    """Length of the film; a motion of your own has its own."""
    fps: float = 24.0
    """Frames a second."""
    loop: int = 0
    """How often a .gif or .webp is shown; 0 for ever."""
    elevation: Elevation = 0.0
    size: int = 384
    """Side of the picture [px]."""
    light: Light = "photo"
    background: str = "white"
    """white, black, a colour as rrggbb, or, for .webp and pictures, transparent."""
    device: Device = "cpu"


@command
class Info:
    """Say what is in avatar files: size, Gaussians, light, how much is painted; a column for each."""

    avatars: Positional[tuple[Path, ...]]
    """avatar.safetensors of `oasis reconstruct`."""
    json: JsonFile = None


@command
class Compare:
    """Say what two avatars differ in: settings and measures of the reports beside them, numbers, and likeness."""

    one: Positional[Path]
    """avatar.safetensors of `oasis reconstruct`."""
    other: Positional[Path]
    """Another one."""
    out: Annotated[Path | None, arg(aliases=["-o"], metavar="PATH")] = None
    """Picture to write with both and their differences: .png, .webp or .jpg."""


@command
class Export:
    """Write an avatar for other programs; the ending of the name says the format.

    Gaussians for splat viewers: .ply, .compressed.ply, .splat, .spz, .v4.spz, .sog, and .splats.glb (glTF's
    KHR_gaussian_splatting).
    A mesh with bones, texture and named poses, for engines and Blender: .glb, .gltf. In one pose: .obj. Either in
    OpenUSD: .usdc, .usdz, and .splats.usdc, .splats.usdz. Shape, pose and camera as numbers: .json. A page that shows
    and poses the avatar in a browser, offline: .html.
    """

    avatar: AvatarFile
    out: Output
    """File to write."""
    pose: PoseName | Literal["auto"] | Path = "auto"
    """Pose of the hand, or a file with one; "auto" is that of the photo, in files that can be posed the rest pose."""
    light: Literal["auto", "baked", "none"] = "auto"
    """Colours as in the avatar's light, or as in even light for programs with lights of their own; "auto" bakes light
    into Gaussians and leaves it out of meshes."""
    photo: Path | None = None
    """Photo to show beside the hand in a .html page."""


@command
class Serve:
    """Take photos and give avatars in the browser, one after the other. Ctrl-C ends it.

    The form comes from this machine and is for it alone: its address holds a token. Photos and avatars stay in a
    folder; started again with the same folder, it goes on with the photos that waited.
    """

    folder: Path = Path("served")
    """Folder of photos and avatars."""
    port: int = 0
    """Port on 127.0.0.1; 0 takes a free one."""
    no_browser: bool = False
    """Print the address and open no browser."""


@command
class View:
    """Show an avatar in the browser: turn it, pose it, light it. Ctrl-C ends it.

    Gaussians of other programs are shown too, and turned: .ply, .compressed.ply, .splat and .spz. The page comes from
    this machine and is for it alone: its address holds a token. `oasis export -o hand.html` writes the same page as a
    file.
    """

    avatar: Positional[Path]
    """avatar.safetensors of `oasis reconstruct`, or a file of Gaussians."""
    photo: Path | None = None
    """Photo to show beside it, such as the one it was made from."""
    port: int = 0
    """Port on 127.0.0.1; 0 takes a free one."""
    no_browser: bool = False
    """Print the address and open no browser."""


@command
class Text:
    """Make an avatar from words, with an image generator of your own.

    Writes depth, normals, edges and mask of a posed hand, asks the generator for a picture that follows them, checks
    that it shows this hand in this pose, and reconstructs it. Without --generator it leaves these files for you.
    """

    words: Positional[str]
    """The person's hand, e.g. "an old fisherman's tanned hand"."""
    out: OutputFolder
    generator: str | None = None
    """A picture you made from the files, a folder with a diffusers ControlNet pipeline, hosted:MODEL for one on the
    machines of others, or a command with {out} in it; also {depth}, {normal}, {canny}, {mask}, {folder}, {prompt} and
    {seed}."""
    pose: NamedPose = "open"
    view: Literal["palm", "back"] = "palm"
    side: Literal["left", "right"] = "right"
    tries: int = 4
    """Pictures to ask for until one shows the hand."""
    seed: int = 0
    size: int = 1024
    """Side of the pictures [px]."""


@dataclass(frozen=True, kw_only=True)
class _Painting:
    avatar: AvatarFile
    painted: Positional[Path]
    """The painted photo; scaled or saved as JPEG is fine, cut or turned is not."""
    photo: Path | None = None
    """The photo that the avatar was made from: what differs from it is paint."""
    mask: Path | None = None
    """Picture that is white where there is paint, instead of the difference."""
    out: Annotated[Path | None, arg(aliases=["-o"], metavar="PATH")] = None
    """Avatar file to write, NAME.safetensors: AVATAR-PAINTED.safetensors beside the avatar when not given."""
    overwrite: bool = False
    """Replace files of an earlier edit."""
    device: Device = "cpu"


@command
class Edit(EditConfig, _Painting):
    """Bring what was painted on an avatar's photo into the avatar.

    Paint on the photo in any program, save the whole picture under another name, and give both. Writes the new avatar,
    NAME.png with before and after, and NAME.json with what was measured.
    """
