"""Archives of arrays (``.npz``), as files that anybody may have damaged."""

from __future__ import annotations

import lzma
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from dtmpc_drake.numerics.arrays import Array

DAMAGE: tuple[type[Exception], ...] = (
    ValueError,  # a pickle, too
    OSError,
    EOFError,
    KeyError,
    MemoryError,
    NotImplementedError,
    RuntimeError,
    OverflowError,  # this and the next three: a header of an array that is none
    SyntaxError,
    TypeError,
    tokenize.TokenError,
    struct.error,
    lzma.LZMAError,
    zipfile.BadZipFile,
    zlib.error,
)
"""What reading a damaged archive raises."""


def require_archive(path: str | Path, what: str) -> None:
    """Refuses a file that is no archive at all.

    Args:
        path: of the file.
        what: it should hold, for the message.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no archive.
    """
    with open(path, "rb") as file:
        if not zipfile.is_zipfile(file):
            raise ValueError(f"{path}: not a saved {what} (not an .npz file)")


def read_array(data: Mapping[str, Array], name: str) -> Array:
    """One array of an archive.

    Raises:
        ValueError: if it is none.
    """
    array = data[name]
    if not isinstance(array, np.ndarray):  # NumPy hands on the bytes of anything else
        raise ValueError(f"{name} is no array")
    return array
