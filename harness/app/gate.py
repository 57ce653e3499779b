"""Who may talk to the page: a browser on this machine that was given the token, and was not sent by another page."""

from __future__ import annotations

import secrets
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any

HOST = "127.0.0.1"
"""The only address that is listened on; a name could be made to mean it by a foreign page (DNS rebinding)."""
SAFE = ("GET", "HEAD")
NO_TOKEN = "no token"
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "connect-src 'self'; frame-src 'self'; frame-ancestors 'self'; base-uri 'none'; form-action 'none'"
)
"""Nothing is loaded from anywhere else; the script sets widths and the like, hence inline styles."""
HEADERS = (
    (b"content-security-policy", POLICY.encode()),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"cache-control", b"no-store"),
)

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
Application = Callable[[Scope, Receive, Send], Awaitable[None]]


class Gate:
    """An ASGI application around another: refuses with 403 what is not ours, a websocket as any other request.

    Parameters
    ----------
    application : ASGI application
        Meets paths without the token.
    token : str
        The first part of every path.
    port : int
        Where this is served.
    once : str, optional
        A second token that leads to the first, a single time: what starts a browser can be read by all users of a
        computer.
    """

    def __init__(self, application: Application, token: str, port: int, once: str | None = None) -> None:
        self.application, self.token, self.once = application, token, once
        self.host = f"{HOST}:{port}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let a request in, or refuse it."""
        if scope["type"] == "lifespan":
            await self.application(scope, receive, send)
            return
        reason = self._refusal(scope)
        if reason == NO_TOKEN and scope["type"] == "http" and self._first_time(scope):
            await _lead(send, f"/{self.token}/")
            return
        if reason is not None:
            await _refuse(scope, send, reason)
            return
        _, _, inside = scope["path"].lstrip("/").partition("/")
        path = f"/{inside}"

        async def guarded(message: MutableMapping[str, Any]) -> None:
            if message["type"] == "http.response.start":
                given = {name.lower() for name, _ in message["headers"]}
                message["headers"] = [*message["headers"], *(one for one in HEADERS if one[0] not in given)]
            await send(message)

        await self.application({**scope, "path": path, "raw_path": path.encode()}, receive, guarded)

    def _first_time(self, scope: Scope) -> bool:
        """Return True for the token that is good once, which it then was."""
        given = scope["path"].strip("/")
        if self.once is None or not secrets.compare_digest(given.encode(), self.once.encode()):
            return False
        self.once = None
        return True

    def _refusal(self, scope: Scope) -> str | None:
        """Return why a request is refused; None if it is not."""
        headers: dict[bytes, list[str]] = {}
        for name, value in scope["headers"]:
            headers.setdefault(name.lower(), []).append(value.decode("latin-1"))
        if headers.get(b"host") != [self.host]:
            return "another host"
        origins = headers.get(b"origin", [])
        if any(origin != f"http://{self.host}" for origin in origins):
            return "another origin"
        first = scope["path"].lstrip("/").partition("/")[0]
        if not secrets.compare_digest(first.encode(), self.token.encode()):
            return NO_TOKEN
        unsafe = scope["type"] == "websocket" or scope["method"] not in SAFE
        return "no origin" if unsafe and not origins else None


async def _lead(send: Send, path: str) -> None:
    """Answer with where to go."""
    headers = [(b"location", path.encode()), (b"content-length", b"0"), *HEADERS]
    await send({"type": "http.response.start", "status": 303, "headers": headers})
    await send({"type": "http.response.body", "body": b""})


async def _refuse(scope: Scope, send: Send, reason: str) -> None:
    """Answer with 403."""
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008, "reason": reason})
        return
    text = f"refused: {reason}; open the address that sysid open printed\n".encode()
    headers = [(b"content-type", b"text/plain; charset=utf-8"), (b"content-length", str(len(text)).encode())]
    await send({"type": "http.response.start", "status": 403, "headers": [*headers, *HEADERS]})
    await send({"type": "http.response.body", "body": text})
