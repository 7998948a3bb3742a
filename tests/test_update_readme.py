"""Blocks of a document that commands fill."""

import pytest
import torch

from docs.update_readme import Readme, quoted, quoting, with_block, without_images
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


TABLE = "| a | b | c |\n|---|---|---|\n| x | 1 | 2 |\n| y | 3 | 4 |\n"
REPORT = f"*Printed on 2026-01-02.*\n\n{TABLE}\n| d |\n|---|\n| z |\n"


def test_rows_and_columns_are_quoted_with_their_date():
    table, date = quoted(REPORT, ["y"], ["c"])
    assert date == "*Printed on 2026-01-02.*"
    assert table == "| a | c |\n| --- | --- |\n| y | 4 |"
    assert list(quoted(REPORT, ["none"])) == []


def test_the_document_is_brought_up_to_date_and_so_are_pages_that_quote_it(tmp_path):
    (tmp_path / "reports").mkdir()
    document, page, content = tmp_path / "reports" / "d.md", tmp_path / "page.md", tmp_path / "c.md"
    document.write_text(TEXT)
    content.write_text("| a | b |\n|---|---|\n| x | 5 |\n![p](p.png)\n")
    page.write_text("so\n<!-- from reports/d.md: x -->\nold\n<!-- end -->\nit is\n")
    write_image(tmp_path / "p.png", torch.full((3, 40, 80), 0.5))
    Readme(document, (f"a={content}",), (tmp_path / "p.png", tmp_path / "docs" / "p.jpg")).run()
    assert read_image(tmp_path / "docs" / "p.jpg").shape == (3, 30, 60)
    assert "![p]" not in document.read_text()
    assert "| x | 5 |" in page.read_text()
    assert "old" not in page.read_text()
    assert quoting(page) == page.read_text()


def test_a_row_that_is_not_there_is_named(tmp_path):
    (tmp_path / "d.md").write_text(REPORT)
    (tmp_path / "page.md").write_text("<!-- from d.md: gone -->\n<!-- end -->")
    with pytest.raises(ValueError, match="gone"):
        quoting(tmp_path / "page.md")
