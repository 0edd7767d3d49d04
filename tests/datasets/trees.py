"""Small data sets in the published formats: one person's hand, photographed from in front, with a dot on its wrist."""

import json
import pickle
from pathlib import Path

import cv2
import numpy as np

from oasis_warp.hand.mano import ManoModel, ManoPose, mano_surface, rotation_vectors

SIZE = 160
K = np.array([[300.0, 0, 83.0], [0, 300.0, 78.0], [0, 0, 1]])
PALM_UP = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
"""Fingers up in OpenCV's camera."""


def view(seed: int) -> np.ndarray:
    """A camera somewhere in the world, metres."""
    random = np.random.default_rng(seed)
    out = np.eye(4)
    out[:3, :3] = cv2.Rodrigues(random.normal(size=3))[0]
    out[:3, 3] = random.normal(size=3)
    return out


def pose_before(camera: np.ndarray, model: ManoModel, seed: int = 0, depth: float = 0.6) -> ManoPose:
    """A pose whose joints lie around the camera's axis."""
    random = np.random.default_rng(seed)
    flip = np.diag([1.0, 1, 1]) if model.side == "right" else np.diag([-1.0, 1, 1])
    seen = flip @ PALM_UP @ flip
    turn = rotation_vectors((camera[:3, :3].T @ seen)[None])[0]
    pose = ManoPose(random.normal(size=10), turn, 0.2 * random.normal(size=(15, 3)), np.zeros(3))
    middle = mano_surface(model, pose)[1].mean(0)
    goal = camera[:3, :3].T @ (np.array([0.0, 0, depth]) - camera[:3, 3])
    return pose._replace(transl=goal - middle)


def draw(path: Path, xy: np.ndarray, mask: Path | None = None) -> None:
    """A grey photo with a red dot at the first point, and a mask of all points."""
    path.parent.mkdir(parents=True, exist_ok=True)
    photo = np.full((SIZE, SIZE, 3), 90, np.uint8)
    hull = cv2.convexHull(xy.astype(np.float32)).round().astype(np.int32)
    cv2.fillPoly(photo, [hull], (150, 150, 150))
    cv2.circle(photo, tuple(int(v) for v in xy[0]), 3, (0, 0, 255), -1)
    cv2.imwrite(str(path), photo)
    if mask is not None:
        mask.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(mask), cv2.fillPoly(np.zeros((SIZE, SIZE), np.uint8), [hull], 255))


def seen(model: ManoModel, pose: ManoPose, camera: np.ndarray, K: np.ndarray = K) -> np.ndarray:
    """Joints, then vertices, in the photo [px]."""
    points = np.concatenate(mano_surface(model, pose)[::-1]) @ camera[:3, :3].T + camera[:3, 3]
    points = points @ K.T
    return points[:, :2] / points[:, 2:]


def dump(path: Path, value) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value, default=lambda a: np.asarray(a).tolist()))


def interhand(root: Path, models, split: str = "train") -> dict[str, np.ndarray]:
    """Two photos of every capture and sequence; returns the points of each sample in its photo."""
    images, annotations, mano, truth = [], [], {}, {}
    cameras = {"campos": {}, "camrot": {}, "focal": {}, "princpt": {}}
    for number in (400002, 400003):
        camera = view(number)
        cameras["campos"][str(number)] = -1000 * camera[:3, :3].T @ camera[:3, 3]
        cameras["camrot"][str(number)] = camera[:3, :3]
        cameras["focal"][str(number)], cameras["princpt"][str(number)] = K.diagonal()[:2], K[:2, 2]
    sequences = ["0007_thumbup_relaxed", "0029_indextip"] if split == "train" else ["ROM03_RT_No_Occlusion", "ROM04_X"]
    k = 0
    for capture in (0, 4):
        for sequence in sequences:
            for number in (400002, 400003):
                side, camera = ("right", "left")[k // 2 % 2], view(number)
                model = models[side]
                pose = pose_before(camera, model, k)
                name = f"Capture{capture}/{sequence}/cam{number}/image{k}.jpg"
                xy = seen(model, pose, camera)
                draw(root / "images" / split / name, xy)
                values = {"pose": np.r_[pose.global_orient, (pose.hand_pose - model.pose_mean).ravel()],
                          "shape": pose.betas, "trans": pose.transl}  # fmt: skip
                mano.setdefault(str(capture), {})[str(k)] = {"right": None, "left": None} | {side: values}
                images.append({"id": k, "file_name": name, "capture": capture, "subject": 0, "seq_name": sequence,
                               "camera": str(number), "frame_idx": k, "width": SIZE, "height": SIZE})  # fmt: skip
                box = [*xy.min(0), *np.ptp(xy, axis=0)]
                annotations.append({"id": k, "image_id": k, "bbox": box, "hand_type": side})
                truth[f"{split}/{name} {side}"] = xy
                k += 1
    folder = root / "annotations" / split
    dump(folder / f"InterHand2.6M_{split}_data.json", {"images": images, "annotations": annotations})
    dump(folder / f"InterHand2.6M_{split}_camera.json", {"0": cameras, "4": cameras})
    dump(folder / f"InterHand2.6M_{split}_MANO_NeuralAnnot.json", mano)
    return truth


def hanco(root: Path, models, split: str = "train") -> dict[str, np.ndarray]:
    """Two sequences of two frames, eight cameras each."""
    model, truth = models["right"], {}
    for sequence in (3, 154):
        for frame in range(2):
            cameras = [view(8 * frame + c) for c in range(8)]
            centre = np.array([0.3, 0.2, 0.1])
            for camera in cameras:  # all look at the same place
                camera[:3, 3] = np.array([0, 0, 0.7]) - camera[:3, :3] @ centre
            pose = pose_before(np.eye(4), model, frame)
            pose = pose._replace(transl=pose.transl + centre - mano_surface(model, pose)[1].mean(0))
            name = f"{sequence:04d}/{frame:08d}.json"
            dump(root / "calib" / name, {"K": [K] * 8, "M": cameras})
            flat = np.r_[pose.global_orient, (pose.hand_pose - model.pose_mean).ravel()]
            values = {"poses": [flat], "shapes": [pose.betas], "global_t": [[pose.transl]]}
            dump(root / "shape" / name, values if frame else np.r_[pose.betas, flat, pose.transl])
            for c, camera in enumerate(cameras):
                photo = f"{sequence:04d}/cam{c}/{frame:08d}.jpg"
                xy = seen(model, pose, camera)
                draw(root / "rgb" / photo, xy, root / "mask_hand" / photo)
                truth[f"rgb/{photo}"] = xy
    return truth


def freihand(root: Path, models, split: str = "train") -> dict[str, np.ndarray]:
    """Three photos; the place is that of the middle finger's root, by scaled orthography."""
    model, Ks, thetas, truth = models["right"], [], [], {}
    for k in range(3):
        pose = pose_before(np.eye(4), model, k, 0.5 + 0.1 * k)
        joint = mano_surface(model, pose)[1][4]
        scale = K[0, 0] / joint[2]
        uv = scale * joint[:2] + K[:2, 2]
        Ks.append(K)
        thetas.append([np.r_[pose.global_orient, (pose.hand_pose - model.pose_mean).ravel(), pose.betas, uv, scale]])
        xy = seen(model, pose, np.eye(4))
        draw(root / f"training/rgb/{k:08d}.jpg", xy, root / f"training/mask/{k:08d}.jpg")
        truth[f"training/rgb/{k:08d}.jpg"] = xy
    dump(root / "training_K.json", Ks)
    dump(root / "training_mano.json", thetas)
    return truth


def ho3d(root: Path, models, split: str = "train") -> dict[str, np.ndarray]:
    """Two sequences of one person; the camera looks along -z."""
    model, truth, turn = models["right"], {}, np.diag([1.0, -1, -1, 1])
    for k in range(3):
        pose = pose_before(turn, model, k)
        folder = root / split / f"ABF1{k % 2}"
        xy = seen(model, pose, turn)
        draw(folder / "rgb" / f"{k:04d}.png", xy)
        values = {"camMat": K, "handPose": np.r_[pose.global_orient, pose.hand_pose.ravel()], "handBeta": pose.betas,
                  "handTrans": pose.transl, "objName": "cup"}  # fmt: skip
        (folder / "meta").mkdir(exist_ok=True)
        (folder / "meta" / f"{k:04d}.pkl").write_bytes(pickle.dumps(values, 2))
        truth[f"{split}/ABF1{k % 2}/meta/{k:04d}.pkl"] = xy
    return truth


def photos(root: Path, models, split: str = "train") -> dict[str, np.ndarray]:
    """Photos of both hands with an estimator's file of every kind."""
    truth = {}
    for k, suffix in enumerate((".npz", ".pkl", ".json")):
        side = ("left", "right")[k % 2]
        pose = pose_before(np.eye(4), models["right"], k)
        place, pose = pose.transl, pose._replace(transl=np.zeros(3))
        if side == "left":
            place = place * [-1, 1, 1]
        out = {"right": float(side == "right"), "global_orient": pose.global_orient, "hand_pose": pose.hand_pose,
               "betas": pose.betas, "cam_t": place, "focal": 300.0, "centre": K[:2, 2]}  # fmt: skip
        points = np.concatenate(mano_surface(models["right"], pose)[::-1])
        points = points * ([-1, 1, 1] if side == "left" else 1) + place
        xy = (points @ K.T)[:, :2] / points[:, 2:]
        path = root / "some" / f"photo{k}.png"
        draw(path, xy)
        out = {name: np.asarray(value) for name, value in out.items()}
        if suffix == ".npz":
            np.savez(path.with_suffix(suffix), **out)
        elif suffix == ".pkl":
            path.with_suffix(suffix).write_bytes(pickle.dumps(out))
        else:
            dump(path.with_suffix(suffix), out)
        truth[f"some/photo{k}.png"] = xy
    return truth


WRITERS = {"interhand": interhand, "hanco": hanco, "freihand": freihand, "ho3d": ho3d, "coco-hand": photos,
           "whim": photos, "photos": photos}  # fmt: skip
