"""Groups of files that are replaced together or not at all, and listed, so that only they are replaced later.

A folder of results has a folder `.arraygeom`, in which a JSON file for each group of files lists their names
and digests. The list is moved there last: with it a group is complete.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from uuid import uuid4

from .atomic import flush, naming, speaks_for_itself, write_text

LISTS = ".arraygeom"
"""Folder of the lists, and of what an unfinished run keeps."""
_LIST, _FORMER = ".list.json", ".former"
"""Names in a temporary folder: the list of the files in it, and the folder of files that they replace."""
ANY = "any"
"""Placeholder for any digest."""
_SHOWN = 4
"""Number of names in a message."""


@contextmanager
def write_together(
    folder: str | Path,
    *,
    group: str,
    last: str,
    about: Mapping[str, str] | None = None,
    given: Collection[str] = (),
) -> Iterator[Path]:
    """Context manager that yields a temporary folder inside `folder` for files that belong together.

    If the block succeeds they replace the group's former files, even of other names unless changed since: the
    former last file goes first and the new one comes last, so where it is, the others are of the same run.
    After an error (such as a full disk) all former files are as they were; after a kill they are so again
    once `recover` has run, which the next call does. Missing folders are made.

    Args:
        folder: folder that the files are moved to; the block makes files only, no folders.
        group: name of the group, whose files, with their digests, are listed in a hidden folder.
        last: name of the file that completes the group; it is not checked that the block writes it.
        about: texts by name to store in the list (`read_about`); None for none.
        given: file names that the user chose, which may replace unlisted files.

    Yields:
        The temporary folder.

    Raises:
        FileExistsError: for a file in the way, of other content than the new one, that no list has in its
            present state and that is not `given`.
        IsADirectoryError: for a folder of a `given` name.
        OSError: naming the file, if writing fails.
        ValueError: of the block, of its own kind, with `folder` in place of the temporary one. Its other
            errors pass.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    recover(folder, group)
    temporary = folder / f".{group}-{uuid4().hex}"
    temporary.mkdir()
    try:
        yield temporary
        _swap(folder, temporary, group, last, dict(about or {}), given)
    except OSError as error:
        if (error.filename and Path(error.filename).parent != temporary) or speaks_for_itself(error):
            raise
        written = folder / Path(error.filename).name if error.filename else folder
        raise naming(written, error, temporary) from error
    except ValueError as error:
        if str(temporary) not in str(error):
            raise
        hidden, shown = str(temporary), str(folder)
        error.args = tuple(x.replace(hidden, shown) if isinstance(x, str) else x for x in error.args)
        raise
    finally:
        with suppress(OSError):  # what cannot be put back now is put back by the next call
            _undo(folder, temporary)
            shutil.rmtree(temporary, ignore_errors=True)


def write_listed(path: Path, text: str) -> None:
    """Write one text file as a group of its own name, as `write_together` does.

    Args:
        path: file to write; missing folders are made.
        text: content, written as UTF-8.

    Raises:
        FileExistsError, OSError: as `write_together`.
    """
    with write_together(path.parent, group=path.name, last=path.name) as folder:
        write_text(folder / path.name, text)


def _swap(
    folder: Path, temporary: Path, group: str, last: str, about: dict[str, str], given: Collection[str]
) -> None:
    """Move former files out and new ones in; the last move, that of the list, makes it count."""
    names = sorted((file.name for file in temporary.iterdir()), key=lambda name: name == last)
    files = {name: digest(temporary / name) for name in names}
    if folders := [name for name in given if (folder / name).is_dir()]:
        raise IsADirectoryError(f"{folder / folders[0]} is a folder: name a file in it")
    refuse_others(folder, {name: files[name] for name in names if name not in given}, group=group)
    former = _listed(_lists(folder, group))
    gone = [name for name, known in former.items() if name not in files and digest(folder / name) in known]
    (temporary / _FORMER).mkdir()
    (folder / LISTS).mkdir(exist_ok=True)
    for name in names:
        flush(temporary / name)
    write_text(temporary / _LIST, json.dumps({"about": about, "files": files}, indent=1))
    flush(temporary)
    for name in (*names[::-1], *gone):
        if os.path.lexists(folder / name):
            os.replace(folder / name, temporary / _FORMER / name)
    for name in names:
        os.replace(temporary / name, folder / name)
    flush(folder)
    os.replace(temporary / _LIST, list_file(folder, group))
    with suppress(OSError):
        list_file(folder, group, retired=True).unlink()


def _undo(folder: Path, temporary: Path) -> None:
    """Restore a folder after an incomplete swap; may be interrupted and repeated."""
    if not (temporary / _LIST).is_file():
        return
    files = list(_read_list(temporary / _LIST)["files"])
    for name in files[::-1]:
        if not os.path.lexists(temporary / name):
            os.replace(folder / name, temporary / name)
    if (temporary / _FORMER).is_dir():
        for file in sorted((temporary / _FORMER).iterdir(), key=lambda file: file.name == files[-1]):
            os.replace(file, folder / file.name)
    (temporary / _LIST).unlink()


def recover(folder: Path, group: str | None = None) -> None:
    """Restore the files that a killed `write_together` had moved away; one that still runs is taken for it.

    Args:
        folder: folder of the files; nothing is done for one that is missing.
        group: name of the group; None for all groups of the folder.

    Raises:
        OSError: if files cannot be moved back.
    """
    for path in _temporary(folder, group):
        if (path / _LIST).is_file():
            _undo(folder, path)
            shutil.rmtree(path, ignore_errors=True)


def sweep(folder: Path, stem: str | None = None) -> None:
    """Run `recover`, and remove the temporary files and folders of atomic writing, a running writer's too.

    Args:
        folder: folder to clean, without its subfolders.
        stem: file stem or group to restrict this to; None for all.

    Raises:
        OSError: if files cannot be moved or removed; folders that cannot be removed stay.
    """
    recover(folder, stem)
    for path in _temporary(folder, stem):
        shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)


def _temporary(folder: Path, stem: str | None) -> list[Path]:
    ours = rf"\.{'.*' if stem is None else re.escape(stem)}-[0-9a-f]{{32}}(\.\w+)?"
    ours = ours if stem else rf"{ours}|\.tmp\w{{6}}"
    return [path for path in folder.glob(".*") if re.fullmatch(ours, path.name)]


def retire(folder: Path, group: str) -> None:
    """Mark a group as no longer made; its files stay until a new run replaces them, changed or not."""
    with suppress(FileNotFoundError):
        os.replace(list_file(folder, group), list_file(folder, group, retired=True))


def read_about(folder: Path, group: str) -> dict[str, str] | None:
    """Return the texts of a group's list if all its files are there as written; None otherwise."""
    document = _read_list(list_file(folder, group))
    if any(digest(folder / name) != known for name, known in document["files"].items()):
        return None
    return document["about"] if document["files"] else None


def refuse_others(
    folder: Path, names: Iterable[str] | Mapping[str, str], *, group: str = "", by_name: bool = False
) -> None:
    """Check that no unlisted or changed files of these names are in a folder (a missing one has none).

    Args:
        names: file names, or a mapping to digests: files of the same content are no obstacle.
        group: name of the group whose list is read first; the lists of other groups count too.
        by_name: True to accept any file whose name is listed, without reading it, as one of a retired group
            always is.

    Raises:
        FileExistsError: naming some of the files, if there are any.
        OSError: for a file that cannot be read.
    """
    new = names if isinstance(names, Mapping) else dict.fromkeys(names, "")
    there = {name: {""} for name in new if os.path.lexists(folder / name)}
    if not by_name:
        there = {name: {digest(folder / name)} - {new[name]} for name in there}
    for pattern in (group, None) if group else (None,):
        listed = _listed(_lists(folder, pattern)) if there else {}
        there = {
            name: found
            for name, found in there.items()
            if found and not (name in listed if by_name else (found | {ANY}) & listed.get(name, set()))
        }
    if there:
        shown = ", ".join(sorted(there)[:_SHOWN]) + f" and {len(there) - _SHOWN} more" * (len(there) > _SHOWN)
        raise FileExistsError(
            f"{folder}: has {shown}, which no run wrote, or which changed since: "
            "give another folder or name, or move them away"
        )


def digest(path: Path) -> str:
    """Return the SHA-256 of a file's content in hexadecimal; "none" if it is no file."""
    if not path.is_file():
        return "none"
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def list_file(folder: Path, group: str, *, retired: bool = False) -> Path:
    """Return the path of a group's list, or of its list once `retired`."""
    return folder / LISTS / f"{group}.{'former' if retired else 'json'}"


def _lists(folder: Path, group: str | None) -> list[Path]:
    """Paths of the lists of a group, or of all."""
    if group is not None:
        return [list_file(folder, group), list_file(folder, group, retired=True)]
    return [*(folder / LISTS).glob("*.json"), *(folder / LISTS).glob("*.former")]


def _listed(lists: Iterable[Path]) -> dict[str, set[str]]:
    """Digests in lists by file name, with `ANY` for names in retired lists."""
    listed: dict[str, set[str]] = {}
    for path in lists:
        for name, known in _read_list(path)["files"].items():
            listed.setdefault(name, set()).update({known} if path.suffix == ".json" else {known, ANY})
    return listed


def _read_list(path: Path) -> dict[str, dict[str, str]]:
    """Texts and files of a list, files in other folders left out; both empty if there is no complete list."""
    try:
        document = json.loads(path.read_bytes())
        about, files = ({str(k): str(v) for k, v in document[part].items()} for part in ("about", "files"))
    except (FileNotFoundError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
        about, files = {}, {}
    own = {name: known for name, known in files.items() if name not in ("", "..") and Path(name).name == name}
    return {"about": about, "files": own}
