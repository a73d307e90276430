"""The server of the live view: found or missing, on which port, and quiet.

A page in the browser is served by viser (extra `view`): scene and panel live in its server, which
sends them to whoever opens the page, now or later, as often as they like. It listens on this
machine alone unless told otherwise, on the first free port from 8080 on, and says nothing on
stdout, which is for results. Its offer to share the page through a public relay is taken away:
images of somebody's home do not leave by a button.

Reference: viser, github.com/nerfstudio-project/viser (Apache-2.0).
"""

import contextlib
import errno
import importlib
import socket
from collections.abc import Iterator
from typing import Any

from odomap.errors import InputError, MissingExtra

__all__ = ["HOST", "PORT", "check_viewer", "close_server", "open_server"]

HOST = "127.0.0.1"
PORT = 8080
"""Where the page is by default."""

PORTS_TRIED = 100
"""Ports looked at, from the one wanted on."""


def check_viewer() -> Any:
    """Return the module that serves pages.

    Raises:
        MissingExtra: it is not installed.
    """
    try:
        return importlib.import_module("viser")
    except ImportError as error:
        raise MissingExtra(
            f"the live view needs viser ({error}): pip install 'odomap[view]'"
        ) from error


def open_server(host: str = HOST, port: int = PORT, title: str = "odomap") -> tuple[Any, str]:
    """Serve an empty page.

    Args:
        host: address to listen on; "0.0.0.0" lets other machines in.
        port: port wanted; the next free one is taken.
        title: shown above the panel.

    Returns:
        The server, and the address of its page.

    Raises:
        MissingExtra: viser is not installed.
        InputError: there is no such address here, or no free port.
    """
    viser = check_viewer()
    with _quiet():
        server = viser.ViserServer(
            host=host, port=_free_port(host, port), label=title, verbose=False
        )
    server.request_share_url = _keep_private
    server.gui.configure_theme(
        dark_mode=True, control_width="large", show_logo=False, show_share_button=False
    )
    shown = "127.0.0.1" if host in ("0.0.0.0", "localhost") else host
    return server, f"http://{shown}:{server.get_port()}"


def close_server(server: Any) -> None:
    """End a server and its threads; pages that are open keep showing what they have."""
    with _quiet():
        server.stop()


def _free_port(host: str, port: int) -> int:
    """Return the first free port; viser would look for ever where there is no such address."""
    if not 1 <= port <= 65535:
        raise InputError(f"port {port}: 1 to 65535 expected")
    for candidate in range(port, min(port + PORTS_TRIED, 65536)):
        try:
            family, kind, _, _, address = socket.getaddrinfo(
                host, candidate, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
            )[0]
        except OSError as error:
            raise InputError(f"address '{host}' of the view: {error.strerror}") from error
        with socket.socket(family, kind) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(address)
                probe.listen()  # two may be bound to a port, one alone listens
                return candidate
            except OSError as error:
                if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                    raise InputError(f"address '{host}' of the view: {error.strerror}") from error
                refused = error
    raise InputError(f"no free port at {host} from {port} on: {refused.strerror}")


def _keep_private(*_: object, **__: object) -> None:
    """Refuse to publish the page, whoever asks."""


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep viser from announcing itself on stdout."""
    console = importlib.import_module("rich").get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before
