"""The people of a world: texture, rest surface with the relief that the template lacks, accessories, baked once."""

import functools
import json
from collections import OrderedDict
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save
from torch import Tensor

from oasis_warp import __version__
from oasis_warp.core.logging import Progress, silent
from oasis_warp.core.processes import worker_pool
from oasis_warp.data.output_files import write_file
from oasis_warp.synthetic.body import ARM_ROWS, arm_rows, body_on, bundled_body, device_name, rising
from oasis_warp.synthetic.identity import Identity, Population, sample_identity
from oasis_warp.synthetic.ops.skin_shading import surface_state
from oasis_warp.synthetic.ops.surface_patterns import NoiseField, surface_noise
from oasis_warp.synthetic.skin_plan import SkinPlan, plan_person
from oasis_warp.synthetic.skin_texture import bake_texture
from oasis_warp.synthetic.texels import texels_on
from oasis_warp.synthetic.wardrobe import ring_at_rest, ring_material

PERSON_BYTES = 24_000_000
"""Size of a cached person, nearly all of it texture."""
CPU_CACHED = 48
"""People that are cached on the CPU."""
CUDA_SHARE = 0.5
"""Share of a GPU's memory that people may fill: 3,000 people on an H200."""
MAX_PLANNED_HERE = 48
"""Up to this number people are planned faster by this process than by workers, which take seconds to start."""
PLANS_AT_ONCE = 8
"""Plans that a worker returns together."""
FORMAT = "oasis-person"
_UP, _PAD, _BACK_OF_KNUCKLE = np.array([0.0, 8, 0]), np.array([-5.0, -12, 0]), np.array([1.5, 0, 0])
_ACROSS = (1, 4, 10, 7)
"""First joints of index, middle, ring and little finger, in anatomical order."""
_TENDONS = (0.75, 1.0, 0.85, 0.6)
"""How far their tendons stand out, relative to the middle finger's; all fade towards the wrist."""


class Person(NamedTuple):
    """All that rendering needs of a person; metres, in the hand's frame."""

    identity: Identity
    texture: Float[Tensor, "Y X 8"]
    """float16, see `skin_texture.CHANNELS`."""
    rest: Float[Tensor, "V 3"]
    """The hand's vertices: shape and relief."""
    joints: Float[Tensor, "16 3"]
    tips: Float[Tensor, "5 3"]
    areas: Float[Tensor, "K"]
    """Vertex areas of hand and forearm at rest, see `ops.skin_shading.surface_state`."""
    tone: Float[Tensor, "3"]
    """Mean reflectance."""
    ring: Float[Tensor, "R 3"]
    ring_material: tuple[float, ...]


_cache: OrderedDict[tuple[int, int, Population, str], Person] = OrderedDict()


def person(seed: int, number: int, population: Population, device: torch.device | str) -> Person:
    """Person `number` of the world `seed`, from the cache or baked in a second on a CPU."""
    key = (seed, number, population, device_name(device))
    if key in _cache:
        _cache.move_to_end(key)
        return _cache[key]
    return _remember(key, _bake_person(*key))


@functools.cache
def max_people_cached(device: str) -> int:
    """Number of people that the cache of a device holds."""
    if torch.device(device).type == "cpu":
        return CPU_CACHED
    return int(CUDA_SHARE * torch.cuda.get_device_properties(device).total_memory / PERSON_BYTES)


def bake_people(
    seed: int, numbers: Sequence[int], population: Population, device: torch.device | str, *, jobs: int,
    folder: Path | None = None, progress: Progress = silent,
) -> None:  # fmt: skip
    """Bake people into the cache, so that training never waits for them.

    Args:
        seed: Seed of the world.
        numbers: Numbers of the people.
        population: What people may have.
        device: Where people are baked and cached.
        jobs: Number of worker processes, or 0. On the CPU they bake; for a CUDA device they plan the skin, which this
            process bakes, unless people are few.
        folder: Folder of files with people baked on the CPU, 23 MB each, which are read when they exist; None for no
            files. A CUDA device bakes about as fast as a disk reads.
        progress: Called for every person.

    Raises:
        ValueError: more people than the cache holds.
        InputError: the folder cannot be written.
    """
    device = device_name(device)
    most = max_people_cached(device)
    if len(numbers) > most:
        raise ValueError(
            f"numbers: expected at most {most} people on {device}, got {len(numbers)}. The cache holds no more."
        )
    missing = [n for n in numbers if (seed, n, population, device) not in _cache]
    count = len(missing)
    if missing:
        progress("people", 0, count)

    def keep(made: Iterable[Person | Path | SkinPlan]) -> None:
        for k, (number, found) in enumerate(zip(missing, made, strict=True)):
            if isinstance(found, Path):
                found = _read(found, seed, number, population)
            elif isinstance(found, SkinPlan):
                found = _finish_person(found, device)
            _remember((seed, number, population, device), found)
            progress("people", k + 1, count)

    on_cpu = device == "cpu"
    what = ([seed] * count, missing, [population] * count)
    work, what = (_bake_or_find, (*what, [folder] * count)) if on_cpu else (plan_person, what)
    if jobs < 1 or (not on_cpu and count <= MAX_PLANNED_HERE):
        keep(map(work, *what))
        return
    with worker_pool(jobs) as pool:
        try:
            made = pool.map(work, *what, chunksize=1 if on_cpu else PLANS_AT_ONCE)
            if not on_cpu:
                texels_on(device)  # takes seconds, in which the processes start
            keep(made)
        except BaseException:
            pool.shutdown(cancel_futures=True)  # else hundreds of people would still be baked
            raise


def _bake_or_find(seed: int, number: int, population: Population, folder: Path | None) -> Person | Path:
    """A person baked on the CPU, or with a folder the path of its file, which may exist already."""
    if folder is None:
        return _bake_person(seed, number, population, "cpu")
    path = folder / f"{number:06d}.safetensors"
    if not _is_whole(path, _describe(seed, number, population)):
        found = _bake_person(seed, number, population, "cpu")
        tensors = {name: value.contiguous() for name, value in found._asdict().items() if isinstance(value, Tensor)}
        write_file(path, save(tensors, {FORMAT: _describe(seed, number, population)}))
    return path


def _describe(seed: int, number: int, population: Population) -> str:
    """A text that identifies a person and the version of this package that baked it."""
    return json.dumps([__version__, seed, number, asdict(population)], sort_keys=True)


def _is_whole(path: Path, about: str) -> bool:
    if not path.is_file():
        return False
    try:
        with safe_open(path, framework="pt") as file:
            return (file.metadata() or {}).get(FORMAT) == about
    except SafetensorError:  # truncated: bake it again
        return False


def _read(path: Path, seed: int, number: int, population: Population) -> Person:
    """Read a file that `_bake_or_find` has written."""
    identity = sample_identity(bundled_body().hand, seed, number, population)
    return Person(identity=identity, ring_material=ring_material(identity), **load_file(path))


def _remember(key: tuple[int, int, Population, str], found: Person) -> Person:
    """Cache a person; drop the least recently used one on the same device when the cache is full."""
    device = key[3]
    _cache[key] = found
    if sum(k[3] == device for k in _cache) > max_people_cached(device):
        del _cache[next(k for k in _cache if k[3] == device)]
    return found


def _bake_person(seed: int, number: int, population: Population, device: str) -> Person:
    """Plan and bake a person on the device."""
    return _finish_person(plan_person(seed, number, population), device)


@torch.no_grad()
def _finish_person(plan: SkinPlan, device: str) -> Person:
    """Bake the texture and surface of a planned person."""
    body, identity = body_on(device), plan.identity
    hand = body.hand
    shape = torch.from_numpy(identity.shape).float().to(device)
    smooth = hand.template + hand.shape_basis @ shape
    rest = smooth + body.normals[: body.n_hand] * relief(identity, device)[:, None]
    joints, tips = hand.joints + hand.joint_basis @ shape, hand.tips + hand.tip_basis @ shape
    texture = bake_texture(plan, device)
    eye = torch.eye(3, device=device).expand(1, ARM_ROWS, 3, 3)
    arm = arm_rows(rest[hand.rim][None], eye, torch.tensor([identity.arm_girth], device=device))
    whole = torch.cat([rest, arm.reshape(-1, 3)])[None]
    return Person(
        identity,
        texture,
        rest,
        joints,
        tips,
        surface_state(whole, body.skin_faces).areas[0],
        texture[..., :3].float().mean((0, 1)),
        ring_at_rest(body, rest, joints, identity),
        ring_material(identity),
    )


@functools.cache
def relief_forms() -> np.ndarray:
    """Heights of the hand's vertices [mm], [V, 4]: constant, and per unit of bony, tendons, and bony x tendons."""
    body = bundled_body()
    n = body.n_hand
    points, normals = body.rest[:n].double().numpy(), body.normals[:n].double().numpy()
    weights = body.finger_weights[:n].double().numpy()
    common, bony, tendons, both = out = np.zeros((4, n))
    back, palm = rising(normals[:, 1], 0.1, 0.7), rising(-normals[:, 1], 0.1, 0.7)

    def blob(center: np.ndarray, radius: float | list[float | int]) -> np.ndarray:
        return np.exp(-(((points - center) / radius) ** 2).sum(1))

    for finger, bones in enumerate(body.bones):
        here = rising(weights[:, finger], 0.3, 0.7)
        for place, bone in enumerate(bones):
            along = (points - bone.origin) @ bone.along
            up = normals @ bone.back
            level = 1 - np.abs(up)
            if place or finger == 4:
                joint = np.exp(-((along / 4.5) ** 2)) * here
                valley = 0.65 * np.exp(-((along / 2.2) ** 2)) * rising(-up, 0.1, 0.6)
                common += joint * (0.3 * level - valley)
                bony += joint * (0.5 * rising(up, -0.2, 0.4) + 0.5 * level)
            pad = np.exp(-(((along - 0.52 * bone.length) / (0.30 * bone.length)) ** 2))
            common += here * rising(-up, 0.1, 0.7) * 0.85 * pad
            if place < 2:  # phalanges are waisted between the joints
                common -= here * level * 0.15 * pad
                bony -= here * level * 0.45 * pad
    joints = body.hand.joints.double().numpy() * 1e3
    knuckles = joints[list(_ACROSS)]
    for i, knuckle in enumerate(knuckles):
        up = body.hand.pose_axes[_ACROSS[i], 1].double().numpy()
        bony += back * 1.7 * blob(knuckle + up * 9 + _BACK_OF_KNUCKLE, 8.5)
        s = np.clip((points - knuckle) @ -knuckle / (knuckle @ knuckle), 0, 1)
        off = np.linalg.norm((points - knuckle * (1 - s)[:, None])[:, [0, 2]], axis=1)
        tendon = _TENDONS[i] * back * rising(s, 1.0, 0.25) * 1.2 * np.exp(-((off / 2.6) ** 2))
        tendons += 0.3 * tendon
        both += 0.9 * tendon
        if i < 3:
            between = (knuckle + knuckles[i + 1]) / 2
            hollow = back * (blob(between + _UP, 6.5) + 0.55 * blob(between * 0.72 + _UP, [18, 15, 4.0]))
            common -= 0.4 * hollow
            bony -= 1.5 * hollow
        common += palm * 0.7 * blob(knuckle + _PAD, 8.0)
    common += palm * (
        1.6 * blob(np.array([-42, -22, 24]), [22, 20, 13])
        + 1.3 * blob(np.array([-35, -18, -26]), [26, 20, 11])
        - 1.6 * blob(np.array([-62, -14, -2]), [17, 20, 15])
    )
    return out.T


@functools.cache
def _forms_on(device: str) -> Float[Tensor, "V 4"]:
    return torch.from_numpy(relief_forms()).float().to(device)


def relief(identity: Identity, device: str) -> Float[Tensor, "V"]:
    """Displacement of the hand's vertices along their normals [m]."""
    bony, tendons = identity.bony, identity.tendons
    forms, body = _forms_on(device), body_on(device)
    lumps = surface_noise(body.rest[: body.n_hand], [NoiseField(13.0, identity.seed + 5, 2)])[0]
    return (forms @ forms.new_tensor([1, bony, tendons, bony * tendons]) + 0.25 * lumps) * 1e-3
