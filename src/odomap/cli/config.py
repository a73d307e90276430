"""`odomap config`: what can be set, and what a preset sets."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

__all__ = ["ConfigVerb"]

Overrides = Annotated[tuple[tuple[str, str], ...], tyro.conf.Suppress]


@dataclass(frozen=True)
class ConfigVerb:
    """Print a preset as YAML, each field with what it means and its unit.

    The output is a file that `odomap run --config` reads.
    """

    preset: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="[PRESET]")] = ""
    """Name of a preset; default the one that `odomap run` uses."""
    config: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """A file to read over the preset: prints what a run with it would use."""
    list: bool = False
    """List the presets instead."""
    overrides: Overrides = ()

    def execute(self) -> int:
        """Print the config."""
        from odomap.run import chosen_config
        from odomap.settings import config_to_yaml
        from odomap.system.config import PRESETS

        if self.list:
            print("\n".join(PRESETS))
            return 0
        config = chosen_config(self.preset or None, self.config, self.overrides)
        sys.stdout.write(config_to_yaml(config))
        return 0
