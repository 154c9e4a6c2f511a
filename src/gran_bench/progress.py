"""How far long work is: a bar on a terminal, and elsewhere, in a log say, a line every half minute."""

import io
import sys
import time
from typing import Any

from tqdm import tqdm

SECONDS_BETWEEN_LINES = 30.0  # where stderr is no terminal
LINE = "{desc}: {n_fmt} of {total_fmt} {unit}s, {elapsed} so far, {remaining} left{postfix}"


class Progress(tqdm):
    """A `tqdm` bar; without a terminal plain lines on stderr, none in the first half minute.

    Args:
        show: False says nothing at all.
        settings: keys of `tqdm`.
    """

    def __init__(self, *iterable: Any, show: bool = True, **settings: Any) -> None:
        self.plain, self.said = not sys.stderr.isatty(), time.monotonic()
        if self.plain:
            # tqdm moves its cursor in a file that nobody reads.
            form = settings.get("bar_format", LINE).replace("|{bar}|", ",")
            settings |= {"file": io.StringIO(), "bar_format": form, "mininterval": 1.0}
        super().__init__(*iterable, disable=not show, **settings)

    def display(self, msg: str | None = None, pos: int | None = None) -> None:
        """Show how far it is: now on a terminal, elsewhere when the last line is half a minute old."""
        if not self.plain:
            super().display(msg, pos)
        elif msg is None and time.monotonic() - self.said >= SECONDS_BETWEEN_LINES:
            self.said = time.monotonic()
            print(str(self).strip(), file=sys.stderr, flush=True)
