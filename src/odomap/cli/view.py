"""`odomap view`: a run that is over, in the browser."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

__all__ = ["ViewVerb"]


@dataclass(frozen=True)
class ViewVerb:
    """Show a run that is over in the browser: path, map, and the sensor at any frame.

    `odomap run DATA --view` shows one while it goes on. Needs viser: pip install 'odomap[view]'.
    """

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN|MAP")]
    """The output folder of `odomap run`, or a map file (map.odomap)."""
    host: str = "127.0.0.1"
    """Address of the page; 0.0.0.0 lets other machines look."""
    port: int = 8080
    """Port of the page; if it is taken, the next free one."""

    def execute(self) -> int:
        """Serve the page until Ctrl-C."""
        from odomap.reviewing import review

        review(self.run, self.host, self.port)
        return 0
