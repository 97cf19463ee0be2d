"""`page`: the mission on a map, in a browser."""

from __future__ import annotations

import argparse
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from rass_mav.commands.common import Subparsers, add_command, answer, clean, start_logging, warn
from rass_mav.errors import ConfigError, LinkError, RassError, installing, os_errors_as

from .data import add_store, open_archive, rules_of

if TYPE_CHECKING:
    from rass_mav.ground.page.server import Page

#: Where the page is, unless --listen says otherwise.
LISTEN = "127.0.0.1:8080"


def register(subparsers: Subparsers) -> None:
    """Add the command."""
    page = add_command(
        subparsers, "page", _page, help="show a map and the state of a mission in a browser, until Ctrl-C",
        example="rass-mav page base.yaml",
    )  # fmt: skip
    add_store(page)
    page.add_argument(
        "--listen", metavar="HOST:PORT", default=LISTEN, help=f"address to serve the page at (default: {LISTEN})"
    )
    page.add_argument("--token-file", metavar="FILE", help="file whose first line is the token that browsers must send")
    page.add_argument(
        "--name", action="append", default=[], metavar="NAME", dest="names",
        help="another host name under which browsers may request the page; repeatable",
    )  # fmt: skip
    page.add_argument("--tiles", metavar="FILE", help="your own map: image tiles in MBTiles or PMTiles")


def _page(options: argparse.Namespace) -> int:
    import asyncio

    from rass_mav.app.outlets import PageSection

    try:
        from rass_mav.ground.page.server import page_of
    except ModuleNotFoundError as error:
        if error.name != "aiohttp":
            raise
        raise RassError(f"page: needs the package aiohttp: {installing('ground')}") from None
    start_logging(options.verbose)
    section = PageSection(
        listen=options.listen, token_file=options.token_file, names=tuple(options.names), tiles=options.tiles
    )
    try:
        section.check()
    except ConfigError as error:
        raise ConfigError(f"--listen: {error}") from None
    if options.token_file is not None and section.token() and Path(options.token_file).stat().st_mode & 0o077:
        warn(f"{clean(options.token_file)}: other users can read the token: run chmod 600 on it")
    page = page_of(section, lambda: open_archive(options), _socket_of(options.store), rules_of(options), keep=True)
    for remark in page.remarks:
        warn(clean(remark))
    asyncio.run(_serve(page, options))
    return 0


def _socket_of(store: str | None) -> Path | None:
    """Where the running node of a configuration answers."""
    if store is None or Path(store).suffix not in (".yaml", ".yml"):
        return None
    from rass_mav.app.config import load_config

    return load_config(store).socket_path


async def _serve(page: Page, options: argparse.Namespace) -> None:
    import asyncio

    from rass_mav.ground.page.server import serve

    stopped = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stopped.set)

    def ready(url: str) -> None:
        answer(options, {"url": url}, [f"{url} serves the mission until Ctrl-C"])
        sys.stdout.flush()

    with os_errors_as(LinkError, f"--listen: {options.listen}"):
        await serve(page, options.listen, ready, stopped)
