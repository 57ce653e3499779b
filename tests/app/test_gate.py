"""Nobody is answered but the browser that was given the address, on this machine, from this page."""

from __future__ import annotations

import asyncio
from typing import Any

import httpx
import pytest

from harness.app.gate import Gate

PORT, TOKEN = 5999, "right-token"
OWN = f"http://127.0.0.1:{PORT}"


async def _open(scope: Any, receive: Any, send: Any) -> None:
    body = scope["path"].encode()
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": body})


def answered(path: str, method: str = "GET", host: str = f"127.0.0.1:{PORT}", **headers: str) -> httpx.Response:
    async def ask() -> httpx.Response:
        transport = httpx.ASGITransport(Gate(_open, TOKEN, PORT))
        async with httpx.AsyncClient(transport=transport, base_url=OWN) as client:
            return await client.request(method, path, headers={"host": host, **headers})

    return asyncio.run(ask())


def test_with_the_token_and_from_here_it_answers_below_the_token() -> None:
    found = answered(f"/{TOKEN}/log?name=a")
    assert (found.status_code, found.text) == (200, "/log")
    assert answered(f"/{TOKEN}/run", "POST", origin=OWN).status_code == 200


def test_every_answer_forbids_what_is_not_of_this_page() -> None:
    policy = answered(f"/{TOKEN}/").headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "frame-ancestors 'self'" in policy
    assert "http" not in policy
    assert answered("/").headers["content-security-policy"] == policy


@pytest.mark.parametrize(
    ("path", "headers", "reason"),
    [
        ("/", {}, "no token"),
        ("/wrong-token/", {}, "no token"),
        (f"/{TOKEN}x/", {}, "no token"),
        ("/\u00e9/", {}, "no token"),
        (f"/{TOKEN}/", {"host": "localhost:5999"}, "another host"),
        (f"/{TOKEN}/", {"host": "evil.example"}, "another host"),
        (f"/{TOKEN}/", {"host": f"127.0.0.1:{PORT + 1}"}, "another host"),
        (f"/{TOKEN}/", {"origin": "http://evil.example"}, "another origin"),
        (f"/{TOKEN}/", {"origin": "null"}, "another origin"),
        (f"/{TOKEN}/", {"origin": f"http://127.0.0.1:{PORT + 1}"}, "another origin"),
    ],
)
def test_anything_else_is_refused(path: str, headers: dict[str, str], reason: str) -> None:
    found = answered(path, **headers)
    assert found.status_code == 403
    assert reason in found.text


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE"])
def test_what_changes_something_needs_the_origin_of_the_page(method: str) -> None:
    found = answered(f"/{TOKEN}/run", method)
    assert (found.status_code, "no origin" in found.text) == (403, True)


@pytest.mark.parametrize(
    ("path", "origin", "open_"),
    [
        ("/", OWN, False),
        (f"/{TOKEN}/x", "http://evil.example", False),
        (f"/{TOKEN}/x", "", False),
        (f"/{TOKEN}/x", OWN, True),
    ],
)
def test_a_websocket_is_held_to_the_same(path: str, origin: str, open_: bool) -> None:
    sent: list[Any] = []
    met: list[str] = []

    async def inner(scope: Any, receive: Any, send: Any) -> None:
        met.append(scope["path"])

    async def send(message: Any) -> None:
        sent.append(message)

    headers = [(b"host", f"127.0.0.1:{PORT}".encode()), *([(b"origin", origin.encode())] if origin else [])]
    scope = {"type": "websocket", "path": path, "headers": headers}
    asyncio.run(Gate(inner, TOKEN, PORT)(scope, None, send))  # type: ignore[arg-type]
    assert (met == ["/x"]) is open_
    assert [one["type"] for one in sent] == ([] if open_ else ["websocket.close"])


def test_the_address_that_a_browser_is_started_with_leads_here_once() -> None:
    async def ask() -> list[tuple[int, str]]:
        transport = httpx.ASGITransport(Gate(_open, TOKEN, PORT, once="first-time"))
        async with httpx.AsyncClient(transport=transport, base_url=OWN) as client:
            await client.get("/first-time/", headers={"host": "evil.example"})
            answers = [await client.get("/first-time/"), await client.get("/first-time/")]
            return [(one.status_code, one.headers.get("location", "")) for one in answers]

    assert asyncio.run(ask()) == [(303, f"/{TOKEN}/"), (403, "")]
