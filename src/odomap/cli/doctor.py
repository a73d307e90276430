"""`odomap doctor`: is this installation sound?"""

import sys
from dataclasses import dataclass
from typing import Annotated

import tyro

__all__ = ["Doctor"]

MARKS = {"ok": "ok", "note": "--", "broken": "!!"}


@dataclass(frozen=True)
class Doctor:
    """Say what is installed, what is missing and how to mend it; compile all kernels."""

    kernels: Annotated[bool, tyro.conf.arg(help_behavior_hint="")] = True
    """Do not compile the kernels."""
    clear: bool = False
    """Delete the compiled kernels first."""

    def execute(self) -> int:
        """Print the findings; 1 when something is broken."""
        from odomap.cli.progress import Steps
        from odomap.doctor import Finding, compile_kernels, examine

        findings: list[Finding] = []
        for finding in examine():
            findings.append(finding)
            _show(finding)
        broken = [finding for finding in findings if finding.state == "broken"]
        if self.clear:
            from odomap.kernels import clear_cache

            _show(Finding("kernel cache", "ok", f"{clear_cache()} files deleted"))
        if self.kernels and not broken:
            with Steps("compiling") as steps:
                finding = compile_kernels(steps.show)
            findings.append(finding)
            _show(finding)
        broken = [finding for finding in findings if finding.state == "broken"]
        if broken:
            count = f"{len(broken)} thing{'s' if len(broken) > 1 else ''} broken"
            names = ", ".join(finding.name for finding in broken)
            print(f"odomap: {count}: {names}", file=sys.stderr)
        return 1 if broken else 0


def _show(finding: object) -> None:
    from odomap.doctor import Finding

    assert isinstance(finding, Finding)
    print(f"[{MARKS[finding.state]}] {finding.name:<24} {finding.text}")
    if finding.mend:
        print(f"     {'':<24} → {finding.mend}")
    sys.stdout.flush()
