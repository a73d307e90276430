"""The command line: ``odomap VERB ...``, one module per verb, made from dataclasses.

A verb is a frozen dataclass whose fields are its arguments (tyro reads their docstrings as help)
and whose `execute` does the work. Modules here import nothing heavy at the top: numba, OpenCV and
the rooms are loaded after parsing, so that ``--help`` and a typing error answer at once.

Exit codes: 0 done, 1 ran but failed, 2 bad input, 130 interrupted. An error is one line on stderr,
``odomap: file: field: what is wrong, and the mend``; with ODOMAP_DEBUG=1 the traceback follows.
Results go to stdout, progress and warnings to stderr.
"""

import os
import sys
import traceback
from collections.abc import Sequence

from odomap.cli.parse import parse
from odomap.errors import OdomapError

__all__ = ["main"]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    Args:
        argv: arguments without the program's name; default those of the process.
    """
    # OpenCV would print its own warnings about unreadable images, which are reported here.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    try:
        verb = parse(sys.argv[1:] if argv is None else list(argv))
        code = verb if isinstance(verb, int) else verb.execute()
        sys.stdout.flush()
    except KeyboardInterrupt:
        return _fail("interrupted", 130)
    except BrokenPipeError:
        # Whoever read our output has seen enough; keep the interpreter from complaining at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OdomapError as error:
        return _fail(" ".join(str(error).split()), error.exit_code)
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        return _fail(f"{place}{error.strerror or error}", 1)
    except MemoryError:
        return _fail("out of memory", 1)
    except Exception as error:  # the last resort: a bug is said in one line, too
        text = " ".join(f"{type(error).__name__}: {error}".split())
        return _fail(f"internal error: {text} (ODOMAP_DEBUG=1 shows where; please report it)", 1)
    return code


def _fail(message: str, code: int) -> int:
    print(f"odomap: {message}", file=sys.stderr)
    if os.environ.get("ODOMAP_DEBUG", "") not in ("", "0"):
        traceback.print_exc()
    return code
