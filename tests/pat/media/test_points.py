"""Point clouds."""

import numpy as np
import torch

from arraygeom import Camera, Pose, intrinsics
from arraygeom.lenses import Equirectangular
from pat.media.depth_maps import VERTEX, write_points


def test_points_are_the_pixels_of_known_depth_in_the_camera_frame(tmp_path):
    pose = Pose(torch.eye(3).double(), torch.tensor([1.0, 2.0, 3.0]).double())
    camera = Camera(K=intrinsics(100.0, (3, 4), (1.0, 1.0)), cam_from_world=pose, hw=(3, 4))
    depth = torch.full((3, 4), torch.nan)
    depth[1, 1], depth[2, 3], depth[0, 0] = 5.0, 2.0, 0.0
    image = torch.zeros(3, 3, 4)
    image[:, 2, 3] = torch.tensor([1.0, 0.5, 0.0])
    assert write_points(tmp_path / "p.ply", camera, depth, image) == 2
    head, _, body = (tmp_path / "p.ply").read_bytes().partition(b"end_header\n")
    assert b"element vertex 2\n" in head
    found = np.frombuffer(body, VERTEX)
    assert np.allclose(found["X"], [[0, 0, 5], [0.04, 0.02, 2]])
    assert found["colour"].tolist() == [[0, 0, 0], [255, 128, 0]]


def test_points_at_distances_are_on_their_rays_also_behind(tmp_path):
    """A depth of a whole sphere is a distance, not z."""
    pose = Pose(torch.eye(3).double(), torch.tensor([1.0, 2.0, 3.0]).double())
    K = intrinsics(4 / torch.pi, (4, 8), (4.0, 2.0))
    camera = Camera(K=K, cam_from_world=pose, hw=(4, 8), distortion=Equirectangular())
    depth = torch.full((4, 8), torch.nan)
    depth[2, 4], depth[2, 5], depth[2, 6], depth[2, 0], depth[0, 4] = 2.0, 3.0, 4.0, 5.0, 6.0
    assert write_points(tmp_path / "p.ply", camera, depth, torch.zeros(1, 4, 8), along="distance") == 5
    found = np.frombuffer((tmp_path / "p.ply").read_bytes().partition(b"end_header\n")[2], VERTEX)["X"]
    beside = 3 / 2**0.5
    assert np.allclose(found, [[0, -6, 0], [0, 0, -5], [0, 0, 2], [beside, 0, beside], [4, 0, 0]], atol=1e-6)
