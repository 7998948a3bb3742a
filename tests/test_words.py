"""One meaning a name, and the field's words: in public names, command help, README and docs."""

import ast
import json
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("arraygeom", "pat", "calib")
MODULES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
DOCUMENTS = sorted(
    [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("**/*.md"), *(ROOT / "arraygeom").glob("*.md")]
)
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))

NOT_IN_NAMES = {
    r"pictures?": "image",
    r"turn(s|ed|ing)?": "rotate",
    r"bend|bent|straight(en|ened)": "distort, undistort",
    r"mapped|retaken": "transformed, resampled",
    r"look(s|ed|er)?": "sampling locations, segment",
    r"told|tells?": "known, observable",
    r"(un)?coded": "sRGB-encoded",
    r"places?|placed": "position",
    r"pitch": "angular resolution",
    r"truths?": "ground truth",
    r"(un)?sure|certain|trust(ed|s)?|doubt|believed?": "confidence, weight",
    r"survey(s|ed)?": "pre-pass, precomputed matches",
    r"balances?|levelled": "radiometric normalisation",
    r"carry|carried": "propagate, warp",
    r"spread": "diffused, standard deviation",
    r"reach": "disparity",
    r"consensus": "semi-global matching",
    r"foretold|examin(ation|ed)": "predicted, validation",
    r"blame": "backward",
}
"""Words that names are not made of, and what the field says."""
ALLOWED_NAMES = re.compile(
    r"ground_truths?|GroundTruth|lookup|look_at"  # these are the terms
    r"|quarter_turns"  # rot90's own argument
    r"|PITCH|pixel_pitch"  # of a sensor, metres
)

NOT_IN_PROSE = {
    r"pictures?": "image",
    r"turned|turning": "rotated",
    r"bends?|bent|straighten(s|ed)?": "distort, undistort",
    r"retaken|taken (across|over)": "resampled",
    r"where to look|looks?(?! at\b)|look(ed|ing)": "sampling locations, search segment",
    r"told|tells?": "say, show, known, observable",
    r"(?<!-)coded": "sRGB-encoded",
    r"at (one|the same) place|in its place": "co-located, position",
    r"(?<!pixel )pitch": "angular resolution",
    r"truth": "ground truth",
    r"(un)?sure|trust(ed|s)?|believed?": "confidence, weight",
    r"survey(s|ed)?": "pre-pass, precomputed matches",
    r"(?<!white )balances?|levelled": "radiometric normalisation",
    r"carry|carries|carried": "propagate, warp",
    r"consensus": "semi-global matching",
    r"foretold|examination|in hand": "predicted, validation, cache",
    r"worked (off|out)|betters": "computed, processed; improves",
    r"whole or not at all": "atomically",
}
"""Words and phrases that README, docs and command help do without, and what the field says."""
ALLOWED_PROSE = re.compile(r"`[^`\n]*`|\]\([^)]*\)|in turn\b|ground[ \n]truths?", re.I)
"""Code, links and phrases that are left out before the words are looked for."""


def public_names(path: Path) -> Iterator[tuple[int, str]]:
    """Classes, functions, arguments, fields and constants of a module, outside functions, without an underscore."""
    yield 0, path.stem
    bodies = [ast.parse(path.read_text()).body]
    while bodies:
        for node in bodies.pop():
            if isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_"):
                yield node.lineno, node.name
                if isinstance(node, ast.ClassDef):
                    bodies.append(node.body)
                else:
                    yield from ((a.lineno, a.arg) for a in (*node.args.args, *node.args.kwonlyargs))
            targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
            yield from ((node.lineno, t.id) for t in targets if isinstance(t, ast.Name) and t.id[0] != "_")


def words_of(name: str) -> list[str]:
    """The words of a name in snake or camel case."""
    return [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", ALLOWED_NAMES.sub("_", name))]


def wrong_names(path: Path) -> list[str]:
    return [
        f"{path.relative_to(ROOT)}:{line}: {name} ({instead})"
        for line, name in public_names(path)
        for pattern, instead in NOT_IN_NAMES.items()
        if any(re.fullmatch(pattern, word) for word in words_of(name))
    ]


def wrong_prose(text: str) -> list[str]:
    """Lines with a word that is not the field's; blocks of code are left out."""
    text = re.sub(r"^( *)```.*?^\1```", lambda m: "\n" * m[0].count("\n"), text, flags=re.M | re.S)
    lines = enumerate(ALLOWED_PROSE.sub(lambda m: "\n" * m[0].count("\n"), text).splitlines(), 1)
    return [
        f"{number}: '{found[0]}' ({instead}): {line.strip()[:80]}"
        for number, line in lines
        for pattern, instead in NOT_IN_PROSE.items()
        if (found := re.search(rf"\b({pattern})\b", line, re.I))
    ]


def help_texts(path: Path) -> str:
    """The strings that stand alone in a module: docstrings of commands and of their options."""
    alone = (node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Expr))
    return "\n".join(
        n.value.value for n in alone if isinstance(n.value, ast.Constant) and isinstance(n.value.value, str)
    )


def each(paths: list[Path]):
    return pytest.mark.parametrize("path", paths, ids=lambda p: str(p.relative_to(ROOT)))


def test_every_public_class_name_occurs_once():
    places = defaultdict(list)
    for path in MODULES:
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places[node.name].append(str(path.relative_to(ROOT)))
    assert {name: paths for name, paths in places.items() if len(paths) > 1} == {}


@pytest.mark.parametrize("room", sorted({path.parent for path in MODULES}), ids=lambda p: str(p.relative_to(ROOT)))
def test_public_names_are_the_fields_words(room):
    assert [line for path in MODULES if path.parent == room for line in wrong_names(path)] == []


@each(DOCUMENTS)
def test_documents_use_the_fields_words(path):
    assert wrong_prose(path.read_text()) == []


@each(NOTEBOOKS)
def test_notebooks_use_the_fields_words(path):
    cells = json.loads(path.read_text())["cells"]
    assert wrong_prose("\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "markdown")) == []


@each([path for path in MODULES if path.parent.name == "cli"])
def test_command_help_uses_the_fields_words(path):
    assert wrong_prose(help_texts(path)) == []


def test_words_are_found_in_names_and_prose():
    assert words_of("look_here") == ["look", "here"]
    assert words_of("SeenInBeta") == ["seen", "in", "beta"]
    assert words_of("ground_truth") == []
    assert wrong_prose("the truth is told") == [
        "1: 'told' (say, show, known, observable): the truth is told",
        "1: 'truth' (ground truth): the truth is told",
    ]
    assert wrong_prose("the ground truth, look at `truth`\n```\ntruth\n```\n") == []
