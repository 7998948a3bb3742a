"""Matched points from CSV files and COLMAP databases, and what is refused."""

import sqlite3
from pathlib import Path

import numpy as np
import pytest
import torch

from pat.app.point_matches import MAX_IMAGES, read_matches

FILES = {"mono": Path("photos/a.png"), "colour": Path("photos/b.png")}
SIZES = {"mono": (60, 80), "colour": (50, 70)}
POINTS = (
    np.array([[1.0, 2.0], [30.5, 40.25], [79.0, 59.0]]),
    np.array([[3.0, 4.0], [20.0, 21.0], [69.0, 49.0]]),
)


def database(path, *, verified=True, names=("set/a.png", "set/b.png")):
    """A COLMAP database (by its documentation): pixels from .5, numbers of keypoints in another order."""
    with sqlite3.connect(path) as file:
        file.execute("CREATE TABLE images (image_id INTEGER, name TEXT)")
        file.execute("CREATE TABLE keypoints (image_id INTEGER, rows INTEGER, cols INTEGER, data BLOB)")
        for table in ("matches", "two_view_geometries"):
            file.execute(f"CREATE TABLE {table} (pair_id INTEGER, rows INTEGER, cols INTEGER, data BLOB)")
        for number, (name, points) in enumerate(zip(names, (POINTS[0], POINTS[1][::-1])), 1):
            six = np.concatenate([points + 0.5, np.zeros((len(points), 4))], 1).astype(np.float32)
            file.execute("INSERT INTO images VALUES (?, ?)", (number, name))
            file.execute("INSERT INTO keypoints VALUES (?, ?, 6, ?)", (number, len(points), six.tobytes()))
        pairs = np.array([[0, 2], [1, 1], [2, 0]], np.uint32)
        table = "two_view_geometries" if verified else "matches"
        file.execute(f"INSERT INTO {table} VALUES (?, 3, 2, ?)", (MAX_IMAGES + 2, pairs.tobytes()))


@pytest.mark.parametrize("text", ["x0,y0,x1,y1\n{}", "{}", "# alpha beta\n{}"])
@pytest.mark.parametrize("between", [",", " ", "\t", ";"])
def test_csv(tmp_path, text, between):
    rows = "\n".join(between.join(map(str, row)) for row in np.hstack(POINTS))
    for encoding in ("utf-8", "utf-8-sig", "utf-16"):  # as spreadsheets write, whose mark cost the first row
        (tmp_path / "m.csv").write_text(text.format(rows), encoding=encoding)
        found = read_matches(tmp_path / "m.csv", FILES, SIZES)["mono", "colour"]
        for one, points in zip(found, POINTS):
            assert np.array_equal(one.numpy(), points)


@pytest.mark.parametrize("first", ["1.0,abc,3.0,4.0", "1.0,2.0,3.0", "1.0,2.0,3.0,"])
def test_a_first_line_of_csv_with_numbers_is_no_header(tmp_path, first):
    """A first line with a number missing or misspelt is an error."""
    (tmp_path / "m.csv").write_text(f"{first}\n5,6,7,8\n")
    with pytest.raises(ValueError, match=f"'{first}'"):
        read_matches(tmp_path / "m.csv", FILES, SIZES)


@pytest.mark.parametrize("folder", ["run #1", "100%25", "what?", "50%", "é 1"])
def test_colmap_in_folders_of_odd_names(tmp_path, folder):
    (tmp_path / folder).mkdir()
    database(tmp_path / folder / "database.db")
    found = read_matches(tmp_path / folder / "database.db", FILES, SIZES)["mono", "colour"]
    assert torch.allclose(found[0], torch.from_numpy(POINTS[0]))


@pytest.mark.parametrize(
    "change", ["UPDATE keypoints SET rows = 1, data = zeroblob(24)", "UPDATE keypoints SET data = NULL"]
)
def test_a_damaged_database_is_named(tmp_path, change):
    path = tmp_path / "database.db"
    database(path)
    with sqlite3.connect(path) as file:
        file.execute(change)
    with pytest.raises(ValueError, match=r"database\.db.*COLMAP"):
        read_matches(path, FILES, SIZES)


def test_a_keypoint_that_is_no_number_is_refused(tmp_path):
    path = tmp_path / "database.db"
    database(path)
    with sqlite3.connect(path) as file:
        file.execute("UPDATE keypoints SET data = ?", (np.full((3, 6), np.nan, np.float32).tobytes(),))
    with pytest.raises(ValueError, match="3 of 3"):
        read_matches(path, FILES, SIZES)


@pytest.mark.parametrize("header", ["id,x0,y0,x1,y1,score", 'score, "Y0", "X0", "Y1", "X1"'])
def test_a_header_names_the_columns(tmp_path, header):
    """Columns are read by their names, in any order."""
    (tmp_path / "m.csv").write_text(f"{header}\n7,1,2,3,4,.5\n")
    found = read_matches(tmp_path / "m.csv", FILES, SIZES)["mono", "colour"]
    turned = "Y0" in header
    assert [x.tolist() for x in found] == ([[[2, 1]], [[4, 3]]] if turned else [[[1, 2]], [[3, 4]]])


@pytest.mark.parametrize("verified", [True, False])
def test_colmap(tmp_path, verified):
    database(tmp_path / "database.db", verified=verified)
    found = read_matches(tmp_path / "database.db", FILES, SIZES)["mono", "colour"]
    for one, points in zip(found, POINTS):
        assert torch.allclose(one, torch.from_numpy(points))


def test_colmap_pairs_are_of_the_cameras_whatever_their_order(tmp_path):
    database(tmp_path / "database.db")
    turned = dict(reversed(FILES.items()))
    assert list(read_matches(tmp_path / "database.db", turned, SIZES)) == [("mono", "colour")]


def test_images_of_colmap_called_alike_are_told_by_their_folders(tmp_path):
    """Images of a rig often have one name in several folders."""
    database(tmp_path / "database.db", names=("mono/1.png", "colour/1.png"))
    files = {name: Path(f"photos/{name}/1.png") for name in FILES}
    found = read_matches(tmp_path / "database.db", files, SIZES)["mono", "colour"]
    for one, points in zip(found, POINTS):
        assert torch.allclose(one, torch.from_numpy(points))
    with pytest.raises(ValueError, match=r"photos/1.png.*mono/1.png"):
        read_matches(tmp_path / "database.db", {**files, "mono": Path("photos/1.png")}, SIZES)
    with pytest.raises(ValueError, match="'colour' and 'mono'"):
        read_matches(tmp_path / "database.db", {"colour": files["mono"], "mono": files["mono"]}, SIZES)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"1,2,3,4\n1,2,300,4\n", r"1 of 2 .*'colour', 70x50"),
        (b"1,2,3,4\n1,2,3\n", "'1,2,3'"),
        (b"1,2,3\n1,2,3,4\n", "'1,2,3'"),  # taken for a header
        (b"1,2,nan,4\n", "finite"),
        (b"", "numbers"),
        (b"\xff\xfe\x00", "neither CSV nor"),
        (b"SQLite format 3\0" + bytes(100), "not a COLMAP database"),
    ],
)
def test_what_is_refused(tmp_path, content, message):
    (tmp_path / "m.csv").write_bytes(content)
    with pytest.raises(ValueError, match=message):
        read_matches(tmp_path / "m.csv", FILES, SIZES)


def test_files_and_images_that_are_missing_are_named(tmp_path):
    (tmp_path / "m.csv").write_text("1,2,3,4\n")
    with pytest.raises(ValueError, match="3"):
        read_matches(tmp_path / "m.csv", {**FILES, "nir": Path("c.png")}, SIZES)
    with pytest.raises(FileNotFoundError, match=r"none\.csv"):
        read_matches(tmp_path / "none.csv", FILES, SIZES)
    database(tmp_path / "other.db", names=("set/c.png", "set/b.png"))
    with pytest.raises(ValueError, match=r"a.png .*set/c.png, set/b.png"):
        read_matches(tmp_path / "other.db", FILES, SIZES)
