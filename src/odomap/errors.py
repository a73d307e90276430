"""The exceptions odomap raises, and what the command line makes of them.

    OdomapError                 every error a user can mend: one line, no traceback
    ├── InputError              exit 2: a file, a value or an option is wrong
    │   ├── CalibrationError    the rig cannot be what it says (a field missing, millimetres)
    │   └── ConfigError         an unknown preset, section or field
    ├── MissingExtra            exit 2: an optional library is not installed
    ├── OutputError             exit 1: a result cannot be written (no permission, disk full)
    └── TrackingFailed          exit 1: the run ended without a usable path

A message names the file, the line or field, and the mend, in that order:
``MH_01/mav0/cam0/sensor.yaml: field 'intrinsics' is missing (found 'intrinsic': rename it)``.
"""

import difflib
from collections.abc import Iterable

__all__ = [
    "CalibrationError",
    "ConfigError",
    "InputError",
    "MissingExtra",
    "OdomapError",
    "OutputError",
    "TrackingFailed",
    "nearest_name",
]


class OdomapError(Exception):
    """Root of all errors a user can mend; `exit_code` is what the command line returns."""

    exit_code = 1


class InputError(OdomapError):
    """A file, a value or an option is wrong."""

    exit_code = 2


class CalibrationError(InputError):
    """The calibration is incomplete or cannot be true."""


class ConfigError(InputError):
    """An unknown preset, section or field, or a value outside its range."""


class MissingExtra(InputError):
    """An optional library is not installed."""


class OutputError(OdomapError):
    """A result cannot be written."""


class TrackingFailed(OdomapError):
    """The run ended without a usable path."""


def nearest_name(name: str, known: Iterable[str]) -> str:
    """Return the known name nearest to a mistyped one, as `` (did you mean 'x'?)``, or nothing."""
    close = difflib.get_close_matches(name, list(known), n=1, cutoff=0.6)
    return f" (did you mean '{close[0]}'?)" if close else ""
