"""A viser server that only its own page may talk to."""

import contextlib
import io
from typing import Any
from urllib.parse import urlsplit

import viser
import websockets.asyncio.server

LOOPBACK = ("localhost", "127.0.0.1", "::1")


def start_server(host: str, port: int) -> viser.ViserServer:
    """A viser server, without its banner.

    viser lets a page of any other site, open in the same browser, read everything and press every
    button. Here a websocket must come from the page itself: its `Origin` must be the `Host` that it
    asks, and on this machine alone that host must be a name of this machine (a foreign name that
    was made to point here is none).

    Args:
        host, port: where to listen.
    """
    serve = websockets.asyncio.server.serve

    def guarded(*args: Any, process_request: Any, **settings: Any) -> Any:
        def check(connection: Any, request: Any) -> Any:
            asked, origin = request.headers.get("Host", ""), request.headers.get("Origin")
            foreign = origin is not None and urlsplit(origin).netloc != asked
            if foreign or (host in LOOPBACK and urlsplit(f"//{asked}").hostname not in LOOPBACK):
                return connection.respond(403, "This page talks to its own site only.\n")
            return process_request(connection, request)

        return serve(*args, process_request=check, **settings)

    websockets.asyncio.server.serve = guarded  # type: ignore[assignment, misc]
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            return viser.ViserServer(host=host, port=port, label="goalgan_bt")
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]
