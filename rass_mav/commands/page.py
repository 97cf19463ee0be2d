"""`page`: the mission on a map, in a browser."""

from __future__ import annotations

import argparse
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from rass_mav.errors import ConfigError, LinkError, RassError, installing, os_errors_as

from .common import Subparsers, add_command, answer, clean, start_logging, warn
from .data import STORE_HELP, open_archive

if TYPE_CHECKING:
    from rass_mav.page.server import Page

#: Where the page is, unless --listen says otherwise.
LISTEN = "127.0.0.1:8080"


def register(subparsers: Subparsers) -> None:
    """Add the command."""
    page = add_command(
        subparsers, "page", _page, help="show a map and the state of a mission in a browser, until Ctrl-C",
        example="rass-mav page base.yaml",
    )  # fmt: skip
    page.add_argument("store", metavar="STORE|CONFIG", nargs="?", help=STORE_HELP)
    page.add_argument("--listen", metavar="HOST:PORT", default=LISTEN, help=f"where browsers find it ({LISTEN})")
    page.add_argument(
        "--token-file", type=Path, metavar="FILE", help="its first line is the token that browsers have to give"
    )
    page.add_argument(
        "--name", action="append", default=[], metavar="NAME", dest="names",
        help="another name of this computer, by which browsers may ask for the page; may be repeated",
    )  # fmt: skip
    page.add_argument(
        "--tiles", type=Path, metavar="FILE", help="the crew's own map, a file of images in MBTiles or PMTiles"
    )


def _page(options: argparse.Namespace) -> int:
    import asyncio

    from rass_mav.link.address import parse_address
    from rass_mav.page.access import Access, check_listen, read_token
    from rass_mav.page.follow import Follower
    from rass_mav.page.tiles import Tiles

    try:
        from rass_mav.page.server import Page
    except ModuleNotFoundError as error:
        if error.name != "aiohttp":
            raise
        raise RassError(f"page: needs the package aiohttp: {installing('ground')}") from None
    start_logging(options.verbose)
    try:
        host, port = parse_address(options.listen, any_port=True, ipv6=True)
    except ConfigError as error:
        raise ConfigError(f"--listen: {error}") from None
    token = None if options.token_file is None else read_token(options.token_file)
    check_listen(host, token)
    if token is not None and options.token_file.stat().st_mode & 0o077:
        warn(f"{clean(str(options.token_file))}: others on this computer can read the token: chmod 600 it")
    tiles = None if options.tiles is None else Tiles(options.tiles)
    follower = Follower(lambda: open_archive(options.store))
    for remark in follower.remarks:
        warn(clean(remark))
    access = Access(host, token, options.names)
    page = Page(follower, access, tiles=tiles, socket=_socket_of(options.store))
    asyncio.run(_serve(page, host, port, options))
    return 0


def _socket_of(store: str | None) -> Path | None:
    """Where the running node of a configuration answers."""
    if store is None or Path(store).suffix not in (".yaml", ".yml"):
        return None
    from rass_mav.app.config import load_config

    return load_config(store).socket_path


async def _serve(page: Page, host: str, port: int, options: argparse.Namespace) -> None:
    import asyncio

    from rass_mav.link.address import show_address
    from rass_mav.page.server import serve

    stopped = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stopped.set)

    def ready(address: str, actual: int) -> None:
        url = f"http://{show_address((address, actual))}/"
        answer(options, {"url": url}, [f"{url} shows the mission, until Ctrl-C"])
        sys.stdout.flush()

    with os_errors_as(LinkError, f"--listen: {show_address((host, port))}"):
        await serve(page, host, port, ready, stopped)
