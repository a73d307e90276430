"""`odomap demo`: a simulated world, tracked and reported, with no download."""

import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

__all__ = ["Demo"]

Overrides = Annotated[tuple[tuple[str, str], ...], tyro.conf.Suppress]


@dataclass(frozen=True)
class Demo:
    """Track a stereo camera through a simulated world and open the report.

    The report opens in a browser where there is a desktop.
    """

    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("runs/demo")
    """Folder for the outputs."""
    world: Literal["room", "street"] = "room"
    """Which world."""
    seed: int = 3
    """Which of them: every seed is another world and another path."""
    frames: int = 120
    """How many frames to render."""
    open: Annotated[bool, tyro.conf.arg(help_behavior_hint="")] = True
    """Only write the report, do not open it in a browser."""
    quiet: bool = False
    """No progress."""
    overrides: Overrides = ()

    def execute(self) -> int:
        """Make the world, track it, open the report."""
        from odomap.cli.run import track
        from odomap.run import chosen_config
        from odomap.sources.open import open as open_source

        config = chosen_config(None, None, self.overrides)
        data = f"sim:{self.world}?seed={self.seed}&frames={self.frames}"
        origin: dict[str, object] = {"data": data}
        code, result = track(open_source(data), self.out, config, origin, None, self.quiet)
        if self.open and code == 0 and has_desktop(os.environ) and "report.html" in result.written:
            import webbrowser

            webbrowser.open((self.out / "report.html").resolve().as_uri())
        return code


def has_desktop(environ: Mapping[str, str]) -> bool:
    """Whether somebody sits in front of a screen that a browser can open on."""
    if environ.get("CI") or environ.get("SSH_CONNECTION") or environ.get("SSH_TTY"):
        return False
    if sys.platform in ("win32", "darwin"):
        return True
    return bool(environ.get("DISPLAY") or environ.get("WAYLAND_DISPLAY"))
