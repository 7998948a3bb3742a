"""Blocks of a document that commands fill."""

import pytest
import torch

from docs.update_readme import Readme, with_block, without_images
from pat.media.images import read_image, write_image

TEXT = "before\n<!-- a:begin -->\nold\n<!-- a:end -->\nafter\n"


def test_only_the_block_changes_and_twice_is_once():
    once = with_block(TEXT, "a", "new\n")
    assert once == "before\n<!-- a:begin -->\n\nnew\n\n<!-- a:end -->\nafter\n"
    assert with_block(once, "a", "new\n") == once


@pytest.mark.parametrize(
    "text", ["none", "<!-- a:begin -->" + TEXT, TEXT + "<!-- a:end -->", "<!-- a:end --><!-- a:begin -->"]
)
def test_marks_are_wanted_once_and_in_order(text):
    with pytest.raises(ValueError, match="a:begin"):
        with_block(text, "a", "new")


def test_lines_that_are_images_go():
    assert without_images("a\n![p](p.png)\nb ![q](q.png)\n") == "a\nb ![q](q.png)\n"


def test_the_document_is_brought_up_to_date(tmp_path):
    document, content = tmp_path / "d.md", tmp_path / "c.md"
    document.write_text(TEXT)
    content.write_text("new\n![p](p.png)\n")
    write_image(tmp_path / "p.png", torch.full((3, 40, 80), 0.5))
    Readme(document, (f"a={content}",), (tmp_path / "p.png", tmp_path / "docs" / "p.jpg")).run()
    assert read_image(tmp_path / "docs" / "p.jpg").shape == (3, 30, 60)
    assert document.read_text() == with_block(TEXT, "a", "new")
