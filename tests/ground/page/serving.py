"""A page that is served on a port of its own, for tests."""

from __future__ import annotations

from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from pathlib import Path
from typing import Any

from aiohttp import ClientSession
from aiohttp.test_utils import TestClient, TestServer

from rass_mav.ground.archive import Archive
from rass_mav.ground.page.access import Access
from rass_mav.ground.page.follow import Follower
from rass_mav.ground.page.server import Page

TOKEN = "0123456789abcdef"


@asynccontextmanager
async def serving(
    store: Path, *, token: str | None = None, **more: Any
) -> AsyncIterator[tuple[Page, TestClient[Any, Any]]]:
    """The page of a store, and a client of it."""
    page = Page(Follower(lambda: Archive(store)), Access("127.0.0.1", token, ["base.local"]), **more)
    async with TestClient(TestServer(page.app(), host="127.0.0.1")) as client:
        yield page, client


async def events(session: ClientSession, url: str) -> AsyncGenerator[tuple[str, bytes], None]:
    """The events of a page: kind and data."""
    async with session.get(url) as response:
        assert response.status == 200
        kind = ""
        buffer = b""
        async for chunk in response.content.iter_any():
            *lines, buffer = (buffer + chunk).split(b"\n")
            for line in lines:
                if line.startswith(b"event: "):
                    kind = line[7:].decode()
                elif line.startswith(b"data: "):
                    yield kind, line[6:]


async def status_of(request: AbstractAsyncContextManager[Any]) -> int:
    """The status of the answer to a request."""
    async with request as answer:
        status: int = answer.status
        return status
