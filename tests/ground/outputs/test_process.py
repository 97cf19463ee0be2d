"""What all have in common that run beside a base: their sections, their packages, and that they try again."""

from __future__ import annotations

import signal
import socket
import sys
from pathlib import Path
from typing import Any

import pytest

from rass_mav.app.companion import Companion
from rass_mav.app.config import RunConfig
from rass_mav.app.outlets import BaseSection
from rass_mav.config.loading import convert
from rass_mav.errors import ConfigError
from tests.app.app_nodes import RunningNode, Tidy, command

from .beside import report, served

POSTGRES = {"dsn": "postgresql:///rass", "mission": "m"}


def base_config(**sections: Any) -> RunConfig:
    return convert({"node": {"id": 1, "role": "base"}, **sections}, RunConfig, "base.yaml")


@pytest.mark.parametrize(("task", "package"), [("page", "aiohttp"), ("metrics", "prometheus_client")])
def test_an_address_in_use_is_shown_and_tried_again(task: str, package: str, tmp_path: Path, tidy: Tidy) -> None:
    pytest.importorskip(package)
    with socket.create_server(("127.0.0.1", 0)) as other:
        address = f"127.0.0.1:{other.getsockname()[1]}"
        sections: dict[str, Any] = {task: {"listen": address}}
        node = tidy(RunningNode(tmp_path, 1, node={"role": "base"}, **sections)).start()
        node.until(lambda: "address already in use" in str(report(node, task)))
        assert f"WARNING: {task}: {address}: " in command(tmp_path, "status", "n1.yaml").stdout.decode()
    assert address in served(node, task)
    assert node.signal(signal.SIGTERM) == 0


@pytest.mark.parametrize(
    ("task", "section", "why"),
    [
        ("page", {"listen": "0.0.0.0:8080"}, r"listen: 0\.0\.0\.0 is reachable from other computers: add a token file"),
        ("page", {"listen": "8080"}, "listen: expected host:port"),
        ("page", {"listn": "127.0.0.1:1"}, "listn"),
        ("metrics", {"listen": "9109"}, "listen: expected host:port"),
        ("postgres", {**POSTGRES, "dsn": "dbname=rass"}, "dsn: expected a URL such as postgresql://"),
        ("cot", {"url": "http://a:1"}, "url: expected a URL that begins with udp://, tcp://, tls://, got 'http://a:1'"),
        ("cot", {"url": "tcp://a"}, "url: expected host:port"),
        ("cot", {"url": "udp://a:0"}, r"url: expected a port 1\.\.65535"),
        ("cot", {"url": "tls://a:8089", "key_file": "k"}, "url: tls needs cert_file, ca_file too"),
        ("cot", {"url": "tcp://a:8087", "ca_file": "c"}, "url: certificates apply to tls:// only"),
    ],
)
def test_mistakes_are_said_when_the_file_is_read(task: str, section: dict[str, str], why: str) -> None:
    with pytest.raises(ConfigError, match=rf"{task}\.{why}"):
        base_config(**{task: section}).check()


@pytest.mark.parametrize(
    ("task", "section", "package", "extra"),
    [
        ("page", {}, "aiohttp", "ground"),
        ("metrics", {}, "prometheus_client", "metrics"),
        ("postgres", POSTGRES, "psycopg", "postgres"),
        ("cot", {"url": "udp://239.2.3.1:6969"}, "pytak", "cot"),
    ],
)
def test_a_missing_package_is_named(
    task: str, section: dict[str, str], package: str, extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    expected = rf"{task}: needs the Python package {package}: pip install -e '\.\[{extra}\]'"
    with pytest.raises(ConfigError, match=expected):
        Companion(base_config(**{task: section}))


def test_a_missing_file_with_the_token_is_said_at_the_start(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="token: no such file"):
        Companion(base_config(page={"token_file": str(tmp_path / "token")}))


def test_others_can_be_let_in_to_the_figures_but_not_by_mistake() -> None:
    assert base_config(metrics={}).warnings() == []
    assert base_config(metrics={"listen": "localhost:80"}).warnings() == []
    [warning] = base_config(metrics={"listen": "0.0.0.0:9109"}).warnings()
    assert warning.startswith("metrics.listen: anyone who can reach 0.0.0.0:9109")


def test_places_of_drones_are_not_shown_to_all_by_mistake() -> None:
    assert base_config(cot={"url": "tcp://127.0.0.1:8087"}).warnings() == []
    [warning] = base_config(cot={"url": "udp://239.2.3.1:6969"}).warnings()
    assert (
        warning == "cot.url: anyone who receives udp://239.2.3.1:6969 sees where the drones are; tls:// prevents that"
    )


@pytest.mark.parametrize("section", ["metrics", "base"])
def test_a_drone_has_none_of_it(section: str) -> None:
    plain = {"node": {"id": 2}, "links": [{"listen": "127.0.0.1:0", "peers": []}], section: {}}
    with pytest.raises(ConfigError, match=f"{section}: applies to bases only"):
        convert(plain, RunConfig, "drone.yaml").check()


@pytest.mark.parametrize("place", [[91.0, 8.0], [47.0, 181.0], [47.0], "47.0, 8.0", [float("nan"), 8.0]])
def test_a_base_is_on_earth(place: object) -> None:
    with pytest.raises(ConfigError, match=r"base\.place"):
        base_config(base={"place": place}).check()
    assert base_config(base={"place": [-90, 180]}).base == BaseSection(place=(-90.0, 180.0))


@pytest.mark.parametrize("contours", [[0.0], [-1.0], [float("inf")], [1.0] * 8, 25])
def test_contours_are_a_few_readings_above_nothing(contours: object) -> None:
    with pytest.raises(ConfigError, match=r"attention\.contours"):
        base_config(attention={"contours": contours}).check()
