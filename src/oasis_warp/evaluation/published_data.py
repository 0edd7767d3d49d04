"""Published data sets as evaluations read them: cut out as in the paper, in MANO's own poses."""

import os
from pathlib import Path
from typing import get_args

import torch

from oasis_warp.core.config import ReconstructConfig
from oasis_warp.core.types import Camera, HandPose, Photo, Side
from oasis_warp.datasets.readers import PAPER, DatasetName, read_dataset, read_selection
from oasis_warp.datasets.samples import Catalogue, Models, load_picture
from oasis_warp.datasets.training_source import in_camera
from oasis_warp.estimation.keypoints import fit_of_pose
from oasis_warp.evaluation.data_sets import Key, Sample
from oasis_warp.hand.mano import read_mano
from oasis_warp.hand.template import MANO_DIR, chosen_hand


class CatalogueData:
    """The samples of a catalogue as a `DataSet`, all as right hands of MANO."""

    def __init__(self, found: Catalogue, models: Models, config: ReconstructConfig, size: int):
        self.keys = [Key(sample.subject, sample.name) for sample in found.samples]
        self.left_out = found.left_out
        self._samples = {sample.name: sample for sample in found.samples}
        self._models, self._size = models, size
        self._hand = chosen_hand(config.hand_model, config.mano_dir)

    @classmethod
    def open(
        cls, name: DatasetName, root: Path, config: ReconstructConfig, size: int, selection: Path | None = None
    ) -> "CatalogueData":
        """What the paper evaluates on, of the data set below `root`; of InterHand2.6M what a file selects.

        Raises:
            InputError: no such folder, no file of MANO, or not one sample.
        """
        chosen_hand(config.hand_model, config.mano_dir)  # says what is missing
        folder = Path(config.mano_dir or os.environ[MANO_DIR])
        models: Models = {side: read_mano(folder, side) for side in get_args(Side)}
        chosen = PAPER if selection is None else read_selection(selection)
        return cls(read_dataset(name, root, folder, "test", chosen), models, config, size)

    def read(self, key: Key) -> Sample:
        """The square around the hand, and the annotated pose.

        Raises:
            InputError: the photo or its mask is missing or broken, or its box is too small.
        """
        picture = load_picture(self._samples[key.name], self._models, self._size)
        K = picture.camera.K.float()
        rgb = (255 * picture.image).round().to(torch.uint8)
        photo = Photo(rgb, picture.mask, float(K[0, 0]), key.name, 1.0)
        pose = HandPose(*(part.float() for part in in_camera(self._hand, picture.mano, picture.camera.viewmat)))
        camera = Camera(torch.eye(4), K, self._size, self._size)
        return Sample(photo, fit_of_pose(self._hand, photo, "right", picture.mano.betas, pose, camera))
