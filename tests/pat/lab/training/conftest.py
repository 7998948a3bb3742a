"""Banks of photographs loaded again and again are loaded once: patterns take longer than a short run."""

from hashlib import sha256
from pathlib import Path

import pytest

from pat.lab.synthesis.photos import PhotoBank
from pat.support.folders import files_below

LOADED: dict[tuple, PhotoBank] = {}
"""By the contents of the files, the seed, and which of the images are chosen."""


@pytest.fixture(scope="session", autouse=True)
def banks_loaded_once():
    load = PhotoBank.load

    def once(*folders, cache=None, seed=0, choose=lambda i: True, **how):
        files = [Path(cache)] if cache else [file for folder in folders for file in files_below(folder)]
        if how or not files or not all(file.exists() for file in files):
            return load(*folders, cache=cache, seed=seed, choose=choose, **how)
        contents = sha256(b"".join(file.read_bytes() for file in files)).digest()
        key = contents, seed, tuple(choose(i) for i in range(len(files) + 100))
        if key not in LOADED:
            LOADED[key] = load(*folders, cache=cache, seed=seed, choose=choose)
        return LOADED[key]

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(PhotoBank, "load", once)
        yield
