"""Loggers of other libraries."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator


@contextlib.contextmanager
def quiet(name: str) -> Iterator[None]:
    """Keeps a logger's news off the terminal; warnings still get there."""
    logger = logging.getLogger(name)
    level = logger.level
    logger.setLevel(logging.WARNING)
    try:
        yield
    finally:
        logger.setLevel(level)


@contextlib.contextmanager
def muted(name: str, beginning: str) -> Iterator[None]:
    """Drops what a logger says that begins so; threads may do this side by side."""
    logger = logging.getLogger(name)

    def passes(record: logging.LogRecord) -> bool:  # a new one for every caller
        return not record.getMessage().startswith(beginning)

    logger.addFilter(passes)
    try:
        yield
    finally:
        logger.removeFilter(passes)
