"""The wheel holds all that a drone needs: installed alone, beside nothing but what a node imports, it works."""

from __future__ import annotations

import importlib.util
import json
import os
import select
import shutil
import signal
import subprocess
import sys
import venv
from pathlib import Path

import pytest

from tests.patience import PATIENCE_S

ROOT = Path(__file__).resolve().parents[1]
#: All that a node imports from elsewhere. Without fastcrc and lxml, which pymavlink demands, and without msgspec, which
#: only the mock swarm needs: these are compiled, and not every board has them.
NEEDED = ("pymavlink", "yaml")
#: What builds the wheel.
BUILDS = ("pip", "setuptools", "shtab", "argparse_manpage")
CONFIG = "node: {id: 7, step_s: 0.1}\nlinks: [{listen: '127.0.0.1:0', peers: [{address: '127.0.0.1:9'}]}]\n"


@pytest.fixture(scope="module")
def rass_mav(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The command `rass-mav` in an environment into which only the wheel was installed."""
    if missing := [name for name in BUILDS if importlib.util.find_spec(name) is None]:
        pytest.skip(f"not installed: {', '.join(missing)}")
    directory = tmp_path_factory.mktemp("wheel")
    # A build leaves files behind in the folder that it is made from.
    source = directory / "source"
    source.mkdir()
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for name in ("rass_mav", "firmware_params", "sitl"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    pip = [sys.executable, "-m", "pip", "-q", "--disable-pip-version-check"]
    _run(*pip, "wheel", "--no-deps", "--no-index", "--no-build-isolation", "-w", str(directory), str(source))
    (wheel,) = directory.glob("rass_mav-*.whl")
    assert wheel.name.endswith("-py3-none-any.whl")

    environment = directory / "venv"
    venv.create(environment, symlinks=True)
    python = environment / "bin" / "python"
    _run(*pip, "--python", str(python), "install", "--no-deps", "--no-index", str(wheel))
    shutil.rmtree(source)
    packages = directory / "packages"
    packages.mkdir()
    for name in NEEDED:
        found = importlib.util.find_spec(name)
        assert found is not None
        assert found.origin is not None
        (packages / name).symlink_to(Path(found.origin).parent)
    (site,) = environment.glob("lib/python*/site-packages")
    (site / "needed.pth").write_text(f"{packages}\n")
    return environment / "bin" / "rass-mav"


def _run(*command: str, cwd: Path | None = None) -> str:
    done = subprocess.run(
        command, cwd=cwd, env=_environment(), capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def _environment() -> dict[str, str]:
    """Nothing of ours is in it: what is installed is not what coverage measures."""
    return {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}


def test_it_is_the_installed_one_and_knows_nothing_else(rass_mav: Path, tmp_path: Path) -> None:
    python = str(rass_mav.with_name("python"))
    code = "import rass_mav, importlib.util as u, sys; print(rass_mav.__file__, *map(u.find_spec, sys.argv[1:]))"
    file, *others = _run(python, "-c", code, "fastcrc", "lxml", "msgspec", cwd=tmp_path).split()
    assert Path(file).is_relative_to(rass_mav.parents[1])
    assert others == ["None", "None", "None"]


def test_help_and_version(rass_mav: Path, tmp_path: Path) -> None:
    assert "example: rass-mav run drone.yaml" in _run(str(rass_mav), "--help", cwd=tmp_path)
    assert _run(str(rass_mav), "--version", cwd=tmp_path).startswith("rass-mav ")


def test_check_run_and_status(rass_mav: Path, tmp_path: Path) -> None:
    (tmp_path / "drone.yaml").write_text(CONFIG)
    assert "ok (drone, node 7)" in _run(str(rass_mav), "check", "drone.yaml", cwd=tmp_path)
    with subprocess.Popen(
        [str(rass_mav), "run", "drone.yaml", "--json"], cwd=tmp_path, env=_environment(), stdout=subprocess.PIPE
    ) as node:
        try:
            assert node.stdout is not None
            assert select.select([node.stdout], [], [], PATIENCE_S)[0]
            assert json.loads(node.stdout.readline())["node_id"] == 7
            assert json.loads(_run(str(rass_mav), "status", "drone.yaml", "--json", cwd=tmp_path))["node_id"] == 7
            node.send_signal(signal.SIGTERM)
            assert node.wait(PATIENCE_S) == 0
        finally:
            node.kill()


def test_the_files_that_go_with_it_are_in_it(rass_mav: Path, tmp_path: Path) -> None:
    (tmp_path / "drone.yaml").write_text(CONFIG)
    assert "WatchdogSec=" in _run(str(rass_mav), "service", "install", "drone.yaml", "--print", cwd=tmp_path)
    (package,) = rass_mav.parents[1].glob("lib/python*/site-packages/rass_mav")
    static = ROOT / "rass_mav" / "ground" / "page" / "static"
    for file in (path.relative_to(static) for path in static.rglob("*") if path.is_file()):
        assert (package / "ground" / "page" / "static" / file).is_file()
    said = _run(str(rass_mav), "swarm", "five-drones", "--steps", "5", "--json", cwd=tmp_path)
    assert json.loads(said)["steps"] == 5
    for file in (*(ROOT / "firmware_params").glob("*.param*"), *(ROOT / "firmware_params").glob("*.parm")):
        assert f"{file.name}: ok, " in _run(str(rass_mav), "params", "check", file.name, cwd=tmp_path)
    (share,) = rass_mav.parents[1].glob("share/rass-mav")
    names = {file.name for file in (ROOT / "sitl").glob("*.yaml")} | {"rass_rad.lua"}
    assert names <= {file.name for file in share.iterdir()}


@pytest.mark.parametrize(
    ("shell", "file", "words"),
    [
        ("bash", "bash-completion/completions/rass-mav", "complete -o bashdefault -F "),
        ("zsh", "zsh/site-functions/_rass-mav", "#compdef rass-mav"),
        ("fish", "fish/vendor_completions.d/rass-mav.fish", "complete -c rass-mav "),
    ],
)
def test_completions_of_all_commands_are_in_it(
    rass_mav: Path, tmp_path: Path, shell: str, file: str, words: str
) -> None:
    printed = _run(str(rass_mav), "completion", shell, cwd=tmp_path)
    assert words in printed
    assert all(name in printed for name in ("five-drones", "backpressure", "through-autopilots"))
    assert (rass_mav.parents[1] / "share" / file).read_text(encoding="utf-8") == printed


def test_it_says_nothing_of_a_folder_that_its_users_do_not_have(rass_mav: Path, tmp_path: Path) -> None:
    """The manual page has the help of all commands."""
    page = (rass_mav.parents[1] / "share" / "man" / "man1" / "rass-mav.1").read_text(encoding="utf-8")
    (tmp_path / "base.yaml").write_text(CONFIG.replace("id: 7", "id: 7, role: base"))
    said = page.replace("\\-", "-")
    for command in (
        ("page", "base.yaml"), ("sources", "base.yaml"), ("keys", "new", "mission"), ("sitl", "none.yaml"),
        ("experiment", "paper", "--out", "out", "--dask", "127.0.0.1:1"), ("doctor", "none.yaml"), ("demo",),
    ):  # fmt: skip
        done = subprocess.run(
            [str(rass_mav), *command], cwd=tmp_path, env=_environment(), capture_output=True, text=True,
            timeout=PATIENCE_S, check=False,
        )  # fmt: skip
        assert done.returncode, command
        said += done.stdout + done.stderr
    for words in ("checkout", "make install", "sitl/three", "'.["):
        assert words not in said
    assert "pip install 'aiohttp" in said


def test_the_manual_page_is_in_it(rass_mav: Path) -> None:
    page = (rass_mav.parents[1] / "share" / "man" / "man1" / "rass-mav.1").read_text(encoding="utf-8")
    assert page.startswith('.TH RASS\\-MAV "1" "" ')
    # As wide as a page, whatever the terminal of the build.
    assert "rass\\-mav run [\\-h] [\\-v] [\\-\\-json] [\\-q] [\\-\\-set KEY.PATH=VALUE] CONFIG.yaml\n" in page


def test_vehicles_fly_with_the_script_that_comes_with_it(rass_mav: Path, tmp_path: Path) -> None:
    """Without it, readings would be injected beside the autopilot."""
    packages = tmp_path / "packages"
    packages.mkdir()
    found = importlib.util.find_spec("msgspec")
    assert found is not None
    assert found.origin is not None
    (packages / "msgspec").symlink_to(Path(found.origin).parent)
    copter = tmp_path / "arducopter"
    copter.write_text("#!/bin/sh\n")
    copter.chmod(0o755)
    code = (
        "import sys; sys.path.append(sys.argv[1]); from rass_mav.lab.sitl.firmware import find_firmware; "
        "print(find_firmware(sys.argv[2]).script)"
    )
    script = _run(str(rass_mav.with_name("python")), "-c", code, str(packages), str(copter), cwd=tmp_path).strip()
    assert Path(script).is_relative_to(rass_mav.parents[1])
    assert Path(script).read_bytes() == (ROOT / "firmware_params" / "rass_rad.lua").read_bytes()


def test_what_needs_msgspec_says_so(rass_mav: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        [str(rass_mav), "swarm", "five-drones", "--transport", "udp"], cwd=tmp_path, env=_environment(),
        capture_output=True, text=True, timeout=PATIENCE_S, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == "swarm: needs the package msgspec: pip install msgspec\n"
