"""The options of the commands that train and measure; as `options`, light to import."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg, subcommand

from oasis_warp.cli.options import AllowDownload, Device, JsonFile, LpipsWeights, OutputFolder, command

BackboneWeights = Annotated[
    Path | None, arg(help="DINOv2's model.safetensors, for a network of your own in the paper's profile.")
]
Selection = Annotated[
    Path | None,
    arg(help="For interhand: a JSON file with the captures and sequences to take, where they are not the paper's."),
]
CsvFile = Annotated[Path | None, arg(help="The same as a table.")]
Threads = Annotated[int, arg(help="CPU threads.")]
FamilyName = Literal[
    "rasterization", "depth_map", "depth_visibility", "face_rotations", "pose_on_mesh", "pose_on_mesh_covars", "skin"
]
Kind = Literal["freckles", "hair", "polish", "tattoo", "ring", "plaster"]


@command
class Gradcheck:
    """Certify the operators on this machine: values, gradients and bits, against finite differences and float64 twins.

    Without --scenes everything is measured on a few hundred scenes, in about a minute. The exit code is 0 when every
    error is within its bound, 1 when one is not.
    """

    scenes: int | None = None
    """Check this many seeded scenes against the twins instead, spread over the operators."""
    family: FamilyName | None = None
    """Only this operator."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where the operators run; the twins run on the CPU."""
    seed: int = 0
    """First seed of the scenes; a failure names the seed to give here."""
    jobs: int | None = None
    """Processes for --scenes; as many as there are cores when not given, one for CUDA."""
    json: Path | None = None
    """File for all that was measured."""


@dataclass(frozen=True, kw_only=True)
class ErrorTime:
    """What each threshold and option of the operators costs and buys: error_time.csv, .json and a plot an operator.

    Every knob is turned alone, on the bundled hand and on scenes that are hard to compute. Errors are those against
    the float64 kernels with the default rules; times are medians of calls timed in turns.
    """

    out: OutputFolder
    quick: bool = False
    """The bundled hand only, and few repeats: for a look, not for a verdict."""
    repeats: int | None = None
    """Timed calls of each setting: 20 when not given, 5 with --quick."""
    size: int = 256
    """Side of the pictures of the hand [px]; a multiple of 4."""
    seed: int = 0
    """Seed of the scenes and the gradients' weights."""
    device: Device = "cpu"
    threads: int = 1
    """CPU threads of the default setting; the knob "threads" tries other numbers up to that of the cores."""


@dataclass(frozen=True, kw_only=True)
class Kernels:
    """How fast everything is, and how exact, in one run.

    On the CPU every operator, beside the same in torch and a scalar kernel. On CUDA pictures of several sizes, posing,
    visibility, an avatar's frame and a step of learning, on the host's clock and in CUDA graphs.
    """

    json: JsonFile = None
    csv: CsvFile = None
    plot: Path | None = None
    """Picture of the times: .png or .svg; needs matplotlib."""
    only: str = ""
    """Measure only what holds this text in its name: an operator on the CPU, a case or pass on CUDA."""
    repeats: int | None = None
    """Timed calls of each on the CPU, 30 when not given; on CUDA groups of calls, 11 when not given."""
    size: int | None = None
    """Side of the picture [px], 256 when not given; on CUDA every case has its own."""
    gaussians: int | None = None
    """Gaussians drawn of the bundled hand's 36,881, 20,000 when not given; on CUDA every case has its own."""
    device: Device = "cpu"
    threads: Threads = 1
    peer: Literal["gsplat"] | None = None
    """Time another rasterizer too, in turns with ours; on CUDA only."""


@dataclass(frozen=True, kw_only=True)
class Scaling:
    """How time and memory grow with Gaussians, pixels and views: scaling.csv, .json and a plot.

    1,000 to 10 million Gaussians, 128 to 4096 pixels a side, 1 to 64 views, and two scenes that load a rasterizer most.
    Every picture is compared with the float64 kernels, all of it or, where that would take long, a part.
    """

    out: OutputFolder
    quick: bool = False
    """Small scenes only, in a minute on a CPU."""
    seconds: float | None = None
    """For timing each point: 2 when not given, 1 with --quick."""
    seed: int = 0
    """Seed of the scenes."""
    device: Device = "cpu"
    threads: Threads = 1


@dataclass(frozen=True, kw_only=True)
class Roofline:
    """How near each CUDA kernel comes to what the GPU can do, which is measured first."""

    json: JsonFile = None
    csv: CsvFile = None
    plot: Path | None = None
    """Picture: .png or .svg; needs matplotlib."""
    seed: int = 0
    """Seed of the scenes."""
    device: Literal["cuda"] = "cuda"
    """Where to compute."""


@dataclass(frozen=True, kw_only=True)
class Bench:
    """Measure the operators on this machine: speed, error against run time, growth, or share of what is possible."""

    what: (
        Annotated[Kernels, subcommand("kernels")]
        | Annotated[ErrorTime, subcommand("error-time")]
        | Annotated[Scaling, subcommand("scaling")]
        | Annotated[Roofline, subcommand("roofline")]
    )


@command
class Doctor:
    """Check that everything is there and computes what it should; each failing line says what to do."""

    build_extension: bool = False
    """Also compile the C++ node that draws on CUDA with less time on the host; needs a compiler and ninja."""


@command
class Synthesize:
    """Make pictures of synthetic hands, with mask, depth, pose, shape, camera and landmarks.

    They are written as tar files of 64 (WebDataset). A run that is stopped goes on when it is started again, and ends
    with the same files. With --sheet they go on one picture instead, one for each person.
    """

    out: Positional[Path]
    """Folder for the shards, or the picture to write with --sheet."""
    count: int = 64
    """How many pictures; eight in a row show one person."""
    seed: int = 0
    """Seed of the world: picture k of a seed is always the same, whatever the count."""
    size: int = 256
    """Side of the pictures [px]."""
    look: Literal["photo", "even"] = "photo"
    """Photos with everything, or hands alone in even light on black."""
    backgrounds: Path | None = None
    """Folder of pictures to put behind the hands, instead of rooms."""
    sheet: bool = False
    """One contact sheet instead of shards."""
    device: Device = "cpu"


@command
class Pretrain:
    """Train a network on synthetic hands: network.safetensors, metrics.jsonl and pictures.png.

    People are baked first and kept in OUT/people, 23 MB each. A training that was stopped goes on when it is started
    again with the same options, and on the CPU ends with the same bits. Ctrl-C ends it after the step it is at.
    torchrun starts it on several GPUs.
    """

    out: Positional[Path]
    """Folder for what training leaves."""
    task: Literal["prior", "dense"] = "prior"
    """The learned prior, which predicts Gaussians, or the estimator's dense network, which reads every pixel."""
    profile: Literal["compact", "paper"] = "compact"
    """Sizes of the prior: ours, or the paper's."""
    data: Literal["interhand", "hanco", "freihand", "ho3d", "coco-hand", "whim", "photos"] | None = None
    """For the prior: a data set with MANO's parameters, beside the synthetic people."""
    root: Path | None = None
    """Its folder, or one of tar files with what lies there."""
    mano_dir: Path | None = None
    """Folder with MANO_RIGHT.pkl and MANO_LEFT.pkl, for --data; the one that OASIS_MANO_DIR names when not given."""
    selection: Selection = None
    data_weight: float = 0.5
    """Share of batches that are of the data set, 0 to 1."""
    steps: int = 20_000
    """Batches that each process sees."""
    hands: int = 16
    """Photos a batch and process, each of another person; the dense network was trained with 64."""
    views: int = 2
    """For the prior: targets a photo, the same hand in other poses and even light, 1 to 8."""
    people: int = 512
    """How many there are."""
    hold_out: tuple[Kind, ...] = ()
    """Kinds left out of training, so that `oasis evaluate` can test on what was never seen."""
    size: int = 256
    """Side of photos and targets [px], a multiple of 16."""
    seed: int = 0
    """Seed of the weights, the people, the pictures and the estimator's errors."""
    device: Device = "cuda"
    precision: Literal["bf16", "float32"] = "bf16"
    """Precision of attention and perceptrons; all else is float32."""
    workers: int = 8
    """Processes that bake people and plan pictures ahead, for each GPU; 0 for none."""
    backbone_weights: Path | None = None
    """DINOv2's model.safetensors, for the paper's profile."""
    lpips: LpipsWeights = None
    allow_download: AllowDownload = False
    initial_weights: Annotated[Path | None, arg(aliases=["--start"])] = None  # torchrun takes --start for its own
    """Weights to begin with: a network.safetensors of the same task and profile. From nothing when not given."""


@command
class Evaluate:
    """Measure what avatars are worth: metrics.json with every number, sheet.png, and a table.

    On synthetic hands that no training has met, in poses and from sides that the photo does not show; on a folder of
    photos with a subfolder for each hand, where the avatar of one photo is held against the others; by their looks,
    where avatars of single photos are drawn from all sides and in other poses and held against real hands; or on a
    published data set with MANO's parameters, by the paper's tables: tables.md, tables.tex and .csv. A run that was
    stopped goes on when it is started again with the same options.
    """

    folder: Positional[Path | None] = None
    """With a subfolder of photos for each hand, or with photos of one, for same-hand; with photos of hands, for looks,
    where its subfolders may hold more real hands to compare with."""
    out: OutputFolder
    dataset: Literal["synthetic", "same-hand", "looks", "interhand", "hanco", "coco-hand", "whim"] = "synthetic"
    """What to measure on."""
    root: Path | None = None
    """Folder of a published data set."""
    mano_dir: Path | None = None
    """Folder with MANO_RIGHT.pkl and MANO_LEFT.pkl, for these; the one that OASIS_MANO_DIR names when not given."""
    selection: Selection = None
    ablations: tuple[Path, ...] = ()
    """For these: weights of networks that were trained with one part switched off, for the paper's ablation."""
    prior: Literal["learned", "none"] | Path = "learned"
    """The learned prior to hold against the mean hand, as for `oasis reconstruct`; none for the mean hand alone."""
    backbone_weights: BackboneWeights = None
    people: int = 16
    """Synthetic people without tattoo or ring, and as many with each; or photos of each person of a data set that
    avatars are made of."""
    targets: int = 4
    """Pictures to compare each of them with; of synthetic people 1 to 8."""
    steps: int | None = None
    """Steps of texture learning; stops by itself when not given."""
    size: int = 256
    """Side of the pictures [px]; a multiple of 16 for synthetic ones, and 256 for looks."""
    seed: int = 0
    """Seed of people, pictures and adaptation."""
    lpips: LpipsWeights = None
    allow_download: AllowDownload = False
    device: Device = "cpu"
    workers: int = 0
    """Processes that measure synthetic people side by side; 0 for none."""
