"""A viser server that only its own page may talk to."""

import asyncio
import contextlib
import gzip
import io
import ipaddress
import re
import socket
import time
from functools import lru_cache
from html import escape
from typing import Any

import viser
import websockets.asyncio.server
from viser import _messages
from websockets.datastructures import Headers
from websockets.http11 import Response

HOST = re.compile(r"(?:\[([0-9a-f:]+)\]|([a-z0-9.]+))(?::\d{1,5})?", re.IGNORECASE)
MOST_VISITORS = 64  # at a time
MOST_SENT = 2**20  # bytes of one message from a browser: clicks and the like are all
MESSAGES = 60.0  # a second from one browser; a camera that is dragged sends about thirty
VISITS = 2.0  # a second, all browsers together, once `MOST_VISITORS` have come
REFUSAL = 0.5  # seconds until a refusal is said, so that asking again and again is slow


def is_loopback(host: str) -> bool:
    """Whether who listens at that name or address is heard on this machine alone.

    Raises:
        OSError: if there is no such name.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    addresses = {str(found[4][0]) for found in socket.getaddrinfo(host, None, family)}
    return all(ipaddress.ip_address(address).is_loopback for address in addresses)


def of_this_machine(asked: str) -> bool:
    """Whether a `Host` names this machine as only who is on it can mean it. A foreign name that was
    made to point here is none."""
    named = HOST.fullmatch(asked)
    name = "" if named is None else (named[1] or named[2])
    try:
        return name == "localhost" or ipaddress.ip_address(name).is_loopback
    except ValueError:
        return False


def of_page(origin: str, host: str) -> bool:
    """Whether a page of that `Origin` is the one that this `Host` serves."""
    return origin in (f"http://{host}", f"https://{host}")


def titled(response: Any, title: str) -> Any:
    """A response of viser's; its page with another title, since several may be open."""
    if response is None or not response.headers.get("Content-Type", "").startswith("text/html"):
        return response
    zipped = response.headers.get("Content-Encoding") == "gzip"
    body = _with_title(response.body, title, zipped)
    headers = Headers(response.headers)
    del headers["Content-Length"]
    headers["Content-Length"] = str(len(body))
    return Response(response.status_code, response.reason_phrase, headers, body)


@lru_cache(maxsize=4)  # viser gives the same page each time
def _with_title(page: bytes, title: str, zipped: bool) -> bytes:
    body = gzip.decompress(page) if zipped else page
    body = body.replace(b"<title>Viser</title>", f"<title>{escape(title)}</title>".encode(), 1)
    return gzip.compress(body) if zipped else body


class Allowance:
    """So many at once, and then so many a second (a token bucket).

    Args:
        at_once: how many may come together.
        per_second: how many become free again, each second.
    """

    def __init__(self, at_once: float, per_second: float) -> None:
        self._most, self._rate = at_once, per_second
        self._free, self._since = at_once, time.monotonic()

    def wait(self) -> float:
        """Take one; the seconds until it is free (0: it is), for who is ready to wait."""
        now = time.monotonic()
        self._free = min(self._most, self._free + (now - self._since) * self._rate) - 1.0
        self._since = now
        return max(0.0, -self._free / self._rate)

    def take(self) -> bool:
        """Take one if it is free."""
        if self.wait() == 0.0:
            return True
        self._free += 1.0
        return False


def start_server(host: str, port: int, title: str = "goalgan_bt") -> viser.ViserServer:
    """A viser server, without its banner.

    viser lets a page of any other site, open in the same browser, read everything and press every
    button. Here a websocket must come from the page itself: its `Origin` must be the `Host` that it
    asks, and where only this machine is let in that host must be a name of this machine. Nobody
    sends files here, and not more may look at a time than `MOST_VISITORS`. Who sends or comes too
    fast waits or is refused, since all that is sent costs the training that runs beside it.

    Args:
        host, port: where to listen.
        title: what the browser calls the page.
    """
    serve = websockets.asyncio.server.serve
    alone, here, visits = is_loopback(host), 0, Allowance(MOST_VISITORS, VISITS)

    def guarded(handler: Any, *args: Any, process_request: Any, **settings: Any) -> Any:
        async def check(connection: Any, request: Any) -> Any:
            hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
            own = len(hosts) == 1 and all(of_page(origin, hosts[0]) for origin in origins)
            if not own or len(origins) > 1 or (alone and not of_this_machine(hosts[0])):
                await asyncio.sleep(REFUSAL)
                return connection.respond(403, "This page talks to its own site only.\n")
            comes = "Upgrade" in request.headers
            if comes and (here >= MOST_VISITORS or not visits.take()):
                await asyncio.sleep(REFUSAL)
                return connection.respond(503, "Too many are looking: try again later.\n")
            return titled(process_request(connection, request), title)

        async def counted(connection: Any) -> None:
            nonlocal here
            receive, messages = connection.recv, Allowance(MESSAGES, MESSAGES)

            async def unhurried() -> Any:
                await asyncio.sleep(messages.wait())  # meanwhile its sender is held up, too
                return await receive()

            connection.recv = unhurried
            here += 1
            try:
                await handler(connection)
            finally:
                here -= 1

        settings["max_size"] = MOST_SENT
        return serve(counted, *args, process_request=check, **settings)

    websockets.asyncio.server.serve = guarded  # type: ignore[assignment, misc]
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            server = viser.ViserServer(host=host, port=port, label="goalgan_bt")
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]
    for message in (_messages.FileTransferStartUpload, _messages.FileTransferPart):
        server._websock_server.unregister_handler(message)  # it would keep whatever is sent
    return server
