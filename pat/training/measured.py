"""Stereo pairs, true disparity of both images, as training samples: images, depth, occlusion are known."""

from __future__ import annotations

from pathlib import Path

from pat.data.pairs import MIDDLEBURY, PairFiles
from pat.media.images import read_image

from .stereo import PairCrops, Pictures

COUNTERPART = {"disp2.png": "disp6.png", "disp1.png": "disp5.png"}
"""Files of the disparity of the right image, by those of the left."""


class MeasuredPairs(PairCrops):
    """Random windows of Middlebury's pairs in folders, of the collections of 2003, 2005 and 2006.

    Raises ValueError as `PairCrops`, and for a pair without the disparity of both images.
    """

    def check(self, pair: PairFiles) -> None:
        """Raise ValueError for a pair that cannot be used."""
        super().check(pair)
        disparity_files(pair)

    def read(self, pair: PairFiles) -> Pictures:
        """The images and disparities of a pair."""
        left, right = (read_image(path)[0] * 255 for path in disparity_files(pair))
        scale = 255 / pair.max_disparity
        return super().read(pair)._replace(disparities=(left / scale, right / scale))


def disparity_files(pair: PairFiles) -> tuple[Path, Path]:
    """Of the left and of the right image. Raises ValueError where one is missing."""
    for layout in MIDDLEBURY.values():
        files = [
            pair.left.with_name(name)
            for name in (layout.ground_truth, COUNTERPART.get(layout.ground_truth, "-"))
        ]
        if pair.left.name == layout.left and all(file.is_file() for file in files):
            return files[0], files[1]
    raise ValueError(
        f"{pair.left.parent}: wanted the true disparity of both images beside them, disp1.png and disp5.png"
    )
