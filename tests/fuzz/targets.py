"""What damaged files are thrown at. Each says "refused", by one clean sentence, or "taken", with a sane result."""

import io
import json
import pickle
import resource
import shutil
import socket
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from data_stage.image_files import encode, exif, picture, tiff
from datasets.trees import WRITERS
from fuzz.mutations import NUMBERS, Mutation, choose, damaged_bytes, json_file, tensor_file
from mano_files import write_mano

from oasis_warp.cli.jobs import Jobs
from oasis_warp.cli.serve import FormServer
from oasis_warp.core.camera import orbit_camera
from oasis_warp.core.errors import InputError
from oasis_warp.core.types import Camera, CanonicalGaussians, HandLight, HandPose, Landmarks, Photo
from oasis_warp.data.photo import read_photo
from oasis_warp.data.splat_files import read_splats
from oasis_warp.datasets.readers import DatasetName, read_dataset
from oasis_warp.datasets.samples import load_picture
from oasis_warp.estimation.estimator import HandEstimator
from oasis_warp.estimation.keypoints import read_keypoints
from oasis_warp.export import export_avatar
from oasis_warp.export.page_data import splat_facts
from oasis_warp.hand.mano import read_mano
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand.template import bundled_hand
from oasis_warp.hand_avatar import Avatar
from oasis_warp.motion import read_motion
from oasis_warp.network.config import COMPACT, NetworkConfig
from oasis_warp.network.hand_network import HandNetwork
from oasis_warp.network.weights_file import load_network, save_network

MAX_SECONDS, MAX_GROWTH = 10.0, 1 << 30
"""Of one file: processor time, and growth of the peak memory [bytes]."""
LONGEST = 1100
"""Letters of a sentence."""
DRAWN = 48
"""Side of the pictures that are drawn of what is taken [px]."""


@dataclass(frozen=True)
class Target:
    """A reader, whole files for it, and how they are damaged."""

    files: dict[str, bytes]
    """By suffix."""
    mutate: Mutation
    read: Callable[[Path], None]
    """Reads the file and asserts that what comes out is sane."""


def run(target: Target, seed: int, index: int, folder: Path) -> str:
    """Read damaged file `index` of a seed; "refused" or "taken".

    Raises:
        AssertionError: it took too long or too much memory, or the error is not one clean sentence.
    """
    rng = np.random.default_rng([seed, index])
    suffix = sorted(target.files)[index % len(target.files)]
    path = folder / f"hostile{suffix}"
    path.write_bytes(target.mutate(rng, target.files[suffix]))
    start, before = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        target.read(path)
        outcome = "taken"
    except InputError as error:
        said, outcome = str(error), "refused"
        assert said.isprintable() and said.endswith(".") and len(said) < LONGEST, said
    seconds = time.process_time() - start
    growth = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) << 10
    assert seconds < MAX_SECONDS, f"{seconds:.0f} s"
    assert growth < MAX_GROWTH, f"{growth >> 20} MB"
    return outcome


def small_avatar(*, lit: bool) -> Avatar:
    """An avatar of few Gaussians, on vertices and on faces; with `lit` it has all tensors that a file may have."""
    hand = bundled_hand()
    generator = torch.Generator().manual_seed(1)
    on_vertices, on_faces = torch.arange(0, len(hand.template), 20), torch.arange(0, len(hand.faces), 60)
    n = len(on_vertices) + len(on_faces)

    def random(*shape: int) -> torch.Tensor:
        return torch.rand(shape, generator=generator)

    gaussians = CanonicalGaussians(
        on_vertices, 0.001 * random(len(on_vertices), 3), on_faces, torch.full((len(on_faces), 3), 1 / 3),
        torch.nn.functional.normalize(random(n, 4) - 0.5, dim=1), 0.002 + 0.002 * random(n, 3), random(n), random(n, 3),
        0.8 + 0.4 * random(n, 3) if lit else None,
    )  # fmt: skip
    turn = torch.tensor([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    pose = HandPose(named_pose(hand, "open"), turn, torch.tensor([0.0, 0.09, 0.6]))
    K = torch.tensor([[360.0, 0.0, 80.0], [0.0, 360.0, 100.0], [0.0, 0.0, 1.0]])
    facing = torch.nn.functional.normalize(random(len(hand.template), 3) - 0.5, dim=1)
    light = HandLight(
        torch.cat([torch.ones(1, 3), 0.2 * random(8, 3)]), torch.tensor([[0.3] * 3, [2.0] * 3]), torch.ones(3),
        0.9 + 0.2 * random(len(hand.template), 3), facing, torch.full((3,), 0.4), random(len(hand.template)),
    )  # fmt: skip
    return Avatar(
        side="left", shape=random(40) - 0.5, surface_offsets=0.002 * (random(len(hand.template), 3) - 0.5),
        gaussians=gaussians, source_pose=pose, source_camera=Camera(torch.eye(4), K, 160, 200),
        light=light if lit else None, invented=random(len(hand.template)) if lit else None,
    )  # fmt: skip


def splats(folder: Path) -> Target:
    """Files of Gaussians: what is taken goes into the page."""
    files = {}
    for ending in (".ply", ".compressed.ply", ".splat", ".spz"):
        export_avatar(small_avatar(lit=False), folder / f"whole{ending}")
        files[ending] = (folder / f"whole{ending}").read_bytes()

    def read(path: Path) -> None:
        _, arrays = splat_facts(read_splats(path))
        assert all(np.isfinite(getattr(array, "numbers", array)).all() for array in arrays.values())

    return Target(files, damaged_bytes, read)


BVH = """HIERARCHY
ROOT wrist
{{
OFFSET 0 0 0
CHANNELS 3 Zrotation Yrotation Xrotation
{fingers}}}
MOTION
Frames: 2
Frame Time: 0.04
{row}
{row}
"""


def motions(folder: Path) -> Target:
    """Motions of every kind but videos: what is taken is finite and within the limits of angles."""
    avatar, finger = small_avatar(lit=False), "JOINT {0}1\n{{\nOFFSET 5 0 {1}\nCHANNELS 1 Zrotation\n}}\n"
    fingers = "".join(finger.format(name, k) for k, name in enumerate(("index", "middle", "ring", "little", "thumb")))
    tracked = {"orientations": [[[0.1, 0.2, 0.3, 0.9]] * 25] * 2, "positions": [[[0, 0, 0.1]] * 25] * 2}
    mano = {"hand_pose": [[0.1] * 45] * 2, "global_orient": [[1, 0, 0]] * 2, "transl": [[0, 0, 0.5]] * 2}
    np.savez(folder / "mano.npz", **{name: np.array(value) for name, value in mano.items()})
    files = {
        ".bvh": BVH.format(fingers=fingers, row=" ".join(["10"] * 8)).encode(),
        ".tracked.json": json.dumps(tracked).encode(),
        ".mano.json": json.dumps(mano).encode(),
        ".npz": (folder / "mano.npz").read_bytes(),
    }

    def read(path: Path) -> None:
        motion = read_motion(path, avatar)
        assert bool(motion.angles.isfinite().all()) and float(motion.angles.abs().max()) < 7

    def mutate(rng: np.random.Generator, data: bytes) -> bytes:
        return (json_file if data[:1] == b"{" else damaged_bytes)(rng, data)

    return Target(files, mutate, read)


def avatars(folder: Path, *, lit: bool) -> Target:
    """Avatar files: what is taken is drawn in two poses, in its light and without."""
    small_avatar(lit=False).save(folder / "plain")
    files = {".safetensors": (folder / "plain").read_bytes()}
    if lit:
        small_avatar(lit=True).save(folder / "lit")
        files[".lit.safetensors"] = (folder / "lit").read_bytes()

    @torch.no_grad()
    def read(path: Path) -> None:
        found = Avatar.load(path)
        fist = found.source_pose._replace(angles=named_pose(found.hand, "fist"))
        for drawn, pose in ((found, found.source_pose), (found.in_even_light(), fist)):
            camera = orbit_camera(drawn.mesh(pose).vertices, 0.5, 0.0, DRAWN)
            image, alpha = drawn.render(camera, pose)
            assert bool(image.isfinite().all()) and bool(alpha.isfinite().all()), "a picture that is not finite"
            assert bool((alpha >= 0).all()) and bool((alpha <= 1 + 1e-5).all())

    return Target(files, tensor_file, read)


def weights(folder: Path) -> Target:
    """Files of a small network's weights: what is taken is finite."""
    hand = bundled_hand()
    small = {"width": 32, "heads": 2, "n_tokens": 16, "n_coarse": 64, "refine_layers": 1, "head_width": 16}
    config = NetworkConfig(**{**COMPACT.__dict__, **small})
    save_network(folder / "whole", HandNetwork(config, hand), notes=json.dumps({"step": 7}))

    def read(path: Path) -> None:
        network = load_network(path, hand)
        assert all(bool(part.isfinite().all()) for part in network.state_dict().values())

    return Target({".safetensors": (folder / "whole").read_bytes()}, tensor_file, read)


def plain_photo() -> tuple[Photo, Landmarks]:
    """A grey photo and 21 points on it: enough to read landmarks, and to give a pose its mask."""
    photo = Photo(torch.full((200, 160, 3), 128, dtype=torch.uint8), None, None, "photo.png", 1.0)
    return photo, Landmarks(torch.linspace(30, 130, 42).view(21, 2), None, "right", 1.0, 1.0, "file")


def keypoints(photo: Photo, landmarks: Landmarks, pose: HandPose, *, fit: bool) -> Target:
    """JSON of landmarks and of poses; with `fit` what is taken is fitted too, which takes seconds."""
    points = {"side": landmarks.side, "xy": landmarks.xy.tolist()}
    if landmarks.world is not None:
        points["world"] = landmarks.world.tolist()
    posed = {"side": landmarks.side, "focal": 300.0, "centre": [80.0, 100.0], "shape": [0.0] * 40}
    posed |= {name: part.tolist() for name, part in pose._asdict().items()}
    estimator = HandEstimator(bundled_hand()) if fit else None

    def read(path: Path) -> None:
        found = read_keypoints(path, photo)
        if isinstance(found, Landmarks) and estimator is not None:
            found = estimator.fit(photo, found, force=True)
        parts = (found.xy,) if isinstance(found, Landmarks) else (found.shape, *found.pose, found.mask, found.camera.K)
        assert all(bool(part.isfinite().all()) for part in parts)

    files = {".points.json": json.dumps(points).encode(), ".pose.json": json.dumps(posed).encode()}
    return Target(files, json_file, read)


def estimates() -> Target:
    """Hands of an estimator of MANO as .npz and as pickles of several protocols."""
    photo, _ = plain_photo()
    turns = np.stack([np.eye(3)] * 16)
    arrays = {
        "right": np.ones(1), "pred_cam_t_full": np.array([[0.0, 0.0, 40.0]]), "scaled_focal_length": np.array(3906.0),
        "pred_keypoints_3d": np.random.default_rng(0).normal(0, 0.05, (1, 21, 3)), "betas": np.zeros((1, 10)),
        "global_orient": turns[None, :1], "hand_pose": turns[None, 1:],
    }  # fmt: skip
    archive = io.BytesIO()
    np.savez(archive, **arrays)
    files = {f".{protocol}.pkl": pickle.dumps(arrays, protocol) for protocol in (0, 2, 4, 5)}

    def read(path: Path) -> None:
        found = read_keypoints(path, photo)
        assert isinstance(found, Landmarks) and bool(found.xy.isfinite().all())

    return Target(files | {".npz": archive.getvalue()}, damaged_bytes, read)


def images(*, avif: bool) -> Target:
    """Pictures in every format; AVIF, of which each takes a process, only where asked for."""
    suffixes = (".jpg", ".png", ".webp", ".bmp", *((".avif",) if avif else ()))
    files = {suffix: encode(suffix, picture(), exif(6, 28) if suffix != ".bmp" else None) for suffix in suffixes}
    files[".tiff"] = tiff(picture())

    def read(path: Path) -> None:
        photo = read_photo(path)
        assert photo.rgb.ndim == 3 and photo.rgb.shape[2] == 3 and photo.rgb.numel() <= 3 * 24_000_000

    return Target(files, damaged_bytes, read)


def mano(folder: Path) -> Target:
    """MANO's files: what is taken is finite."""
    write_mano(folder / "mano")
    file = folder / "mano" / "MANO_RIGHT.pkl"

    def read(path: Path) -> None:
        shutil.copy(path, file)
        model = read_mano(file.parent)
        assert all(np.isfinite(part).all() for part in (model.template, model.shape_basis, model.weights))

    return Target({".pkl": file.read_bytes()}, damaged_bytes, read)


DATA_SETS: tuple[DatasetName, ...] = ("interhand", "hanco", "freihand", "ho3d")
READ = 3
"""Samples of a data set that are loaded."""


def data_sets(folder: Path) -> Target:
    """Annotations of data sets: of what is taken, the first samples are loaded."""
    models = {side: read_mano(write_mano(folder / "mano"), side) for side in ("right", "left")}
    places: dict[str, tuple[DatasetName, Path]] = {}
    for name in DATA_SETS:
        WRITERS[name](folder / name, models)
        found = sorted(path for path in (folder / name).rglob("*") if path.suffix in (".json", ".pkl"))
        places |= {f".{name}.{k}{path.suffix}": (name, path) for k, path in enumerate(found[:4])}
    files = {suffix: path.read_bytes() for suffix, (_, path) in places.items()}

    def read(path: Path) -> None:
        suffix = path.name.removeprefix("hostile")
        name, place = places[suffix]
        shutil.copy(path, place)
        try:
            for sample in read_dataset(name, folder / name, folder / "mano").samples[:READ]:
                loaded = load_picture(sample, models, 32)
                assert bool(loaded.image.isfinite().all()) and bool(loaded.camera.K.isfinite().all())
        finally:
            place.write_bytes(files[suffix])

    def mutate(rng: np.random.Generator, data: bytes) -> bytes:
        return json_file(rng, data) if data[:1] in b"{[" and rng.random() < 0.9 else damaged_bytes(rng, data)

    return Target(files, mutate, read)


def requests(folder: Path) -> Target:
    """What a browser asks of `oasis serve`: answered or refused, and nothing is written but photos that were taken."""
    server, raised = FormServer(Jobs(folder / "served")), list[str]()
    server.handle_error = lambda request, client_address: raised.append(traceback.format_exc())
    threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
    job = server.jobs.add("a.jpg", b"photo")
    out = folder / "served" / job / "out"
    out.mkdir()
    for name in ("report.json", "avatar.safetensors"):
        (out / name).write_bytes(b"{}")
    start, host = f"/{server.token}/", f"Host: 127.0.0.1:{server.server_port}"
    asked_for = (
        ("GET", "", "\r\n"), ("GET", f"jobs/{job}", "\r\n"), ("GET", f"jobs/{job}/avatar.safetensors", "\r\n"),
        ("POST", "jobs", "Content-Length: 5\r\nX-Name: b.jpg\r\n\r\nphoto"),
    )  # fmt: skip
    files = {
        f".{k}.http": f"{method} {start}{rest} HTTP/1.1\r\n{host}\r\n{more}".encode()
        for k, (method, rest, more) in enumerate(asked_for)
    }

    def mutate(rng: np.random.Generator, data: bytes) -> bytes:
        kept = data.index(server.token.encode()) + len(server.token) if rng.random() < 0.8 else 0
        changed = damaged_bytes(rng, data[kept:])
        if rng.random() < 0.1:
            length = choose(rng, (*map(str, NUMBERS), "9" * 5000))
            changed = changed.replace(b"Content-Length: 5", f"Content-Length: {length}".encode())
        return data[:kept] + changed

    def read(path: Path) -> None:
        with socket.create_connection(server.server_address[:2], timeout=MAX_SECONDS) as asked:
            asked.sendall(path.read_bytes())
            asked.shutdown(socket.SHUT_WR)
            reply = b""
            while part := asked.recv(1 << 16):
                reply += part
        assert not raised, raised.pop()
        for extra in {path.name for path in (folder / "served").iterdir()} - {job}:
            assert [path.name for path in (folder / "served" / extra).iterdir()] == ["photo.jpg"]
            shutil.rmtree(folder / "served" / extra)
            server.jobs = Jobs(folder / "served")
        if not reply or (reply.startswith(b"HTTP/") and reply[9:10] in b"45"):
            raise InputError("refused.")

    return Target(files, mutate, read)
