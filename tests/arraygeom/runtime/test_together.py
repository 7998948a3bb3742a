"""Files swapped in whole or not at all, and only over those that a list has as they are."""

import json
import os
import shutil
import sys

import pytest

from arraygeom.runtime.together import (
    LISTS,
    digest,
    read_about,
    recover,
    refuse_others,
    retire,
    sweep,
    write_listed,
    write_together,
)

EVENTS = {"os.rename", "os.remove", "os.mkdir", "os.rmdir", "open", "shutil.rmtree"}
"""What Python announces (`sys.addaudithook`) before files change; `open` before a file is made or read."""
OLD, NEW = {"a": "old", "b": "old", "last": "old"}, {"b": "new", "c": "new", "last": "new"}


def write(folder, texts, **further):
    with write_together(folder, group="g", last="last", **further) as temporary:
        for name, text in texts.items():
            (temporary / name).write_text(text)


def seen(folder) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.iterdir() if path.is_file()}


def interrupted(act, number: int, error: OSError | None) -> bool:
    """Fork a process that is stopped before its n-th file operation, or whose operation raises; True if it
    was."""
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 1
    count = 0

    def hook(event, _):
        nonlocal count
        count += event in EVENTS
        if event in EVENTS and count == number:
            if error is None:
                os._exit(1)
            raise error

    sys.addaudithook(hook)
    try:
        act()
    except OSError:
        os._exit(1)
    os._exit(1 if error is not None and count >= number else 0)


@pytest.mark.skipif(sys.platform != "linux", reason="forks")
@pytest.mark.parametrize("error", [None, OSError(28, "No space left on device")], ids=["killed", "no room"])
@pytest.mark.parametrize("former", [OLD, {}], ids=["over former files", "into an empty folder"])
def test_stopped_at_any_operation_former_or_new_files_are_whole(tmp_path, former, error):
    """Killed there, they are once the next command has begun; after an error at once."""
    stops, found = 0, []
    while True:
        folder = tmp_path / str(stops)
        folder.mkdir()
        (folder / "mine").write_text("mine")
        if former:
            write(folder, former)
        stops += 1
        if not interrupted(lambda folder=folder: write(folder, NEW), stops, error):
            break
        here = seen(folder)
        if "last" in here:  # before anything is put back
            assert {name: here[name] for name in here if here[name] != "mine"} in (former, NEW)
        if error is None:
            sweep(folder)
        found.append(seen(folder))
        assert found[-1] in ({"mine": "mine", **former}, {"mine": "mine", **NEW}), stops
        assert error or [p.name for p in folder.glob(".*")] in ([], [LISTS])
        write(folder, NEW)
        assert seen(folder) == {"mine": "mine", **NEW}
    assert stops > 25
    assert {"mine": "mine", **former} in found
    assert {"mine": "mine", **NEW} in found


def test_a_recovery_may_be_killed_too(tmp_path):
    for number in range(1, 100):
        folder = tmp_path / str(number)
        write(folder, OLD)
        stop = next(n for n in range(1, 200) if _half_moved(folder, n))
        assert stop
        killed = interrupted(lambda folder=folder: recover(folder), number, None)
        recover(folder)
        assert seen(folder) == OLD
        if not killed:
            return
    raise AssertionError("it never ended")


def _half_moved(folder, number: int) -> bool:
    """Kill a swap at an operation, and say whether some new file is there and the last one is not; if not,
    put all back."""
    interrupted(lambda: write(folder, NEW), number, None)
    if "c" in seen(folder) and "last" not in seen(folder):
        return True
    sweep(folder)
    write(folder, OLD)
    return False


def test_only_listed_files_are_replaced(tmp_path):
    (tmp_path / "b").write_text("mine")
    with pytest.raises(FileExistsError, match="b"):
        write(tmp_path, NEW)
    assert seen(tmp_path) == {"b": "mine"}
    assert not list(tmp_path.glob(".g*"))
    with pytest.raises(FileExistsError, match="b"):
        refuse_others(tmp_path, ["b", "c"])
    (tmp_path / "b").unlink()
    write(tmp_path, OLD)
    refuse_others(tmp_path, ["a", "b"])
    (tmp_path / "b").write_text("retouched by me")
    refuse_others(tmp_path, ["b"], by_name=True)
    with pytest.raises(FileExistsError, match="b"):
        write(tmp_path, NEW)
    write(tmp_path, NEW, given=["b"])
    assert seen(tmp_path) == NEW


def test_a_former_file_that_was_changed_stays(tmp_path):
    write(tmp_path, OLD)
    (tmp_path / "a").write_text("mine now")
    write(tmp_path, NEW)
    assert seen(tmp_path) == {"a": "mine now", **NEW}


def test_files_of_other_groups_are_replaced_and_the_same_content_is_no_obstacle(tmp_path):
    write_listed(tmp_path / "b", "other")
    (tmp_path / "c").write_text("new")
    write(tmp_path, NEW)
    assert seen(tmp_path) == NEW


@pytest.mark.parametrize(("given", "error"), [((), FileExistsError), (("c",), IsADirectoryError)])
def test_a_folder_in_the_way(tmp_path, given, error):
    """It stays with what is in it, though its name was given."""
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "kept").touch()
    with pytest.raises(error, match="c"):
        write(tmp_path, NEW, given=given)
    assert (tmp_path / "c" / "kept").exists()


def test_a_group_is_made_if_all_its_files_are_as_they_were(tmp_path):
    assert read_about(tmp_path, "g") is None
    write(tmp_path, NEW, about={"inputs": "1"})
    copy = shutil.copytree(tmp_path, tmp_path.with_name("copy"), copy_function=shutil.copyfile)
    assert read_about(copy, "g") == {"inputs": "1"}
    for damage in (lambda p: p.write_text("ne"), lambda p: p.write_text(""), lambda p: p.unlink()):
        write(tmp_path, NEW, about={"inputs": "1"}, given=NEW)
        damage(tmp_path / "c")
        assert read_about(tmp_path, "g") is None
    retire(copy, "g")
    assert read_about(copy, "g") is None
    write(copy, OLD)
    assert seen(copy) == OLD


@pytest.mark.parametrize("text", ["", "[]", "{", '{"files": 3, "about": {}}', "[" * 100000])
def test_a_damaged_list_is_none(tmp_path, text):
    write(tmp_path, OLD)
    (tmp_path / LISTS / "g.json").write_text(text)
    assert read_about(tmp_path, "g") is None
    with pytest.raises(FileExistsError):
        write(tmp_path, NEW)


def test_a_list_from_a_stranger_moves_nothing_of_other_folders(tmp_path):
    (tmp_path / "mine").write_text("mine")
    out, names = tmp_path / "out", ["../mine", str(tmp_path / "mine"), "..", ""]
    files = dict.fromkeys(names, digest(tmp_path / "mine"))
    write(out, OLD)
    document = json.dumps({"about": {}, "files": files | {"a": digest(out / "a")}})
    (out / LISTS / "g.json").write_text(document)
    temporary = out / f".g-{'0' * 32}"
    temporary.mkdir()
    (temporary / ".list.json").write_text(document)
    recover(out)
    (out / "b").unlink()
    (out / "last").unlink()
    write(out, NEW)
    assert (tmp_path / "mine").read_text() == "mine"


def test_a_value_error_keeps_its_kind_and_names_the_folder_that_the_user_gave(tmp_path):
    class OwnError(ValueError):
        pass

    with pytest.raises(OwnError) as refused, write_together(tmp_path, group="some", last="a.txt") as folder:
        raise OwnError(f"{folder / 'a.txt'} is empty", 3)
    assert refused.value.args == (f"{tmp_path / 'a.txt'} is empty", 3)
