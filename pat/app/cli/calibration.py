"""`pat calibrate` and `pat board`: a rig from photographs of a board."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from calib.boards import Lens

from . import options
from .options import Depth, Out, say
from .parser import Option

if TYPE_CHECKING:
    from calib.boards.poses import StartDeviations

BOARDS = (
    "charuco:8x6:30mm (squares; then, if wanted, markers and dictionary, :22mm:4x4_50), chessboard:9x6:25mm "
    "(inner corners), circles:7x5:20mm, acircles:4x11:20mm, aprilgrid:6x6:88mm:0.3 (tags, space between "
    "them), or Kalibr's target file."
)
BoardName = Annotated[str, Option("BOARD", BOARDS, positional=True)]


@dataclass
class Calibrate:
    """Calibrate a rig from photographs of a board, with a report of how good it is.

    A folder for each camera, or file names like left01.jpg, right01.jpg; images of one moment have the same
    number.

    Example: pat calibrate photos/ --board charuco:8x6:30mm -o rig.yaml
    """

    photos: Annotated[Path, Option("FOLDER", positional=True)]
    """Folder with the images (or videos) of all cameras."""
    board: Annotated[tuple[str, ...], Option("BOARD", f"Once for each board: {BOARDS}", repeat=True)] = ()
    out: Out = Path("rig.yaml")
    """The rig file; its report (.html) and covariance (.covariance.json) are written beside it."""
    camera: Annotated[tuple[str, ...], Option("NAME=PATTERN", repeat=True)] = ()
    """Once a camera, such as left='left*.jpg', where names of folders and files do not show the camera."""
    lens: Literal["auto", Lens] = "brown-conrady"
    """Lens model; from kannala-brandt on, they are for fisheyes. auto compares the first five, on held-out
    frames, and takes the best supported."""
    depth: Depth = None
    """Near and far bounds in metres of the scenes to come, written into the rig."""
    start: Annotated[Path | None, Option("RIG")] = None
    """A rig known roughly, such as measured positions, nominal focal lengths: one image a camera will do."""
    deviation: Annotated[tuple[str, ...], Option("NAME=VALUE", repeat=True)] = ()
    """How well the start is known: position=0.0005 (m), rotation=3 (degrees), focal=0.02 (share of the focal
    length), centre=0.01 (share of the width); these are the defaults."""
    watch: bool = False
    """While images are taken: a page (.watch.html) with what was detected and which view would help most."""

    def run(self) -> None:
        """Detect the board, calibrate, and write the rig.

        Raises:
            ValueError: without a board, for invalid options, and for images that cannot be used.
            OSError: for a missing folder, start or board file, files that cannot be written, and files in
                the way of the report that no run wrote; cv2.error as `calibrate_photos`.
        """
        from calib.boards.run import calibrate_photos

        if not self.board:
            raise ValueError("which board is in the images? Give it, such as --board charuco:8x6:30mm")
        options.writable(self.out)
        given = options.files_by_name(self.camera, "--camera")
        patterns = {name: str(pattern) for name, pattern in given.items()}
        if self.watch:
            self._watch(patterns)
        session = calibrate_photos(
            self.photos,
            self.board,
            self.out,
            patterns=patterns,
            lens=self.lens,
            depth=self.depth,
            start=self.start,
            deviations=self._deviations(),
            progress=options.progress("detecting the board"),
        )
        print("\n".join(session.messages))
        say(f"written: {', '.join(map(str, session.written))}")

    def _deviations(self) -> StartDeviations:
        from calib.boards.poses import StartDeviations

        if self.deviation and self.start is None:
            raise ValueError("--deviation needs --start: give the rig whose positions it is about")
        return StartDeviations.from_numbers(options.numbers_by_name(self.deviation, "--deviation"))

    def _watch(self, patterns: dict[str, str]) -> None:
        from calib.boards.run import watch
        from calib.boards.target import parse_boards

        page = self.out.with_suffix(".watch.html")
        say(f"open {page} in a browser; Ctrl-C calibrates with all images and ends")
        lens = "brown-conrady" if self.lens == "auto" else self.lens
        try:
            watch(self.photos, parse_boards(self.board), page, patterns=patterns, lens=lens)
        except KeyboardInterrupt:
            say("")


@dataclass
class PrintBoard:
    """Make a calibration board to print at its true size.

    Example: pat board charuco:8x6:30mm -o board.pdf
    """

    board: BoardName
    out: Out = Path("board.pdf")
    """File to write, ending in .pdf or .svg."""
    paper: Literal["A4", "letter", "A3", "A2", "A1", "A0"] | None = None
    """Sheet to centre the board on; without it the page is as large as the board with its margin."""

    def run(self) -> None:
        """Write the board, and say what to print it on.

        Raises:
            ValueError: for a text that is no board, a sheet that it does not fit on, and an `out` of another
                suffix or where nothing can be written.
            OSError: for a missing target file, and if writing fails.
        """
        from calib.boards.target import page_note, parse_board, write_board

        say(f"written: {write_board(self.board, options.writable(self.out), paper=self.paper)}")
        say(page_note(parse_board(self.board)))
