"""Sample arrays that ship with the package or with scikit-image."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from arraygeom import Camera, Pose, Rig
from pat.media.colour import luminance, luminance_of
from pat.media.images import read_image

SAMPLE = Path(__file__).parent / "sample"
ALPHA, BETA = "mono", "colour"


class SampleArray(NamedTuple):
    """Array of a mono alpha and a colour beta of different focal length and pose, with ground truth.

    Attributes:
        rig: rig of the images.
        images: images, values 0..1, by camera: "mono" (1, h, w) and "colour" (3, h, w), of their own sizes.
        ground_truth: image of alpha's view in true colour, values 0..1.
    """

    rig: Rig
    images: dict[str, Tensor]
    ground_truth: Float[Tensor, "3 h w"]


def load_sample(folder: Path = SAMPLE) -> SampleArray:
    """Load the sample array, or one from a folder with rig.yaml, truth.png and NAME.png of each camera.

    Raises:
        FileNotFoundError: for a missing file; ValueError for a damaged one.
    """
    rig = Rig.load(folder / "rig.yaml")
    images = {name: read_image(folder / f"{name}.png") for name in rig.names}
    return SampleArray(rig, {**images, ALPHA: luminance_of(images[ALPHA])}, read_image(folder / "truth.png"))


def load_motorcycle() -> SampleArray:
    """Load a real pair in scikit-image, with its published geometry (Scharstein et al., GCPR 2014).

    The left photograph made grey is the mono camera's, the right one at half its size the colour one's.

    Returns:
        The array, with a depth range in metres; the left photograph is the ground truth.
    """
    from skimage.data import stereo_motorcycle

    photos = (photo[:, :740].copy() for photo in stereo_motorcycle()[:2])
    left, right = (torch.from_numpy(photo).movedim(-1, 0) / 255 for photo in photos)
    K = torch.tensor([[994.978, 0, 311.193], [0, 994.978, 254.877], [0, 0, 1]], dtype=torch.float64)
    one = Camera(K=K, cam_from_world=Pose.identity(), hw=(500, 740))
    shifted = K + torch.tensor([[0, 0, 31.086], [0, 0, 0], [0, 0, 0]])
    other = one.replace(K=shifted, cam_from_world=Pose(one.R, torch.tensor([-0.193001, 0, 0]).to(K)))
    rig = Rig({ALPHA: one, BETA: other.resize((250, 370))}, depth=(1.8, 8.0), name="motorcycle")
    return SampleArray(rig, {ALPHA: luminance(left), BETA: avg_pool2d(right, 2)}, left)
