"""A benchmark in parts: what was measured, and which of its bars were missed."""

import argparse
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Self

from meter import machine


class Bench:
    """What was measured, and which bars were missed.

    Args:
        options: what was asked for; `part` names parts, `json` a file or None.
    """

    def __init__(self, options: argparse.Namespace) -> None:
        self.options = options
        self.numbers: dict[str, object] = {}
        self.missed: list[str] = []

    def need(self, is_kept: bool, sentence: str) -> None:
        """Note a bar that is missed."""
        if not is_kept:
            self.missed.append(sentence)

    def save(self) -> None:
        """Write what there is, so that a run that is stopped leaves it."""
        if self.options.json:
            content = {"numbers": self.numbers, "missed": self.missed}
            Path(self.options.json).write_text(json.dumps(content, indent=1), encoding="utf-8")

    def measure(self, parts: Mapping[str, Callable[[Self], None]]) -> int:
        """Measure the parts that were asked for; return the exit code, 1 if a bar is missed."""
        print(machine())
        for part in self.options.part:
            print(f"\n{part}", flush=True)
            parts[part](self)
            self.save()
        for line in self.missed:
            print(f"bar missed: {line}")
        return 1 if self.missed else 0
