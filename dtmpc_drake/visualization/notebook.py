"""A replay inside a notebook."""

from __future__ import annotations

import dataclasses
import html
from pathlib import Path


@dataclasses.dataclass(frozen=True, repr=False)
class InlineReplay:
    """A replay that a notebook shows below the cell which returns it.

    The page is part of the notebook's output: no server and no network is
    needed, and the file may be moved afterwards.  IPython is not needed either.

    Attributes:
        page: the HTML of the replay.
        height: of the frame, in pixels.
    """

    page: str
    height: int

    def _repr_html_(self) -> str:
        # Its own document, so that its styles and scripts stay apart.
        return (
            f'<iframe srcdoc="{html.escape(self.page)}" width="100%"'
            f' height="{self.height}" style="border: 0" title="replay"></iframe>'
        )

    def __repr__(self) -> str:
        """For front ends that show text only."""
        return f"InlineReplay({len(self.page) / 1e6:.1f} MB of HTML)"


def show_replay(path: str | Path, *, height: int = 560) -> InlineReplay:
    """Shows a file of `write_replay` in a notebook, as a cell's last expression.

    Args:
        path: of the HTML file.
        height: of the frame, in pixels.

    Raises:
        OSError: if the file cannot be read.
    """
    return InlineReplay(Path(path).read_text(encoding="utf-8"), height)
