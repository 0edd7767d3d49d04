"""The options of the commands that train and measure; as `options`, light to import."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg, subcommand

from oasis_warp.cli.options import AllowDownload, Device, JsonFile, LpipsWeights, OutputFolder, command, plain_help

BackboneWeights = Annotated[
    Path | None, arg(help="DINOv2's model.safetensors, for your own network with the paper's profile.")
]
Selection = Annotated[
    Path | None,
    arg(help="For interhand: JSON file with the captures and sequences to use instead of the paper's."),
]
CsvFile = Annotated[Path | None, arg(help="CSV file to write the table to.")]
Threads = Annotated[int, arg(help="CPU threads.")]
FamilyName = Literal[
    "rasterization", "depth_map", "depth_visibility", "face_rotations", "pose_on_mesh", "pose_on_mesh_covars", "skin"
]
Kind = Literal["freckles", "hair", "polish", "tattoo", "ring", "plaster"]


@command
class Gradcheck:
    """Certify the operators on this machine: values, gradients and reproducible bits.

    They are compared with finite differences and float64 references on a few hundred scenes, in about a minute. The
    exit code is 0 if every error is within its bound, else 1.
    """

    scenes: int | None = None
    """Only compare with the float64 references, on this many random scenes over all operators."""
    family: FamilyName | None = None
    """Check only this operator."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Device of the operators; the references run on the CPU."""
    seed: int = 0
    """First seed of the scenes. A failure names its seed, which reproduces it here."""
    jobs: int | None = None
    """Processes for --scenes. Default: one per core; one for CUDA."""
    json: Path | None = None
    """JSON file to write all measurements to."""


@plain_help
class ErrorTime:
    """Error against run time of each threshold and option: error_time.csv, .json and a plot per operator.

    Options are varied one at a time, on the bundled hand and on difficult scenes. Errors are relative to the float64
    kernels with default settings. Times are medians of interleaved calls.
    """

    out: OutputFolder
    quick: bool = False
    """Only the bundled hand, and few repeats: a first impression."""
    repeats: int | None = None
    """Timed calls per setting. Default: 20; 5 with --quick."""
    size: int = 256
    """Side of the hand's pictures [px], a multiple of 4."""
    seed: int = 0
    """Seed of the scenes and of the loss weights."""
    device: Device = "cpu"
    threads: int = 1
    """CPU threads of the default setting; the option "threads" is varied up to the number of cores."""


@plain_help
class Kernels:
    """Speed and error of all operators in one run.

    CPU: every operator, compared with torch and with a scalar kernel. CUDA: pictures of several sizes, posing,
    visibility, an avatar's frame and a training step, launched from the host and in CUDA graphs.
    """

    json: JsonFile = None
    csv: CsvFile = None
    plot: Path | None = None
    """Plot of the times, .png or .svg; needs matplotlib."""
    only: str = ""
    """Measure only names that contain this text: operators on the CPU, cases or passes on CUDA."""
    repeats: int | None = None
    """Timed calls on the CPU (default 30), or groups of calls on CUDA (default 11)."""
    size: int | None = None
    """Side of the picture on the CPU [px] (default 256); CUDA cases have their own."""
    gaussians: int | None = None
    """Gaussians of the bundled hand on the CPU, up to 36,881 (default 20,000); CUDA cases have their own."""
    device: Device = "cpu"
    threads: Threads = 1
    peer: Literal["gsplat"] | None = None
    """Also time another rasterizer, interleaved with ours; CUDA only."""


@plain_help
class Scaling:
    """Growth of time and memory with Gaussians, pixels and views: scaling.csv, .json and a plot.

    The scenes have 1,000 to 10 million Gaussians, 128 to 4096 pixels a side and 1 to 64 views; two are worst cases.
    Every picture is compared with the float64 kernels, large ones in part.
    """

    out: OutputFolder
    quick: bool = False
    """Only small scenes: a minute on a CPU."""
    seconds: float | None = None
    """Seconds of timing per point. Default: 2; 1 with --quick."""
    seed: int = 0
    """Seed of the scenes."""
    device: Device = "cpu"
    threads: Threads = 1


@plain_help
class Roofline:
    """Share of the GPU's measured peak that each CUDA kernel reaches."""

    json: JsonFile = None
    csv: CsvFile = None
    plot: Path | None = None
    """Plot, .png or .svg; needs matplotlib."""
    seed: int = 0
    """Seed of the scenes."""
    device: Literal["cuda"] = "cuda"
    """Device that computes."""


@dataclass(frozen=True, kw_only=True)
class Bench:
    """Measure the operators on this machine: speed, error against run time, scaling, or share of the GPU's peak."""

    what: (
        Annotated[Kernels, subcommand("kernels")]
        | Annotated[ErrorTime, subcommand("error-time")]
        | Annotated[Scaling, subcommand("scaling")]
        | Annotated[Roofline, subcommand("roofline")]
    )


@command
class Doctor:
    """Check the installation and run one kernel; each failed check says what to do."""

    build_extension: bool = False
    """Also compile the optional C++ node, which saves host time on CUDA; needs a compiler and ninja."""


@command
class Synthesize:
    """Generate pictures of synthetic hands, with mask, depth, pose, shape, camera and landmarks.

    The outputs are tar files of 64 pictures (WebDataset). The same command continues an interrupted run and ends with
    the same files. With --sheet, the output is one picture with one hand per person.
    """

    out: Positional[Annotated[Path, arg(metavar="OUT")]]
    """Output folder for the tar files; with --sheet, the picture to write."""
    count: int = 64
    """Number of pictures; eight in a row show one person."""
    seed: int = 0
    """Random seed. Picture k of a seed is always the same, for any --count."""
    size: int = 256
    """Side of the pictures [px]."""
    look: Literal["photo", "even"] = "photo"
    """Complete photos, or only hands in even light on black."""
    backgrounds: Path | None = None
    """Folder of pictures to use as backgrounds instead of synthetic rooms."""
    sheet: bool = False
    """Write one contact sheet instead of tar files."""
    device: Device = "cpu"


@command
class Pretrain:
    """Train a network on synthetic hands: network.safetensors, metrics.jsonl and pictures.png.

    Synthetic people are made first and kept in OUT/people, 23 MB each. Ctrl-C ends the training after the current step;
    the same command continues it, on the CPU with the same bits as an uninterrupted run. Use torchrun for several GPUs.
    """

    out: Positional[Annotated[Path, arg(metavar="OUT")]]
    """Output folder."""
    task: Literal["prior", "dense"] = "prior"
    """Network to train: the prior, which predicts Gaussians, or the estimator's dense network."""
    profile: Literal["compact", "paper"] = "compact"
    """Size of the prior: ours, or the paper's."""
    data: Literal["interhand", "hanco", "freihand", "ho3d", "coco-hand", "whim", "photos"] | None = None
    """For the prior: a data set with MANO parameters, in addition to the synthetic people."""
    root: Path | None = None
    """Folder of the data set, or of its tar files."""
    mano_dir: Path | None = None
    """Folder with MANO_RIGHT.pkl and MANO_LEFT.pkl, for --data. Default: the folder in OASIS_MANO_DIR."""
    selection: Selection = None
    data_weight: float = 0.5
    """Share of batches from the data set, 0 to 1."""
    steps: int = 20_000
    """Training steps, one batch per process each."""
    hands: int = 16
    """Photos per batch and process, each of another person. The dense network was trained with 64."""
    views: int = 2
    """For the prior: targets per photo, 1 to 8. They show the same hand in other poses and even light."""
    people: int = 512
    """Number of synthetic people."""
    hold_out: tuple[Kind, ...] = ()
    """Kinds of hands left out of training, so that `oasis evaluate` can test on unseen kinds."""
    size: int = 256
    """Side of photos and targets [px], a multiple of 16."""
    seed: int = 0
    """Random seed of weights, people, pictures and simulated estimator errors."""
    device: Device = "cuda"
    precision: Literal["bf16", "float32"] = "bf16"
    """Precision of attention and MLPs; everything else is float32."""
    workers: int = 8
    """Processes per GPU that prepare people and pictures; 0 for none."""
    backbone_weights: Path | None = None
    """DINOv2's model.safetensors, for the paper's profile."""
    lpips: LpipsWeights = None
    sharp: bool = False
    """For the prior: on skin that the photo hides, let a patch discriminator judge detail instead of its mean."""
    allow_download: AllowDownload = False
    initial_weights: Annotated[Path | None, arg(aliases=["--start"])] = None  # torchrun takes --start for its own
    """Initial weights: a network.safetensors of the same task and profile. Default: random."""


@command
class Evaluate:
    """Evaluate avatars: metrics.json, sheet.png and a table.

    synthetic: new poses and views of synthetic hands that were not used in training.

    same-hand: avatars of one photo compared with other photos of the same hand.

    looks: avatars from all sides and in other poses compared with photos of real hands.

    interhand, hanco, coco-hand, whim: published data sets with MANO parameters; writes the paper's tables as tables.md,
    tables.tex and .csv.

    The same command continues an interrupted run.
    """

    folder: Positional[Annotated[Path | None, arg(metavar="[FOLDER]")]] = None
    """For same-hand: folder with photos of one hand, or with a subfolder for each hand. For looks: folder with photos.
    Subfolders of the latter may hold more real hands to compare with."""
    out: OutputFolder
    dataset: Literal["synthetic", "same-hand", "looks", "interhand", "hanco", "coco-hand", "whim"] = "synthetic"
    """Data to evaluate on."""
    root: Path | None = None
    """Folder of a published data set."""
    mano_dir: Path | None = None
    """For data sets: folder with MANO_RIGHT.pkl and MANO_LEFT.pkl. Default: the folder in OASIS_MANO_DIR."""
    selection: Selection = None
    ablations: tuple[Path, ...] = ()
    """For data sets: weights of networks trained without one part, for the paper's ablation."""
    prior: Literal["learned", "none"] | Path = "learned"
    """Prior to compare with the mean hand, as for `oasis reconstruct`; none evaluates only the mean hand."""
    backbone_weights: BackboneWeights = None
    people: int = 16
    """Synthetic people without tattoo or ring, and as many with each. For data sets: input photos per person."""
    targets: int = 4
    """Pictures to compare each avatar with; 1 to 8 for synthetic people."""
    steps: int | None = None
    """Steps of texture learning. Default: 56."""
    size: int = 256
    """Side of the pictures [px]: a multiple of 16 for synthetic hands, 256 for looks."""
    seed: int = 0
    """Random seed of people, pictures and adaptation."""
    lpips: LpipsWeights = None
    allow_download: AllowDownload = False
    device: Device = "cpu"
    workers: int = 0
    """Processes that evaluate synthetic people in parallel; 0 for none."""
