"""Rhythms by name: which thread runs what, and when.

    inline    each stage in turn, in the caller's thread; the same bytes on every run
    lockstep  stages beside the tracker, their results due after a fixed number of frames
    live      stages beside the tracker, the source in a thread of its own; late frames are dropped

Stages do not know which one it is (`stages`): a rhythm is chosen by name, anywhere.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType

from odomap.errors import ConfigError, nearest_name
from odomap.system.background import ThreadConfig
from odomap.system.live import LiveWorker
from odomap.system.lockstep import LockstepWorker
from odomap.system.stages import Stages
from odomap.system.worker import InlineWorker, Worker

__all__ = ["RHYTHMS", "check_rhythm", "make_worker"]

RHYTHMS: Mapping[str, Callable[[Stages, ThreadConfig], Worker]] = MappingProxyType(
    {
        "inline": lambda stages, _: InlineWorker(stages),
        "lockstep": LockstepWorker,
        "live": LiveWorker,
    }
)
"""The rhythms there are, by name."""


def check_rhythm(rhythm: str) -> None:
    """Raise unless there is such a rhythm.

    Raises:
        ConfigError: it names those there are.
    """
    if rhythm not in RHYTHMS:
        known, near = ", ".join(RHYTHMS), nearest_name(rhythm, RHYTHMS)
        raise ConfigError(f"rhythm: '{rhythm}' is unknown{near}; use one of: {known}")


def make_worker(rhythm: str, stages: Stages, config: ThreadConfig | None = None) -> Worker:
    """Return a worker of the rhythm asked for.

    Args:
        rhythm: one of `RHYTHMS`.
        stages: the agents of the run.
        config: delays and queues, for those with threads.

    Raises:
        ConfigError: there is no such rhythm.
    """
    check_rhythm(rhythm)
    return RHYTHMS[rhythm](stages, ThreadConfig() if config is None else config)
