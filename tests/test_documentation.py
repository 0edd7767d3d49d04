"""What the pages say can be done: links lead somewhere, and every block is run, or at least taken by what would run it.

Commands and Python blocks are run word for word in a folder that holds the files they name: small photos, avatars made
of them or drawn at random, MANO's files, a data set. What takes minutes, waits for Ctrl-C or needs a GPU, a cluster or
somebody's generator (`TAKEN`, `NOT_RUN`) is only parsed: by the command line of the program that it calls.
"""

import ast
import importlib
import inspect
import json
import re
import shlex
import shutil
import subprocess
import tomllib
from collections.abc import Iterator
from importlib import resources
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import tyro
from datasets import trees
from fuzz.targets import BVH, small_avatar
from ops.rasterization_scenes import ordinary_scene

import oasis_warp
from oasis_warp import reconstruction
from oasis_warp.assets import asset
from oasis_warp.cli import app, reconstruct
from oasis_warp.core.config import EditConfig, ReconstructConfig
from oasis_warp.export import export_avatar
from oasis_warp.hand.mano import read_mano
from oasis_warp.hand.poses import named_pose
from studies.__main__ import studies

TOP = Path(__file__).parents[1]
PAGES = [*sorted((TOP / "docs").glob("*.md")), TOP / "README.md", TOP / "CONTRIBUTING.md"]
NAMES = [page.name for page in PAGES]
QUICK = ("compare", "info", "render")
SLOW = ("animate", "doctor", "edit", "export", "reconstruct", "text")
TAKEN = ("batch", "bench", "evaluate", "gradcheck", "pretrain", "serve", "synthesize", "view")
"""Commands that take minutes, or wait for Ctrl-C."""
SLOW_PYTHON = ("editing.md", "estimator.md", "export.md", "network.md", "same_hand.md", "README.md", "tour.md")
NOT_RUN = {"batch.md": "Ray is none of our packages", "gpu.md": "needs CUDA", "synthetic.md": "needs CUDA"}
PROGRAMS = ("oasis", "python", "python3", "pip", "pytest", "torchrun", "dask", "export")
"""What a block's first line calls; others are the shell's own, whose grammar alone is checked."""
SIDE = 160
"""Longer side of the small photos [px]."""
SHORT = {"animate": ["--size=64"], "edit": ["--steps=2"], "reconstruct": ["--steps=2"]}
"""Options that stand behind those of the page here, so that minutes become seconds."""


def blocks(page, language):
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)


def commands(page) -> Iterator[list[str]]:
    """Words of each command; those that && joins are several."""
    ours = [block for block in blocks(page, "sh") if block.split()[0].removeprefix(".venv/bin/") in PROGRAMS]
    for line in "".join(ours).replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        while words:
            end = words.index("&&") if "&&" in words else len(words)
            yield [words[0].removeprefix(".venv/bin/"), *words[1:end]]
            words = words[end + 1 :]


def pages_that_run(*which, python=lambda page: False):
    """Parameters: pages with one of these commands, or with Python blocks that are run."""
    found = []
    for page in PAGES:
        ours = [words[1] for words in commands(page) if words[0] == "oasis" and "--generator" not in words]
        if page.name != "tour.md" and (set(ours) & set(which) or (blocks(page, "python") and python(page))):
            found.append(page)
    return pytest.mark.parametrize("page", found, ids=[page.name for page in found])


def anchors(page):
    headings = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_links_lead_somewhere(page):
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if target.startswith(("https://", "http://")):
            continue
        name, _, anchor = target.partition("#")
        other = page.parent / name if name else page
        assert other.exists(), target
        assert not anchor or anchor in anchors(other), target


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_every_block_says_what_it_is(page):
    """A block without a language would be run by nobody."""
    fences = re.findall(r"^```(.*)$", page.read_text(), re.MULTILINE)
    assert all(re.fullmatch(r"sh|python|json|\{[\w-]+\}.*", opened) for opened in fences[::2])
    assert set(fences[1::2]) <= {""} and all(map(json.loads, blocks(page, "json")))
    for block in blocks(page, "sh"):
        assert subprocess.run(["bash", "-n"], input=block, text=True, check=False).returncode == 0


def small(path, out, side=SIDE):
    """A photo with this longer side."""
    picture = cv2.imread(str(path))
    assert picture is not None
    scale = side / max(picture.shape[:2])
    return cv2.imwrite(str(out), cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))


@pytest.fixture(scope="module")
def prepared(tmp_path_factory, mano_dir):
    """A folder with what the pages name."""
    folder = tmp_path_factory.mktemp("prepared")
    bundled = "src/oasis_warp/assets/photos/palm_open_left_02.png"
    (folder / bundled).parent.mkdir(parents=True)
    own = TOP / "tests" / "data" / "photos" / "same_hand" / "a1_wood_right"
    photos = dict.fromkeys(("photo.jpg", "photo.png", "hand.jpg", "left.jpg", bundled), TOP / bundled)
    photos |= {"palm.jpg": own / "02_flat_closed.jpg", "back.jpg": own / "03_flat_closed_back.jpg"}
    photos |= {"right.jpg": own / "02_flat_closed.jpg", "side.jpg": own / "05_c_shape_open.jpg"}
    for name, photo in photos.items():
        small(photo, folder / name)
    for name in ("photo.png", bundled):  # the same pixels, which are reconstructed once: `one_reconstruction`
        cv2.imwrite(str(folder / name), cv2.imread(str(folder / "photo.jpg")))
    painted = cv2.imread(str(folder / "photo.jpg"))
    cv2.circle(painted, (SIDE // 3, SIDE // 2), 6, (0, 0, 255), -1)
    cv2.imwrite(str(folder / "painted.png"), painted)
    avatar = small_avatar(lit=True)
    for name in ("out/avatar", "out/me/avatar", "one/avatar", "other/avatar", "left", "right", "avatar"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        avatar.save(folder / f"{name}.safetensors")
    export_avatar(avatar, folder / "scene.ply")
    finger = "JOINT {0}1\n{{\nOFFSET 5 0 {1}\nCHANNELS 1 Zrotation\n}}\n"
    fingers = "".join(finger.format(name, k) for k, name in enumerate(("index", "middle", "ring", "little", "thumb")))
    (folder / "hands.bvh").write_text(BVH.format(fingers=fingers, row=" ".join(["10"] * 8)))
    shutil.copytree(mano_dir, folder / "mano_v1_2" / "models")
    with resources.as_file(asset("prior", "compact.safetensors")) as weights:
        (folder / "network.safetensors").symlink_to(weights)
    return folder


def given(page, folder, mano_dir):
    """What a page's Python blocks take as there."""
    if page.name == "operators.md":
        return dict(vars(ordinary_scene(n=20)))
    if page.name == "mano.md":
        named = {"components": 45, "betas": 10, "global_orient": 3, "transl": 3}
        return {name: np.zeros(size) for name, size in named.items()}
    if page.name == "viewing.md":
        avatar = oasis_warp.Avatar.load(folder / "out" / "avatar.safetensors")
        return {"np": np, "named_pose": named_pose, "avatar": avatar}
    if page.name == "datasets.md":
        models = {side: read_mano(mano_dir, side) for side in ("left", "right")}
        trees.hanco(folder / "hanco", models, "test")
        return {"root": folder / "hanco", "mano_dir": mano_dir}
    if page.name == "same_hand.md":
        return {"oasis_warp": oasis_warp, "paths": [folder / "palm.jpg"]}  # the page's command has several
    return {}


def run_python(page, folder, mano_dir):
    names = given(page, folder, mano_dir)
    for block in blocks(page, "python"):
        exec(compile(block, page.name, "exec"), names)


def take_oasis(words, monkeypatch):
    """Parse a command of ours; what it would run."""
    taken = []
    command = SimpleNamespace(run=lambda options: taken.append(options) or 0)
    with monkeypatch.context() as patch:
        patch.setattr(app.importlib, "import_module", lambda name: command)
        assert app.main(words) == 0
    assert len(taken) == (words != ["--version"])


def take_python(words, monkeypatch):
    """Parse what Python runs: a study, a script of this repository, or the package for environments."""
    if words[:2] == ["-m", "studies"]:
        if words[2] == "render":
            assert set(words[3:]) <= set(studies())
        elif words[2] not in ("age", "list"):
            tyro.cli(importlib.import_module(f"studies.{words[2]}").Options, args=words[3:])
    elif words[0] == "-m":
        assert words[1:] == ["venv", ".venv"]
    else:
        text = (TOP / words[0]).read_text()
        assert all(f'"{word}"' in text for word in words[1:] if word.startswith("--"))


def take_pip(words, monkeypatch):
    """Look whether the files and extras are there."""
    with (TOP / "pyproject.toml").open("rb") as file:
        extras = tomllib.load(file)["project"]["optional-dependencies"]
    files = [after for word, after in pairwise(words) if word == "-c"]
    assert words[0] == "install" and all((TOP / file).is_file() for file in files)
    assert {name for word in words for name in re.findall(r"\[(\w+)\]", word)} <= set(extras)


def take_torchrun(words, monkeypatch):
    run = importlib.import_module("torch.distributed.run").get_args_parser().parse_args(words)
    assert run.module and run.training_script == "oasis_warp"
    take_oasis(run.training_script_args, monkeypatch)


def take_dask(words, monkeypatch):
    pytest.importorskip("distributed")
    command = importlib.import_module(f"distributed.cli.dask_{words[0]}").main
    command.make_context(words[0], list(words[1:]))


@pytest.mark.filterwarnings("ignore")  # of Dask's and torch's own command lines
@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_commands_are_taken(page, monkeypatch, pytestconfig):
    def take_pytest(words, _):
        asked, unknown = pytestconfig._parser.parse_known_and_unknown_args(words)
        assert not unknown and all((TOP / path).exists() for path in asked.file_or_dir)

    takers = (
        take_oasis, take_python, take_python, take_pip, take_pytest, take_torchrun, take_dask, lambda words, _: None
    )  # fmt: skip
    for words in commands(page):
        dict(zip(PROGRAMS, takers, strict=True))[words[0]](words[1:], monkeypatch)


def run_commands(page, which):
    elsewhere = list(commands(TOP / "docs" / "tour.md")) if page.name != "tour.md" else []  # run there, word for word
    for words in commands(page):
        if "--same-hand" in words and words in elsewhere:
            continue
        assert words[0] != "oasis" or words[1] in (*QUICK, *SLOW, *TAKEN, "--version")
        if words[0] == "oasis" and words[1] in which and "--generator" not in words:
            assert app.main([*words[1:], *SHORT.get(words[1], [])]) == 0, words


@pages_that_run(*QUICK)
def test_quick_commands_work_word_for_word(page, prepared, monkeypatch):
    monkeypatch.chdir(prepared)
    run_commands(page, QUICK)


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_what_python_blocks_call_is_there(page):
    """Names that are imported from us exist, and take the arguments that they are called with."""
    for block in blocks(page, "python"):
        ours = {}
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("oasis_warp"):
                module = importlib.import_module(node.module or "")
                ours |= {alias.asname or alias.name: getattr(module, alias.name) for alias in node.names}
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ours:
                named = {word.arg: None for word in node.keywords if word.arg}
                inspect.signature(ours[node.func.id]).bind(*[None] * len(node.args), **named)


@pages_that_run(python=lambda page: page.name not in (*SLOW_PYTHON, *NOT_RUN))
def test_quick_python_blocks_work_word_for_word(page, prepared, mano_dir, monkeypatch):
    monkeypatch.chdir(prepared)
    run_python(page, prepared, mano_dir)


@pytest.fixture(scope="module")
def reconstructed():
    """What the same photos gave with the same options, on any page."""
    return {}


@pytest.fixture
def quick_runs(monkeypatch, reconstructed):
    """Few steps and short films, where a page leaves them open; photos that are given again have their results."""
    run = reconstruction._run

    def run_once(photos, config, *others):
        pixels = tuple((photo.rgb.numpy().tobytes(), photo.alpha is None, photo.focal) for photo in photos)
        key = pixels, config, *others[:-1]  # all but who is told of progress
        if key not in reconstructed:
            reconstructed[key] = run(photos, config, *others)
        return reconstructed[key]

    monkeypatch.setattr(reconstruction, "_run", run_once)
    for config in (ReconstructConfig, EditConfig):
        make = inspect.unwrap(config.__init__)  # below the shape checks
        monkeypatch.setattr(make, "__kwdefaults__", {**make.__kwdefaults__, "steps": 2})
    monkeypatch.setattr(reconstruct, "TURNTABLE_FRAMES", 4)


@pytest.mark.slow
@pages_that_run(*SLOW, python=lambda page: page.name in SLOW_PYTHON)
def test_slow_commands_and_blocks_work_word_for_word(page, prepared, mano_dir, tmp_path, monkeypatch, quick_runs):
    folder = shutil.copytree(prepared, tmp_path / "here", symlinks=True)
    monkeypatch.chdir(folder)
    run_commands(page, (*QUICK, *SLOW))
    if page.name in SLOW_PYTHON:
        run_python(page, folder, mano_dir)


@pytest.mark.slow
def test_the_tour_works_word_for_word_and_makes_what_it_tells(prepared, mano_dir, tmp_path, monkeypatch, quick_runs):
    for name in ("photo.png", "palm.jpg", "back.jpg"):
        shutil.copy(prepared / name, tmp_path)
    page = TOP / "docs" / "tour.md"
    monkeypatch.chdir(tmp_path)
    run_commands(page, (*QUICK, *SLOW))
    run_python(page, tmp_path, mano_dir)
    made = {path.name for path in tmp_path.iterdir()} | {path.name for path in (tmp_path / "out").iterdir()}
    named = set(re.findall(r"^\| `([\w.]+)` \|", page.read_text(), re.MULTILINE))
    assert named <= made and {"fist.png", "studio.png", "clip.gif", "hand.html", "hand.glb", "hand.spz", "both"} <= made
