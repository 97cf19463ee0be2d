"""The server: what it answers, and whom."""

from __future__ import annotations

import asyncio
import json
import re
import socketserver
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from rass_mav.core.datum import Kind
from rass_mav.errors import StoreError
from rass_mav.ground.archive import ENDED, Archive
from rass_mav.ground.formats import format_of, names
from tests.ground.mission_stores import HOSTILE
from tests.ground.missions import HERE, Base
from tests.patience import PATIENCE_S

pytest.importorskip("aiohttp", reason="aiohttp is not installed (extra ground)")

from aiohttp import CookieJar
from aiohttp.test_utils import TestClient, TestServer

from rass_mav.ground.page import exports
from rass_mav.ground.page.access import MOST_WRONG, WRONG_S, Access
from rass_mav.ground.page.connections import END, CrowdedError, Hub
from rass_mav.ground.page.follow import Follower, ask_node
from rass_mav.ground.page.server import HEADERS, MOST_COMPARED, Page, event
from rass_mav.ground.page.tiles import NOTHING, Tiles

from .images import image, png_head
from .serving import TOKEN, events, serving, status_of
from .test_tiles import JPEG, mbtiles


@pytest.fixture
def base(tmp_path: Path) -> Iterator[Base]:
    base = Base(tmp_path / "rass-1.db")
    base.arrive(base.measurement(7, 0, HERE), base.measurement(7, 3, HERE))
    yield base
    base.close()


async def test_every_answer_has_the_headers(base: Base) -> None:
    async with serving(base.path) as (_, client):
        for path, status in {
            "/": 200, "/static/page.css": 200, "/static/js/main.js": 200, "/static/vendor/leaflet.js": 200,
            "/api/mission": 200, "/healthz": 200, "/api/drone/7": 200, "/api/at?t=1": 200, "/login": 200,
            "/api/drone/9": 404, "/api/at": 400, "/api/at?t=nan": 400, "/api/at?t=1e999": 400, "/nothing": 404,
            "/static/../server.py": 404, "/static/%2e%2e/server.py": 404, "/static/vendor/README.md": 404,
            "/tiles/1/0/0": 404, "/api/drone/x": 404, "/api/picture/7-abc00001-9": 404, "/api/picture/x": 404,
            "/api/picture/7-abc00001-0": 404,
        }.items():  # fmt: skip
            async with client.get(path) as answer:
                assert (path, answer.status) == (path, status)
                for name, value in HEADERS.items():
                    assert answer.headers[name] == value
        policy = HEADERS["Content-Security-Policy"]
        for rule in ("default-src 'none'", "script-src 'self'", "style-src 'self'", "frame-ancestors 'none'"):
            assert rule in policy
        assert "unsafe" not in policy


async def test_it_is_read_only(base: Base) -> None:
    async with serving(base.path) as (_, client):
        for method in ("POST", "PUT", "DELETE", "PATCH"):
            for path in ("/", "/api/mission", "/api/drone/7", "/api/at?t=1"):
                assert await status_of(client.request(method, path)) == 405


@pytest.mark.parametrize(("host", "status"), [("evil.example", 421), ("evil.example:8080", 421), ("base.local", 200)])
async def test_another_name_that_points_here_gets_nothing(base: Base, host: str, status: int) -> None:
    async with serving(base.path) as (_, client):
        for path in ("/", "/api/mission", "/healthz"):
            assert await status_of(client.get(path, headers={"Host": host})) == status


@pytest.mark.parametrize("site", ["cross-site", "same-site"])
async def test_other_sites_get_nothing(base: Base, site: str) -> None:
    async with serving(base.path) as (_, client):
        for path, status in {"/": 200, "/api/mission": 403, "/api/events": 403, "/static/page.css": 403}.items():
            async with client.get(path, headers={"Sec-Fetch-Site": site}) as answer:
                assert answer.status == status
                assert "Access-Control-Allow-Origin" not in answer.headers
        assert await status_of(client.post("/login", data={"token": TOKEN}, headers={"Sec-Fetch-Site": site})) == 403


async def test_with_a_token_nothing_is_seen_without_it(base: Base) -> None:
    async with serving(base.path, token=TOKEN) as (_, client):
        async with client.get("/", allow_redirects=False) as answer:
            assert (answer.status, answer.headers["Location"]) == (303, "/login")
        for path in ("/api/mission", "/api/events", "/api/drone/7", "/api/at?t=1", "/tiles/1/0/0"):
            for headers in ({}, {"Authorization": "Bearer wrong"}, {"Cookie": f"rass-page={TOKEN}"}):
                async with client.get(path, headers=headers) as answer:
                    assert answer.status == 401
                    assert answer.headers["WWW-Authenticate"] == "Bearer"
        assert await status_of(client.get("/api/mission", headers={"Authorization": f"Bearer {TOKEN}"})) == 200
        for path in ("/healthz", "/login", "/static/page.css"):
            assert await status_of(client.get(path)) == 200


async def test_the_login_gives_a_cookie_that_scripts_do_not_see(base: Base) -> None:
    async with serving(base.path, token=TOKEN) as (_, client):
        client.session._cookie_jar = CookieJar(unsafe=True)
        for wrong in ({"token": "wrong"}, {}, {"token": ""}):
            async with client.post("/login", data=wrong) as answer:
                assert answer.status == 401
                assert 'role="alert">Wrong token' in await answer.text()
        async with client.post("/login", data={"token": f" {TOKEN}\n"}, allow_redirects=False) as answer:
            assert answer.status == 303
            cookie = answer.headers["Set-Cookie"]
            assert "HttpOnly" in cookie
            assert "SameSite=Strict" in cookie
            assert TOKEN not in cookie
        async with client.get("/api/mission") as answer:
            assert (await answer.json())["token"] is True
        assert await status_of(client.get("/login", allow_redirects=False)) == 303
        assert await status_of(client.post("/logout", allow_redirects=False)) == 303
        assert await status_of(client.get("/api/mission")) == 401
        assert await status_of(client.post("/login", data={"token": "x" * 100_000})) == 413


async def test_who_guesses_has_to_wait(base: Base) -> None:
    async with serving(base.path, token=TOKEN) as (_, client):
        right, wrong = ({"Authorization": f"Bearer {word}"} for word in (TOKEN, "wrong"))
        for n in range(MOST_WRONG):
            path, status = ("/api/mission", 401) if n % 2 else ("/healthz", 200)
            assert await status_of(client.get(path, headers=wrong)) == status
        while (answer := await client.post("/login", data={"token": "wrong"})).status == 401:
            answer.close()
        for headers in (right, wrong):
            async with client.get("/api/mission", headers=headers) as answer:
                assert answer.status == 429
                assert 0 < int(answer.headers["Retry-After"]) <= WRONG_S
        async with client.post("/login", data={"token": TOKEN}) as answer:
            assert answer.status == 429
            assert "try again in" in await answer.text()
        assert await status_of(client.get("/api/mission")) == 401


async def test_news_come_as_data_arrive(base: Base) -> None:
    async with serving(base.path) as (_, client):
        feed = events(client.session, str(client.make_url("/api/events")))
        kind, data = await feed.__anext__()
        assert kind == "mission"
        while kind == "attention" or json.loads(data)["totals"]["arrived"] < 2:
            kind, data = await feed.__anext__()
        base.arrive(base.measurement(8, 0, HERE), base.file(7, 1, "photo.jpg", b"x"))
        while kind != "news" or json.loads(data)["totals"]["arrived"] < 4:
            kind, data = await feed.__anext__()
        news = json.loads(data)
        assert {figures["drone"] for figures in news["drones"]} == {7, 8}
        assert news["totals"]["missing"] == 1
        await feed.aclose()


async def test_names_of_drones_and_stores_are_data(tmp_path: Path) -> None:
    """Nothing that a drone says is in the page itself, and nothing ends an event or a string of JSON."""
    base = Base(tmp_path / "a<script>b\n\n<img src=x onerror=y>.db")
    base.arrive(*(base.file(7, number, name, b"x") for number, name in enumerate(HOSTILE)))
    base.arrive(base.datum(7, 99, Kind.MEASUREMENT, b"\1"))
    base.close()
    async with serving(base.path) as (_, client):
        async with client.get("/") as answer:
            assert "a<script>b" not in await answer.text()
        feed = events(client.session, str(client.make_url("/api/events")))
        while True:
            _, data = await feed.__anext__()
            if json.loads(data)["totals"]["arrived"] == len(HOSTILE) + 1:
                break
        assert json.loads(data)["store"] == "a<script>b\n\n<img src=x onerror=y>.db"
        await feed.aclose()
    said = event("news", {"store": "a\nevent: mission\ndata: {}\n\n\u2028\x07</script>"})
    assert said.count(b"\n") == 3
    assert said.isascii()


async def test_a_client_that_is_too_slow_is_cut(base: Base) -> None:
    hub = Hub(waiting=4)
    async with serving(base.path, hub=hub) as (_, client):
        answer = await client.get("/api/events")
        assert len(hub) == 1
        # It does not read; what the sockets take is bounded.
        while hub.cut == 0:
            hub.publish(b"data: " + b"x" * 1_000_000 + b"\n\n")
            await asyncio.sleep(0)
        assert len(hub) == 0
        answer.close()
        assert await status_of(client.get("/healthz")) == 200


async def test_there_are_not_too_many_clients(base: Base) -> None:
    hub = Hub(most=2)
    async with serving(base.path, hub=hub) as (_, client):
        one, two, three = [await client.get("/api/events") for _ in range(3)]
        assert [one.status, two.status, three.status] == [200, 200, 503]
        assert "close one" in await three.text()
        one.close()
        # The server notices a little later.
        while (again := await client.get("/api/events")).status != 200:
            again.close()
        two.close()
        again.close()


class Wire:
    """A connection that only notes its end."""

    def __init__(self) -> None:
        self.ended = False

    def abort(self) -> None:
        self.ended = True

    def is_closing(self) -> bool:
        return self.ended


def test_the_hub() -> None:
    one, two, three = Wire(), Wire(), Wire()
    hub = Hub(most=1, waiting=1)
    client = hub.join(one)
    with pytest.raises(CrowdedError):
        hub.join(two)
    hub.publish(b"1")
    hub.publish(b"2")
    assert (one.ended, len(hub), hub.cut) == (True, 0, 1)
    assert client.news.get_nowait() == END, "and not what it was too slow for"
    hub.leave(client)
    hub.join(two)
    two.abort()
    last = hub.join(three)
    assert len(hub) == 1, "whoever is gone makes room"
    hub.publish(b"1")
    hub.close(b"the end")
    assert not three.ended, "it can still get the last news"
    assert len(hub) == 0
    assert [last.news.get_nowait(), last.news.get_nowait()] == [b"the end", END]


async def test_who_looks_learns_that_the_page_was_stopped(base: Base) -> None:
    async with serving(base.path) as (_, client):
        feed = events(client.session, str(client.make_url("/api/events")))
        assert (await feed.__anext__())[0] == "mission"
        await client.server.close()
        assert [kind async for kind, _ in feed][-1] == "end"


@pytest.mark.parametrize(("later_s", "ended", "run"), [(0, 0, "runs"), (3600, 0, "stopped"), (0, 1, "ended")])
async def test_it_says_whether_more_may_come(base: Base, later_s: int, ended: int, run: str) -> None:
    base.store.set_meta(ENDED, ended)
    base.arrive()
    async with serving(base.path, now=lambda: base.wall + later_s) as (_, client):
        feed = events(client.session, str(client.make_url("/api/events")))
        kind, data = await feed.__anext__()
        while kind not in ("mission", "news") or json.loads(data)["behind"]:
            kind, data = await feed.__anext__()
        assert json.loads(data)["run"] == run
        assert json.loads(data)["end"] == pytest.approx(base.wall, abs=0.01)
        await feed.aclose()


async def test_a_store_whose_node_does_not_answer_is_not_written(base: Base, tmp_path: Path) -> None:
    async with serving(base.path, now=lambda: base.wall, socket=tmp_path / "none.sock") as (_, client):
        feed = events(client.session, str(client.make_url("/api/events")))
        kind, data = await feed.__anext__()
        while kind != "node":
            kind, data = await feed.__anext__()
        assert (json.loads(data)["node"], json.loads(data)["run"]) == (None, "stopped")
        await feed.aclose()


@pytest.mark.parametrize(
    ("name", "title"),
    [
        ("zurich 3 May.db", "zurich 3 May"),
        ("rass-12.db", "survey/rass-12"),
        ("base.db", "survey/base"),
        ("<b>.x.db", "<b>.x"),
        ("bare", "bare"),
    ],
)
async def test_a_mission_has_the_name_of_its_file(tmp_path: Path, name: str, title: str) -> None:
    (tmp_path / "survey").mkdir()
    base = Base(tmp_path / "survey" / name)
    base.close()
    async with serving(base.path) as (_, client), client.get("/api/mission") as answer:
        assert (await answer.json())["title"] == title


# -- charts and files --------------------------------------------------------------------------------------------------


async def test_readings_of_several_drones(base: Base) -> None:
    base.arrive(base.measurement(8, 0, HERE._replace(unit="cpm", reading=40.0)))
    async with serving(base.path) as (page, client):
        while page.remarks or (await (await client.get("/api/mission")).json())["behind"]:
            await asyncio.sleep(0)
        async with client.get("/api/readings?drones=7,8,65535") as answer:
            found = (await answer.json())["drones"]
        assert [len(found["7"]["usvh"]["value"]), found["8"]["cpm"]["value"], found["65535"]] == [1, [40.0], {}]
        many = ",".join(map(str, range(MOST_COMPARED + 1)))
        for wrong in ("", "7,", "x", "-1", "7;8", "999999", "\u0663", many):
            assert await status_of(client.get("/api/readings", params={"drones": wrong})) == 400


@pytest.mark.parametrize("name", [name for name in names() if format_of(name).ending])
async def test_every_format_that_is_one_file_can_be_saved(base: Base, tmp_path: Path, name: str) -> None:
    async with serving(base.path, token=TOKEN) as (_, client):
        assert await status_of(client.get(f"/api/export/{name}")) == 401
        client.session.headers["Authorization"] = f"Bearer {TOKEN}"
        async with client.get("/api/mission") as answer:
            assert {"name": name, "ending": format_of(name).ending} in (await answer.json())["exports"]
        async with client.get(f"/api/export/{name}") as answer:
            assert answer.status == 200
            disposition, body = answer.headers["Content-Disposition"], await answer.read()
        assert re.fullmatch(r'attachment; filename="[A-Za-z0-9._-]+-rass-1\.' + name + '"', disposition)
        assert len(body) == answer.content_length
    with Archive(base.path) as archive:
        format_of(name).write(archive.entries(), tmp_path / "own", archive)
    own = (tmp_path / "own").read_bytes()
    # Some note when they were written.
    assert body[:16] == own[:16]


async def test_what_cannot_be_saved_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    base = Base(tmp_path / "rass-1.db")
    async with serving(base.path) as (_, client):
        for wrong in ("files", "nothing", "csv.py", "__init__"):
            assert await status_of(client.get(f"/api/export/{wrong}")) == 404
        async with client.get("/api/export/csv") as answer:
            assert (answer.status, await answer.text()) == (409, "nothing to export: the store holds no data\n")
        base.arrive(base.file(7, 0, "photo.jpg", b"x"))
        async with client.get("/api/export/kml") as answer:
            assert answer.status == 409
            assert "nothing to export: 1" in await answer.text()
        monkeypatch.setattr(exports, "MOST_EXPORTED", 0)
        async with client.get("/api/export/csv") as answer:
            assert (answer.status, await answer.text()) == (
                409,
                "1 data are too many for a browser: use rass-mav export\n",
            )
    base.close()


async def test_the_name_of_a_file_is_harmless(tmp_path: Path) -> None:
    base = Base(tmp_path / 'x"; a=b\r\nSet-Cookie: y=1\u2028..\u00e9.db')
    base.arrive(base.measurement(7, 0, HERE))
    async with serving(base.path) as (_, client), client.get("/api/export/csv") as answer:
        assert answer.headers["Content-Disposition"] == 'attachment; filename="x-a-b-Set-Cookie-y-1.csv"'
        assert "Set-Cookie" not in answer.headers
    base.close()


async def test_one_file_at_a_time_and_the_page_goes_on(base: Base) -> None:
    go, opened = threading.Event(), 0

    def open() -> Archive:
        """The disk takes its time when the data are opened once more."""
        nonlocal opened
        opened += 1
        if opened > 1:
            go.wait(PATIENCE_S)
        return Archive(base.path)

    page = Page(Follower(open, keep=True), Access("127.0.0.1", None))
    async with TestClient(TestServer(page.app(), host="127.0.0.1")) as client:
        first = asyncio.create_task(client.get("/api/export/csv"))
        while opened < 2:
            await asyncio.sleep(0)
        async with client.get("/api/export/kml") as answer:
            assert (answer.status, "try again" in await answer.text()) == (503, True)
            assert "Retry-After" in answer.headers
        assert await status_of(client.get("/api/mission")) == 200
        go.set()
        assert (await first).status == 200
        while (answer := await client.get("/api/export/kml")).status == 503:
            answer.close()
        assert answer.status == 200


async def test_photographs_are_served_with_the_type_that_they_have(base: Base) -> None:
    photo = image("PNG")
    base.arrive(
        base.file(7, 10, 'x.jpg"; filename="a.html', photo), base.file(7, 11, "x.jpg\r\nX-Forged: 1.jpg", photo),
        base.file(7, 12, "page.jpg", b"<html><script>alert(1)</script>"), base.file(7, 14, "a.txt", photo),
        base.file(7, 13, "huge.png", png_head(9**9, 9)),
    )  # fmt: skip
    async with serving(base.path) as (_, client):
        async for kind, data in events(client.session, str(client.make_url("/api/events"))):
            if kind in ("mission", "news") and not json.loads(data)["behind"]:
                break
        for number, status in ((10, 404), (11, 200), (12, 404), (13, 404), (14, 404)):
            async with client.get(f"/api/picture/7-abc00001-{number}") as answer:
                assert (number, answer.status) == (number, status)
                for name, value in HEADERS.items():
                    assert answer.headers[name] == value
                if status == 200:
                    assert answer.headers["Content-Type"] == "image/png", "not that of its name"
                    assert answer.headers["Content-Disposition"] == 'inline; filename="7-abc00001-11.png"'
                    assert answer.headers["Cache-Control"].startswith("private")
                    assert "X-Forged" not in answer.headers
                    assert await answer.read() == photo
    async with serving(base.path, token=TOKEN) as (_, client):
        assert await status_of(client.get("/api/picture/7-abc00001-11")) == 401


async def test_contours_are_sent_when_they_have_been_drawn(base: Base) -> None:
    async with serving(base.path) as (_, client):
        async for kind, data in events(client.session, str(client.make_url("/api/events"))):
            # On a busy computer they are drawn before anybody asks for events: then they are in the first one.
            if kind in ("mission", "contours") and (drawn := json.loads(data)["contours"]):
                assert drawn["usvh"]["levels"] == [1.0, 25.0, 100.0]
                break
        async with client.get("/api/mission") as answer:
            assert (await answer.json())["contours"]["usvh"]["lines"] == []


async def test_tiles(base: Base, tmp_path: Path) -> None:
    tiles = Tiles(mbtiles(tmp_path / "map.mbtiles", {(1, 0, 1): JPEG}, attribution="crew"))
    async with serving(base.path, tiles=tiles) as (_, client):
        async with client.get("/api/mission") as answer:
            assert (await answer.json())["tiles"]["attribution"] == "crew"
        async with client.get("/tiles/1/0/0") as answer:
            assert (answer.content_type, await answer.read()) == ("image/jpeg", JPEG)
        async with client.get("/tiles/1/1/1") as answer:
            assert (answer.content_type, await answer.read()) == ("image/png", NOTHING)


class TestFollower:
    def test_it_reads_in_parts_and_then_what_is_new(self, base: Base, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("rass_mav.ground.follow.MOST_IN_A_LOOK", 3)
        base.arrive(*(base.measurement(8, number, HERE) for number in range(5)))
        follower = Follower(lambda: Archive(base.path))
        taken = []
        while follower.behind:
            assert follower.look()
            taken.append(follower.mission.taken)
        assert taken == [3, 6, 7]
        assert not follower.look()
        base.arrive(base.measurement(9, 0, HERE))
        assert follower.look()
        assert follower.mission.taken == 8
        assert set(follower.mission.report.drones) == {7, 8, 9}
        follower.close()

    def test_second_contents_count_whenever_they_arrive(self, base: Base) -> None:
        other = HERE._replace(reading=9.0)
        base.store.keep_apart(base.measurement(7, 0, other))
        base.arrive()
        follower = Follower(lambda: Archive(base.path))
        while follower.behind:
            follower.look()
        assert (follower.mission.taken, follower.mission.report.apart) == (3, 1)
        assert not follower.look()
        base.store.keep_apart(base.measurement(7, 0, other._replace(reading=10.0)))
        base.arrive(base.measurement(7, 2, HERE))
        assert follower.look()
        assert (follower.mission.taken, follower.mission.report.apart) == (5, 2)
        assert not follower.look()
        follower.close()

    def test_the_page_hears_of_the_end_of_reading_also_where_the_last_part_is_full(
        self, base: Base, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("rass_mav.ground.follow.MOST_IN_A_LOOK", 2)
        follower = Follower(lambda: Archive(base.path))
        assert follower.look()
        assert follower.behind
        assert follower.look()
        assert not follower.behind
        assert not follower.look()
        follower.close()

    def test_a_store_that_cannot_be_read_is_trouble_until_it_can(self, base: Base) -> None:
        archive = Archive(base.path)
        opened = []

        def open() -> Archive:
            opened.append(base.path)
            if len(opened) == 2:
                raise StoreError(f"{base.path}: gone")
            return archive if len(opened) == 1 else Archive(base.path)

        follower = Follower(open, keep=True)
        assert follower.look()
        archive.renew = fail  # type: ignore[method-assign]
        assert follower.look()
        assert follower.trouble == "it fails"
        assert follower.look()
        assert "gone" in follower.trouble
        base.arrive(base.measurement(9, 0, HERE))
        assert follower.look()
        assert (follower.trouble, follower.mission.taken, len(opened)) == ("", 3, 3)
        follower.close()

    def test_nobody_answers_where_no_node_runs(self, tmp_path: Path) -> None:
        assert ask_node(tmp_path / "none.sock") is None

    def test_what_a_running_node_says(self, tmp_path: Path) -> None:
        said = {
            "node_id": 1, "role": "base", "version": "1", "uptime_s": 5.0, "next_hop": None, "hop_count": 0,
            "faults": {"count": 2}, "neighbours": [{"node_id": 7, "age_s": 0.5, "hops": 1, "risk": 0.1}], "life": "x",
        }  # fmt: skip

        class Answer(socketserver.StreamRequestHandler):
            def handle(self) -> None:
                self.rfile.readline()
                self.wfile.write(json.dumps({"ok": True, "status": said}).encode() + b"\n")

        path = tmp_path / "node.sock"
        with socketserver.UnixStreamServer(str(path), Answer) as node:
            thread = threading.Thread(target=node.handle_request)
            thread.start()
            found = ask_node(path)
            thread.join(PATIENCE_S)
        assert found is not None
        assert (found.about["node_id"], found.about["faults"]) == (1, 2)
        assert found.about["neighbours"] == [{"node_id": 7, "age_s": 0.5, "hops": 1}]
        assert "life" not in found.about
        assert found.attention == [], "a node of another version may say less"


def fail() -> None:
    raise StoreError("it fails")
