"""Who may talk to a local server: only pages that it served itself, to whoever knows the address it printed.

A page on the Internet can make a browser send requests to 127.0.0.1 (cross-site requests, DNS rebinding). Hence every
request must carry the token in its path, name this machine as Host, come from this Origin, and be small.
"""

import secrets
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any

from starlette.exceptions import HTTPException

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]

MAX_BODY = 8 * 2**20
"""Bytes of a request; a mask of 4000 x 3000 pixels has some ten thousand."""

_HEADERS = {
    "content-security-policy": "default-src 'self'; img-src 'self' blob: data:; frame-ancestors 'none'; "
    "base-uri 'none'; form-action 'none'; object-src 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
}


class Guard:
    """ASGI middleware: serves `app` below /TOKEN/ and refuses everything else.

    Args:
        app: the application; it sees paths without the token.
        token: the secret part of the address.
        port: the port served on 127.0.0.1.
    """

    def __init__(self, app: Callable[..., Awaitable[None]], token: str, port: int):
        self.app, self.token = app, token
        self.hosts = {f"127.0.0.1:{port}", f"localhost:{port}"}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        if scope["type"] != "http":
            await send({"type": "websocket.close", "code": 1008})
            return
        headers = {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope["headers"]}
        refusal = self._refusal(scope, headers)
        if refusal is not None:
            await _answer(send, *refusal)
            return
        received = 0

        async def counted() -> MutableMapping[str, Any]:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            if received > MAX_BODY:
                raise HTTPException(413, _TOO_LARGE, {"connection": "close"})
            return message

        async def protected(message: MutableMapping[str, Any]) -> None:
            if message["type"] == "http.response.start":
                extra = [(name.encode(), value.encode()) for name, value in _HEADERS.items()]
                message = {**message, "headers": [*message["headers"], *extra]}
            await send(message)

        inner = {**scope, "path": scope["path"][len(self.token) + 1 :], "raw_path": b""}
        await self.app(inner, counted, protected)

    def _refusal(self, scope: Scope, headers: dict[str, str]) -> tuple[int, str] | None:
        """Status and words for a request that is not served."""
        if headers.get("host") not in self.hosts:
            return 421, "This server answers to 127.0.0.1 only."
        origin = headers.get("origin")
        if origin is not None and origin.removeprefix("http://") not in self.hosts:
            return 403, "Requests from other pages are refused."
        if headers.get("sec-fetch-site", "none") not in ("same-origin", "none"):
            return 403, "Requests from other pages are refused."
        given = scope["path"].lstrip("/").split("/")[0]
        if not secrets.compare_digest(given.encode(), self.token.encode()) or not scope["path"].startswith(
            f"/{self.token}/"
        ):
            return 403, "This address is not valid, or not any more. Use the one that the running command printed."
        if scope["method"] not in ("GET", "HEAD") and not headers.get("content-type", "").startswith(
            "application/json"
        ):
            return 415, "JSON is expected."
        length = headers.get("content-length", "0")
        if not length.isdigit() or int(length) > MAX_BODY:
            return 413, _TOO_LARGE
        return None


_TOO_LARGE = f"A request may have {MAX_BODY} bytes."


async def _answer(send: Send, status: int, words: str) -> None:
    body = words.encode()
    # The body, if there is one, is not read: without "close" a server would have to wait for its end.
    headers = {
        **_HEADERS,
        "connection": "close",
        "content-type": "text/plain; charset=utf-8",
        "content-length": str(len(body)),
    }
    encoded = [(name.encode(), value.encode()) for name, value in headers.items()]
    await send({"type": "http.response.start", "status": status, "headers": encoded})
    await send({"type": "http.response.body", "body": body})
