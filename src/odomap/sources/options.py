"""Options behind a name: "run.bag?scan=/front/scan&odometry=off".

What a recording leaves open is chosen there, as in the names of simulated worlds and cameras. A
file whose own name holds a '?' is still found by it.
"""

from collections.abc import Iterable
from pathlib import Path
from urllib.parse import parse_qsl

from odomap.errors import InputError, nearest_name

__all__ = ["check_options", "split_options"]


def split_options(name: str | Path) -> tuple[Path, dict[str, str]]:
    """Split a name into its path and the options behind it.

    Raises:
        InputError: what stands behind the '?' is not of the form `option=value&...`.
    """
    path, text = Path(name), str(name)
    file, mark, query = text.rpartition("?")
    if not mark or path.exists() or not Path(file).exists():
        return path, {}
    try:
        options = parse_qsl(query, keep_blank_values=True, strict_parsing=True)
    except ValueError:
        raise InputError(f"{text}: '{query}' is not of the form option=value&...") from None
    return Path(file), dict(options)


def check_options(where: Path, options: Iterable[str], known: Iterable[str]) -> None:
    """Raise an InputError for an option that a recording does not have."""
    known = tuple(known)
    for name in options:
        if name not in known:
            has = f"; there are: {', '.join(known)}" if known else ": it has none"
            raise InputError(
                f"{where}: there is no option '{name}'{nearest_name(name, known)}{has}"
            )
