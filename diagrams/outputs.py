"""Output files that replace those of an earlier run all at once, or not at all."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path


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
    out.mkdir(parents=True, exist_ok=True)
    try:
        with tempfile.TemporaryDirectory(prefix=".unfinished-", dir=out) as directory:
            work = Path(directory)
            yield work
            _take_places(work, out, names)
    except BaseException:
        for path in made:  # the deepest first
            with contextlib.suppress(OSError):  # somebody else uses it by now
                path.rmdir()
        raise


def _take_places(work: Path, out: Path, names: Sequence[str]) -> None:
    new = {path.name for path in work.iterdir()}
    old = [out / name for name in names if name not in new and (out / name).exists()]
    if old:
        aside = _first_free(out)
        aside.mkdir()
        for path in old:
            path.rename(aside / path.name)
    for name in sorted(new):
        # On one file system, so that each is there as a whole or not at all.
        (work / name).replace(out / name)


def _first_free(out: Path) -> Path:
    number, path = 1, out / "earlier"
    while path.exists():
        number += 1
        path = out / f"earlier-{number}"
    return path


def placed(files: Sequence[Path], work: Path, out: Path) -> tuple[Path, ...]:
    """The paths of files in their places, from those where they were written."""
    return tuple(out / path.relative_to(work) for path in files)
