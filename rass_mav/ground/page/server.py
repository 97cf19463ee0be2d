"""Serves the page: static files, the mission as JSON, and news as Server-Sent Events. It changes nothing."""

from __future__ import annotations

import asyncio
import json
import logging
import math
import time
from collections.abc import Awaitable, Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from aiohttp import web

from rass_mav import __version__
from rass_mav.app.outlets import PageSection
from rass_mav.errors import RassError, why
from rass_mav.ground.attention.conditions import marks, rows
from rass_mav.ground.attention.rules import RuleBook
from rass_mav.ground.attention.watch import as_of
from rass_mav.ground.entry import Data
from rass_mav.ground.sources.locator import Locator, SourcesError
from rass_mav.ground.sources.readings import Sample
from rass_mav.link.address import parse_address, show_address

from .access import Access, GuessedError
from .connections import BACKLOG, END, Client, CrowdedError, Door, Guest, Hub
from .exports import BusyError, Exports
from .follow import Answer, Follower, ask_node
from .tiles import NOTHING, Tiles

log = logging.getLogger(__name__)

#: Seconds between two looks at the store, and between two questions to its node.
LOOK_S = 0.5
ASK_S = 5.0
#: Looks take at most this part of a core, however much the store holds and however busy the computer is.
LOOK_SHARE = 0.1
#: A browser hears something at least this often, seconds.
BEAT_S = 10.0
#: Between two estimates of the sources, at least, seconds, and the part of a core that they take at most: after one, so
#: long that it is no more. With five sources and 10,000 readings that is within 5 s of new readings
#: (`python -m benchmarks.sources`).
LOCATE_S, LOCATE_SHARE = 0.5, 0.3
#: So long after it has failed, seconds.
LOCATE_AGAIN_S = 5.0
#: Contours are drawn at most this often, seconds, and drawing them takes at most this part of a core.
CONTOURS_S, CONTOURS_SHARE = 5.0, 0.02
COOKIE = "rass-page"
#: A connection that asks nothing for so long is closed, seconds.
IDLE_S = 15.0
#: Events that browsers get, the latest.
MOST_EVENTS = 200
#: Drones whose readings are drawn in one chart.
MOST_COMPARED = 8
#: Bytes of a file that are sent at a time, and how long a browser may take for them, seconds.
PIECE_BYTES, PIECE_S = 256 * 1024, 30.0
#: Bytes of a login form.
_MOST_BODY = 4096

STATIC = Path(__file__).parent / "static"
_KINDS = {".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".png": "image/png"}

HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
        "form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "geolocation=(), camera=(), microphone=()",
}
#: Who needs no token: the login, what it looks like, and whoever asks whether the page is there.
_OPEN = ("/login", "/healthz", "/static/")

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]
T = TypeVar("T")


def static_files() -> dict[str, tuple[bytes, str]]:
    """All that is served below /static/: by name the bytes and the type."""
    paths = [path for path in STATIC.rglob("*") if path.suffix in _KINDS]
    return {path.relative_to(STATIC).as_posix(): (path.read_bytes(), _KINDS[path.suffix]) for path in paths}


class Page:
    """The handlers, and the state that they share."""

    def __init__(
        self, follower: Follower, access: Access, *, tiles: Tiles | None = None, socket: Path | None = None,
        hub: Hub | None = None, now: Callable[[], float] = time.time,
    ) -> None:  # fmt: skip
        """`socket`: of the node that writes the store. `now`: the date, seconds since 1970."""
        self.hub = Hub() if hub is None else hub
        self.door = Door()
        self._follower, self._access, self._tiles, self._socket, self._now = follower, access, tiles, socket, now
        # One thread for the store and the mission, so that they need no locks; one for the tiles.
        self._reading = ThreadPoolExecutor(1, "page-store")
        self._drawing = ThreadPoolExecutor(1, "page-tiles")
        self._exports = Exports(follower.open)
        self._files = static_files()
        self._node: Answer | None = None
        self._asked = False
        """Whether the node has been asked."""
        self._attention: dict[str, Any] = {}
        """The list as the browsers have it."""
        self._counted = 0
        """Events that they have."""
        self.locator = Locator()
        # The last estimate, and why there is no newer one.
        self._sources: dict[str, Any] = {"estimate": None, "trouble": ""}
        self._contours: dict[str, Any] | None = None
        """As the browsers have them; None: they have not been drawn yet."""
        self.tasks: list[asyncio.Task[None]] = []
        """They end only with a fault."""

    @property
    def remarks(self) -> list[str]:
        """What is wrong with the store, for people."""
        return self._follower.remarks

    def app(self) -> web.Application:
        """The application."""

        @web.middleware
        async def guard(request: web.Request, handler: Handler) -> web.StreamResponse:
            if request.transport is None:
                # The connection has ended meanwhile: nobody gets this.
                return web.Response(status=408)
            with self.door.asking(request.transport):
                return await self._guard(request, handler)

        app = web.Application(middlewares=[guard], client_max_size=_MOST_BODY)
        app.on_response_prepare.append(_add_headers)
        app.add_routes(
            [
                web.get("/", self._index),
                web.get("/static/{name:.+}", self._static),
                web.get("/login", self._login_form),
                web.post("/login", self._login),
                web.post("/logout", self._logout),
                web.get("/healthz", self._health),
                web.get("/api/mission", self._mission),
                web.get("/api/events", self._events),
                web.get(r"/api/drone/{id:\d{1,6}}", self._drone),
                web.get("/api/at", self._at),
                web.get(r"/api/picture/{id:\d{1,5}-[0-9a-f]{8}-\d{1,10}}", self._picture),
                web.get("/api/readings", self._readings),
                web.get("/api/export/{name:[a-z0-9_]{1,20}}", self._export),
                web.get(r"/tiles/{zoom:\d{1,2}}/{x:\d{1,8}}/{y:\d{1,8}}", self._tile),
            ]
        )
        app.on_startup.append(self._start)
        app.on_shutdown.append(self._stop)
        app.on_cleanup.append(self._close)
        return app

    # -- following -----------------------------------------------------------------------------------------------------

    async def _start(self, app: web.Application) -> None:
        self.tasks.append(asyncio.create_task(self._follow()))
        self.tasks.append(asyncio.create_task(self._locate()))
        self.tasks.append(asyncio.create_task(self._draw_contours()))
        if self._socket is not None:
            self.tasks.append(asyncio.create_task(self._watch(self._socket)))

    async def _follow(self) -> None:
        while True:
            news, spent = await self._in_turn(self._look)
            for each in news:
                self.hub.publish(each)
            if not self._follower.behind:
                await asyncio.sleep(max(LOOK_S, spent / LOOK_SHARE))

    def _look(self) -> tuple[list[bytes], float]:
        """Look at the store. Returns what browsers get of it, and the processor time that this took, seconds."""
        begun = time.thread_time()
        news = [self._news()] if self._follower.look() else []
        # Silence is news, too.
        if (attention := self._look_at_attention()) is not None:
            news.append(event("attention", attention))
        return news, time.thread_time() - begun

    async def _locate(self) -> None:
        """Estimate where sources are whenever readings have come, in another process and on another thread."""
        done = None
        while True:
            samples = self._follower.mission.samples
            if self._follower.behind or done == (id(samples), samples.changes):
                await asyncio.sleep(LOCATE_S)
                continue
            done = id(samples), samples.changes
            unit, chosen = await self._in_turn(lambda samples=samples: _copied(*samples.main))  # type: ignore[misc]
            rest = LOCATE_AGAIN_S
            try:
                found, spent = await asyncio.to_thread(self.locator.ask, unit, chosen)
                rest = max(LOCATE_S, spent / LOCATE_SHARE - spent)
                self._sources = {"estimate": found, "trouble": ""}
            except SourcesError as error:
                # The last estimate stays, and the page says that it is old.
                self._sources = {**self._sources, "trouble": str(error)}
                done = None
            self.hub.publish(event("sources", {"sources": self._sources}))
            await asyncio.sleep(rest)

    async def _draw_contours(self) -> None:
        """Draw them again whenever readings or levels have changed."""
        done = None
        while True:
            mission, spent = self._follower.mission, 0.0
            state = id(mission), mission.samples.changes, mission.rules.contours, mission.rules.above
            if not self._follower.behind and state != done:
                done = state
                self._contours, spent = await self._in_turn(lambda mission=mission: _timed(mission.contours))  # type: ignore[misc]
                self.hub.publish(event("contours", {"contours": self._contours}))
            # The first time soon: a page that has just begun has none.
            await asyncio.sleep(max(CONTOURS_S if done else LOOK_S, spent / CONTOURS_SHARE))

    async def _watch(self, socket: Path) -> None:
        while True:
            self._node = await asyncio.to_thread(ask_node, socket)
            self._asked = True
            self.hub.publish(event("node", {"node": self._about_node, "run": self._run, "now": self._date()}))
            await asyncio.sleep(ASK_S)

    async def _in_turn(self, work: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._reading, work)

    def _news(self) -> bytes:
        if self._follower.begins:
            return event("mission", self._snapshot())
        return event("news", {**self._about(), **self._follower.mission.changes()})

    def _snapshot(self) -> dict[str, Any]:
        tiles = None if self._tiles is None else self._tiles.plain()
        return {
            **self._about(), "version": __version__, "exports": self._exports.plain(),
            "compared": MOST_COMPARED, "tiles": tiles, "token": self._access.needs_token,
            "attention": self._now_attention(), "events": self._events_now(), "sources": self._sources,
            "contours": self._contours, **self._follower.mission.snapshot(),
        }  # fmt: skip

    @property
    def _about_node(self) -> dict[str, Any] | None:
        return None if self._node is None else self._node.about

    def _look_at_attention(self) -> dict[str, Any] | None:
        """What needs attention, and what has begun and ended, if either has changed; None: neither has."""
        found, counted = self._now_attention(), self._follower.mission.watch.counted
        if found == self._attention and counted == self._counted:
            return None
        self._attention, self._counted = found, counted
        return {"now": self._date(), "attention": found, "events": self._events_now()}

    def _now_attention(self) -> dict[str, Any]:
        now, date = self._date(), self._follower.date
        watch = self._follower.mission.watch
        found = watch.conditions(now, date) + ([] if self._node is None else self._node.attention)
        then, _ = as_of(now, date)
        return {
            "rows": [{**row._asdict(), "level": row.level.word} for row in rows(found, then)],
            "marks": {str(id): level.word for id, level in marks(found).items()},
            "silent": [one.drone for one in found if one.kind in ("silent", "unheard")],
        }

    def _events_now(self) -> list[dict[str, Any]]:
        """The latest, for people."""
        found = self._follower.mission.watch.events()[-MOST_EVENTS:]
        return [{"utc": one.utc, "begins": one.begins, "level": one.level.word, "text": one.line} for one in found]

    def _date(self) -> float:
        """Now, seconds since 1970. A mock swarm is ahead of the clock: then the time of what came last."""
        return max(self._now(), self._follower.mission.end)

    def _about(self) -> dict[str, Any]:
        follower = self._follower
        return {
            "now": self._date(), "store": follower.name, "title": follower.title, "trouble": follower.trouble,
            "remarks": follower.remarks, "behind": follower.behind, "node": self._about_node, "run": self._run,
        }  # fmt: skip

    @property
    def _run(self) -> str:
        """Whether data may still come: `runs`, `stopped` (no node writes the store) or `ended` (the run is over)."""
        if self._follower.ended:
            return "ended"
        if self._asked:
            return "stopped" if self._node is None else "runs"
        return "stopped" if as_of(self._now(), self._follower.date)[1] else "runs"

    async def _stop(self, app: web.Application) -> None:
        for task in self.tasks:
            task.cancel()
        self.locator.close()
        await asyncio.gather(*self.tasks, return_exceptions=True)
        self.hub.close(event("end", {"now": self._date()}))

    async def _close(self, app: web.Application) -> None:
        self._reading.shutdown()
        self._drawing.shutdown()
        self._exports.close()
        self._follower.close()
        if self._tiles is not None:
            self._tiles.close()

    # -- who may ask ---------------------------------------------------------------------------------------------------

    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        local = request.transport.get_extra_info("sockname") if request.transport is not None else None
        if not self._access.knows_host(request.headers.get("Host"), local[0] if local else ""):
            raise web.HTTPMisdirectedRequest(text="unknown host name: see --name\n")
        # Other sites may link to the page, and do nothing else.
        site = request.headers.get("Sec-Fetch-Site", "none")
        if site not in ("same-origin", "none") and request.path not in ("/", "/login"):
            raise web.HTTPForbidden(text="cross-site request refused\n")
        if request.method == "POST" and site not in ("same-origin", "none"):
            raise web.HTTPForbidden(text="cross-site request refused\n")
        if not request.path.startswith(_OPEN) and not self._admitted(request):
            if request.path == "/":
                raise web.HTTPSeeOther("/login")
            raise web.HTTPUnauthorized(text="token required\n", headers={"WWW-Authenticate": "Bearer"})
        return await handler(request)

    def _admitted(self, request: web.Request) -> bool:
        with _guessed():
            given = request.headers.get("Authorization"), request.cookies.get(COOKIE)
            return self._access.admits(*given, request.remote)

    async def _login_form(self, request: web.Request) -> web.StreamResponse:
        if self._admitted(request):
            raise web.HTTPSeeOther("/")
        return self._file("login.html")

    async def _login(self, request: web.Request) -> web.StreamResponse:
        given = (await request.post()).get("token")
        with _guessed():
            if not isinstance(given, str) or not self._access.is_token(given.strip(), request.remote):
                log.warning("%s: a wrong token", request.remote)
                form = self._file("login.html", status=401)
                form.body = self._files["login.html"][0].replace(b' role="alert" hidden', b' role="alert"')
                return form
        found = web.HTTPSeeOther("/")
        found.set_cookie(COOKIE, self._access.log_in(), httponly=True, samesite="Strict", path="/")
        raise found

    async def _logout(self, request: web.Request) -> web.StreamResponse:
        self._access.log_out(request.cookies.get(COOKIE))
        found = web.HTTPSeeOther("/login")
        found.del_cookie(COOKIE, httponly=True, samesite="Strict", path="/")
        raise found

    # -- answers -------------------------------------------------------------------------------------------------------

    async def _index(self, request: web.Request) -> web.StreamResponse:
        return self._file("index.html")

    async def _static(self, request: web.Request) -> web.StreamResponse:
        name = request.match_info["name"]
        if name not in self._files:
            raise web.HTTPNotFound(text="no such file\n")
        return self._file(name)

    def _file(self, name: str, status: int = 200) -> web.Response:
        body, kind = self._files[name]
        charset = None if kind == "image/png" else "utf-8"
        headers = {"Cache-Control": "no-cache"}
        return web.Response(body=body, status=status, content_type=kind, charset=charset, headers=headers)

    async def _health(self, request: web.Request) -> web.StreamResponse:
        return answer({"ok": not self._follower.trouble})

    async def _mission(self, request: web.Request) -> web.StreamResponse:
        return answer(await self._in_turn(self._snapshot))

    async def _drone(self, request: web.Request) -> web.StreamResponse:
        id = int(request.match_info["id"])
        found = await self._in_turn(lambda: self._follower.mission.drone(id))
        if found is None:
            raise web.HTTPNotFound(text="no such drone\n")
        return answer(found)

    async def _at(self, request: web.Request) -> web.StreamResponse:
        try:
            wanted = float(request.query.get("t", ""))
        except ValueError:
            wanted = math.nan
        if not math.isfinite(wanted):
            raise web.HTTPBadRequest(text="expected t, seconds since 1970\n")
        return answer(await self._in_turn(lambda: self._follower.mission.at(wanted)))

    async def _picture(self, request: web.Request) -> web.StreamResponse:
        id = request.match_info["id"]
        found = await self._in_turn(lambda: self._follower.picture(id))
        if found is None:
            raise web.HTTPNotFound(text="no such picture\n")
        body, kind = found
        # Of a name that a drone gave nothing gets into the headers.
        headers = {
            "Cache-Control": "private, max-age=3600",
            "Content-Disposition": f'inline; filename="{id}.{kind.removeprefix("image/")}"',
        }
        return web.Response(body=body, content_type=kind, headers=headers)

    async def _readings(self, request: web.Request) -> web.StreamResponse:
        words = request.query.get("drones", "").split(",")
        if not all(word.isascii() and word.isdigit() and len(word) <= 5 for word in words):
            raise web.HTTPBadRequest(text="expected drones, numbers separated by commas\n")
        drones = sorted({int(word) for word in words})
        if len(drones) > MOST_COMPARED:
            raise web.HTTPBadRequest(text=f"expected at most {MOST_COMPARED} drones\n")
        found = await self._in_turn(lambda: self._follower.mission.drawn(drones))
        return answer({"drones": {str(id): readings for id, readings in found.items()}})

    async def _export(self, request: web.Request) -> web.StreamResponse:
        name = request.match_info["name"]
        if name not in self._exports.formats:
            raise web.HTTPNotFound(text="no such format\n")
        try:
            async with self._exports.file(name, lambda: request.transport is None) as path:
                return await _sent(request, path)
        except BusyError as error:
            raise web.HTTPServiceUnavailable(text=f"{error}\n", headers={"Retry-After": "5"}) from None
        except RassError as error:
            raise web.HTTPConflict(text=" ".join(error.lines()) + "\n") from None

    async def _tile(self, request: web.Request) -> web.StreamResponse:
        tiles = self._tiles
        if tiles is None:
            raise web.HTTPNotFound(text="no tiles\n")
        zoom, x, y = (int(request.match_info[name]) for name in ("zoom", "x", "y"))
        loop = asyncio.get_running_loop()
        found = await loop.run_in_executor(self._drawing, lambda: tiles.get(zoom, x, y))
        body, kind = (NOTHING, "image/png") if found is None else found
        return web.Response(body=body, content_type=kind, headers={"Cache-Control": "private, max-age=3600"})

    async def _events(self, request: web.Request) -> web.StreamResponse:
        transport = request.transport
        assert transport is not None
        try:
            client = self.hub.join(transport)
        except CrowdedError as error:
            raise web.HTTPServiceUnavailable(text=f"{error}\n", headers={"Retry-After": "10"}) from None
        response = web.StreamResponse(headers={"Content-Type": "text/event-stream", "Cache-Control": "no-store"})
        try:
            await response.prepare(request)
            await response.write(event("mission", await self._in_turn(self._snapshot)))
            while (news := await self._next(client)) != END:
                await response.write(news)
        except ConnectionError:
            # The browser is gone.
            return response
        finally:
            self.hub.leave(client)
        return response

    async def _next(self, client: Client) -> bytes:
        """What to send next: news, or a sign of life."""
        try:
            return await asyncio.wait_for(client.news.get(), BEAT_S)
        except asyncio.TimeoutError:
            return event("beat", {"now": self._date(), "run": self._run})


async def _sent(request: web.Request, path: Path) -> web.StreamResponse:
    """A file as an answer, to be saved. A browser that takes it too slowly is cut."""
    response = web.StreamResponse(headers={"Cache-Control": "no-store"})
    response.content_type = "application/octet-stream"
    response.content_length = path.stat().st_size
    response.headers["Content-Disposition"] = f'attachment; filename="{path.name}"'
    try:
        await response.prepare(request)
        with path.open("rb") as file:
            while piece := await asyncio.to_thread(file.read, PIECE_BYTES):
                await asyncio.wait_for(response.write(piece), PIECE_S)
    except asyncio.TimeoutError:
        if request.transport is not None:
            request.transport.abort()
    except ConnectionError:
        pass
    return response


def _timed(work: Callable[[], T]) -> tuple[T, float]:
    """What it returns, and the processor time that it took, seconds."""
    begun = time.thread_time()
    return work(), time.thread_time() - begun


def _copied(unit: str, samples: list[Sample]) -> tuple[str, list[Sample]]:
    return unit, list(samples)


@contextmanager
def _guessed() -> Iterator[None]:
    try:
        yield
    except GuessedError as error:
        raise web.HTTPTooManyRequests(text=f"{error}\n", headers={"Retry-After": str(error.wait_s)}) from None


def answer(plain: dict[str, Any]) -> web.Response:
    """Values as JSON, which no cache keeps."""
    return web.Response(body=dump(plain), content_type="application/json", headers={"Cache-Control": "no-store"})


def dump(plain: dict[str, Any]) -> bytes:
    """As JSON on one line. Raises `ValueError` for numbers that JSON does not know."""
    return json.dumps(plain, allow_nan=False, separators=(",", ":")).encode("ascii")


def event(kind: str, plain: dict[str, Any]) -> bytes:
    """A Server-Sent Event. JSON in ASCII has no line ends, so nothing in the data can end it."""
    return b"event: " + kind.encode("ascii") + b"\ndata: " + dump(plain) + b"\n\n"


async def _add_headers(request: web.Request, response: web.StreamResponse) -> None:
    for name, value in HEADERS.items():
        response.headers[name] = value
    response.headers["Server"] = "rass-mav"


def page_of(
    section: PageSection, open: Callable[[], Data], socket: Path | None, rules: RuleBook | None = None, *,
    keep: bool = False,
) -> Page:  # fmt: skip
    """The page with these settings. `open`, `rules`, `keep` and `socket`: as a `Follower` and a `Page` take them.
    Raises `ConfigError`, and what `open` raises."""
    host, _ = parse_address(section.listen, any_port=True, ipv6=True)
    access = Access(host, section.token(), section.names)
    tiles = None if section.tiles is None else Tiles(Path(section.tiles))
    return Page(Follower(open, rules, keep=keep), access, tiles=tiles, socket=socket)


async def serve(page: Page, listen: str, ready: Callable[[str], None], stopped: asyncio.Event) -> None:
    """Serve until `stopped`. `ready` is called with the page's URL. `OSError`: the address cannot be used."""
    host, port = parse_address(listen, any_port=True, ipv6=True)
    loop = asyncio.get_running_loop()
    loop.set_exception_handler(_Complaints())
    runner = web.AppRunner(page.app(), access_log=None, shutdown_timeout=1.0, keepalive_timeout=IDLE_S)
    await runner.setup()
    server = None
    try:
        made = runner.server
        assert made is not None
        server = await loop.create_server(lambda: Guest(page.door, made), host, port, backlog=BACKLOG)
        address = server.sockets[0].getsockname()
        ready(f"http://{show_address((str(address[0]), int(address[1])))}/")
        waits = [asyncio.create_task(stopped.wait()), *page.tasks]
        done, _ = await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()
    finally:
        if server is not None:
            server.close()
        await runner.cleanup()


class _Complaints:
    """What goes wrong in the loop. That no connection can be accepted, which the loop tries again, is said once."""

    def __init__(self) -> None:
        self._said = False

    def __call__(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        error = context.get("exception")
        if not isinstance(error, OSError) or "accept" not in context["message"]:
            loop.default_exception_handler(context)
        elif not self._said:
            self._said = True
            log.warning("cannot accept connections: %s", why(error))
