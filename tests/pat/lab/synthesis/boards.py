"""A calibration board in a scene: its sheet as an image on a plane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from arraygeom.pose import Pose
from pat.lab.synthesis.furnish import seeded, vec
from pat.lab.synthesis.scene import Key, Light, Material, Motion, Object, Paint, Scene, Texture, World

PIXELS = 112
"""Pixels a square of a drawn board; a multiple of the 7 modules of a 5x5 marker with its border."""


@dataclass(frozen=True, kw_only=True)
class Sheet:
    """A ChArUco board of (columns, rows) squares, printed in black on white with a margin (metres); without
    markers (0) a chessboard.

    Its frame has the origin at the outer corner of the first square, x along the columns, y along the rows, z
    away from the viewer (as OpenCV's).
    """

    squares: tuple[int, int]
    square: float
    marker: float
    margin: float

    @property
    def wh(self) -> tuple[float, float]:
        """Width and height in metres, margins included."""
        columns, rows = self.squares
        return columns * self.square + 2 * self.margin, rows * self.square + 2 * self.margin

    @property
    def inner_corners(self) -> np.ndarray:
        """Corners between squares (n, 3), board's frame, metres, row by row (as OpenCV numbers them)."""
        columns, rows = self.squares
        y, x = np.mgrid[1:rows, 1:columns] * self.square
        return np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3)

    @property
    def opencv(self) -> cv2.aruco.CharucoBoard:
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_250)
        return cv2.aruco.CharucoBoard(self.squares, self.square, self.marker, dictionary)

    def drawn(self) -> np.ndarray:
        """Black and white (h, w), `PIXELS` a square, margins included."""
        columns, rows = self.squares
        if self.marker:
            image = self.opencv.generateImage((columns * PIXELS, rows * PIXELS))
        else:
            squares = np.indices((rows, columns)).sum(0) % 2 * np.uint8(255)
            image = np.kron(squares, np.ones((PIXELS, PIXELS), np.uint8))
        return np.pad(image, round(self.margin / self.square * PIXELS), constant_values=255)


def board_scene(poses: Sequence[Pose], sheet: Sheet, image: Path) -> Scene:
    """A board at the k-th pose (world_from_board) at k seconds; its drawing is written to `image`.

    Render it with cameras of one frame a second for as many seconds as there are poses.
    """
    cv2.imwrite(str(image), sheet.drawn())
    width, height = sheet.wh
    middle = np.array([width / 2 - sheet.margin, height / 2 - sheet.margin, 0.0])
    keys = []
    for k, pose in enumerate(poses):
        R, t = pose.R.numpy(), pose.t.numpy()
        rotation = vec(Rotation.from_matrix(R).as_rotvec())
        keys.append(
            Key(position=vec(R @ middle + t), rotation=rotation, extent=(width, height, 1.0), time=float(k))
        )
    ink = Texture(kind="image", image=str(image), scale=1 / width, paints=(Paint((0.85, 0.85, 0.85), 0.85),))
    plane = Object(
        name="board", shape="plane", motion=Motion(tuple(keys)), material=Material(texture=ink, specular=0.1)
    )
    facing = np.mean([p.R[:, 2].tolist() for p in poses], axis=0) + seeded("board", 0).normal(0, 0.3, 3)
    sun = Light(kind="sun", power=1.6, direction=vec(facing), size=0.2)
    return Scene(objects=(plane,), lights=(sun,), world=World((0.3, 0.3, 0.3), 0.3))
