"""Calibration boards as images, and as OpenCV knows them."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy.typing import NDArray

from .scene import BoardObject

PIXELS = 112
"""Pixels a square of a drawn board; a multiple of the 7 modules of a 5x5 marker with its border."""


def opencv_board(board: BoardObject) -> cv2.aruco.CharucoBoard:
    """The same board for OpenCV's detector. Raises ValueError for a dictionary it does not have."""
    code = getattr(cv2.aruco, board.dictionary, None)
    if code is None:
        raise ValueError(f"unknown marker dictionary '{board.dictionary}': OpenCV has DICT_4X4_50, DICT_5X5_250, ...")
    dictionary = cv2.aruco.getPredefinedDictionary(code)
    return cv2.aruco.CharucoBoard(board.squares, board.square, board.marker, dictionary)


def draw_board(board: BoardObject) -> UInt8[NDArray, "h w"]:
    """The sheet, margins included: black and white, `PIXELS` a square."""
    columns, rows = board.squares
    if board.kind == "charuco":
        image = opencv_board(board).generateImage((columns * PIXELS, rows * PIXELS))
    else:
        squares = np.indices((rows, columns)).sum(0) % 2 * np.uint8(255)
        image = np.kron(squares, np.ones((PIXELS, PIXELS))).astype(np.uint8)
    margin = round(board.margin / board.square * PIXELS)
    return np.asarray(np.pad(image, margin, constant_values=255))
