"""The live view's server answers its own page alone: not other sites, nor other names of this machine."""

from __future__ import annotations

import http
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from ..errors import UserError

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request

#: The names by which a browser may know this machine; behind ``ssh -L`` the port is another one.
_NAMES = {"localhost", "127.0.0.1", "[::1]"}


def is_own(host: str | None, origin: str | None) -> bool:
    """Whether a request is by our own page, or for it.

    Args:
        host: the header ``Host``. A foreign name may lead here (DNS rebinding).
        origin: the header ``Origin``, which browsers send with every connection that a page opens; None if
            there is none.

    >>> is_own("localhost:8080", "http://localhost:8080"), is_own("localhost:8080", None)
    (True, True)
    >>> is_own("localhost:8080", "http://evil.example"), is_own("evil.example:8080", None)
    (False, False)
    """
    name = (host or "").rpartition(":")[0] or host
    return name in _NAMES and origin in (None, f"http://{host}")


@contextmanager
def guarded_server() -> Iterator[None]:
    """Within, servers that the package websockets starts refuse what is not ``is_own``; viser has no setting
    for that.

    Raises:
        UserError: none was started, so that this viser works in another way.
    """
    import websockets.asyncio.server as server

    serve, guarded = server.serve, []

    def serve_guarded(
        *arguments: Any, process_request: Callable[..., Any] | None = None, **others: Any
    ) -> Any:
        def answer(connection: ServerConnection, request: Request) -> Any:
            if not is_own(request.headers.get("Host"), request.headers.get("Origin")):
                return connection.respond(http.HTTPStatus.FORBIDDEN, "This page belongs to another origin.\n")
            return process_request(connection, request) if process_request else None

        guarded.append(True)
        return serve(*arguments, process_request=answer, **others)

    server.serve = serve_guarded
    try:
        yield
    finally:
        server.serve = serve
    if not guarded:
        raise UserError(
            "This version of viser cannot be kept to its own page; install another one, or leave "
            "out --viewer."
        )


def free_port(first: int) -> int:
    """The first free port of this machine from ``first`` on; 0 takes any.

    Raises:
        UserError: it is no port, or none is free.
    """
    if not 0 <= first <= 65535:
        raise UserError(f"--viewer-port lies between 0 and 65535, unlike {first}.")
    for port in range(first, 65536):
        with socket.socket() as probe:
            try:
                # As asyncio's servers do: a port of which an earlier one still waits to be closed is free.
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(("127.0.0.1", port))
                return probe.getsockname()[1]
            except OSError:
                continue
    raise UserError(f"No port from {first} on is free; choose a smaller --viewer-port.")
