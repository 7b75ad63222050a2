"""Output files: numbers as JSON, and files that take their places all or none."""

from __future__ import annotations

import contextlib
import json
import math
import os
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np


@contextlib.contextmanager
def replacing(out: Path, names: Sequence[str]) -> Iterator[Path]:
    """A directory to write outputs into; they take their places if all goes well.

    What an earlier run left in `out` under one of the names, and this run does not
    write, is set aside into ``earlier`` (or ``earlier-2``, ...), so that a directory
    never mixes two runs and nothing is lost.  If anything goes wrong, everything is
    as it was before.

    Args:
        out: where the files belong; it is made, with its parents, if need be.
        names: that outputs may have; files of other names are left alone.

    Yields:
        A directory beside them.

    Raises:
        OSError: at the start, if `out` cannot be written.
    """
    made = [path for path in (out, *out.parents) if not path.exists()]
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".unfinished-", dir=out) as directory:
            work, replaced = Path(directory, "new"), Path(directory, "replaced")
            work.mkdir()
            replaced.mkdir()
            yield work
            _take_places(work, out, names, replaced)
    except BaseException:
        for path in made:  # the deepest first
            with contextlib.suppress(OSError):  # somebody else uses it by now
                path.rmdir()
        raise


def _take_places(work: Path, out: Path, names: Sequence[str], replaced: Path) -> None:
    """Moves everything, or, if anything is in the way, nothing.

    Args:
        work: where the new files are.
        out: where they belong.
        names: that outputs may have.
        replaced: an empty directory, for the files whose places are taken.
    """
    new = sorted(path.name for path in work.iterdir())
    there = [name for name in dict.fromkeys((*names, *new)) if _exists(out / name)]
    # A directory is no output of ours, so it is not replaced.
    old = [n for n in there if n not in new or (out / n).is_dir()]
    aside = _first_free(out)
    moves = [(out / name, aside / name) for name in old]
    moves += [(out / name, replaced / name) for name in there if name not in old]
    moves += [(work / name, out / name) for name in new]
    try:
        if old:
            aside.mkdir()
        for source, target in moves:  # on one file system: as a whole or not at all
            os.replace(source, target)
    except BaseException:
        for source, target in reversed(moves):
            if _exists(target) and not _exists(source):
                os.replace(target, source)
        if old:
            with contextlib.suppress(OSError):  # it was not even made
                aside.rmdir()
        raise


def _exists(path: Path) -> bool:
    """Whether there is anything, a link to nothing included."""
    return os.path.lexists(path)


def _first_free(out: Path) -> Path:
    number, path = 1, out / "earlier"
    while _exists(path):
        number += 1
        path = out / f"earlier-{number}"
    return path


def placed(files: Sequence[Path], work: Path, out: Path) -> tuple[Path, ...]:
    """The paths of files in their places, from those where they were written."""
    return tuple(out / path.relative_to(work) for path in files)


def write_json(path: Path, value: Any) -> None:
    """Writes plain numbers and texts; what is not finite becomes null.

    Raises:
        OSError: if the file cannot be written.
    """
    text = json.dumps(plain(value), indent=2, ensure_ascii=False, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")


def plain(value: Any) -> Any:
    """The same for JSON, which has no infinity and knows no NumPy."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [plain(item) for item in value]
    if isinstance(value, (bool, str)) or value is None:
        return value
    if isinstance(value, int):
        return value
    number = float(value)
    return number if math.isfinite(number) else None
