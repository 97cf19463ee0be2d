"""What messages say that do not depend on who raises them."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from rass_mav.errors import ConfigError, comma_hint, installing, os_errors_as

METADATA = """\
Metadata-Version: 2.4
Name: rass-mav
Version: 0.1.0
Requires-Dist: pyyaml>=6.0
Provides-Extra: drone
Requires-Dist: pyserial>=3.5; extra == "drone"
Requires-Dist: pynacl>=1.5; (platform_machine == "x86_64" or platform_machine == "aarch64") and extra == "drone"
Provides-Extra: keys
Requires-Dist: pynacl>=1.5; extra == "keys"
"""


def test_who_has_installed_a_wheel_is_not_sent_to_a_checkout(tmp_path: Path) -> None:
    """The names of the packages are what works without one."""
    (tmp_path / "rass_mav").mkdir()
    (tmp_path / "rass_mav/__init__.py").touch()
    shutil.copy2(Path(__file__).parents[1] / "rass_mav/errors.py", tmp_path / "rass_mav")
    (tmp_path / "rass_mav-0.1.0.dist-info").mkdir()
    (tmp_path / "rass_mav-0.1.0.dist-info/METADATA").write_text(METADATA)
    program = "from rass_mav.errors import installing; print(installing('keys')); print(installing('drone'))"
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == [
        "pip install 'pynacl>=1.5'",
        "pip install 'pyserial>=3.5' "
        """'pynacl>=1.5; (platform_machine == "x86_64" or platform_machine == "aarch64")'""",
    ]


def test_in_a_checkout_the_extra_is_enough() -> None:
    """It stays the one that is installed: a copy of it would be told another remedy."""
    assert installing("keys") == "pip install -e '.[keys]' in the checkout"


@pytest.mark.parametrize(
    ("path", "reason"),
    [
        ("{}/none/a.csv", "there is no folder {}/none"),
        ("{}/a.csv", "no such file or directory"),
        ("/proc/a.csv", "no such file, and /proc accepts no files"),
    ],
)
def test_which_part_of_a_path_is_missing(path: str, reason: str, tmp_path: Path) -> None:
    path = path.format(tmp_path)
    with pytest.raises(ConfigError) as caught, os_errors_as(ConfigError, path), open(path, "rb"):
        pass
    assert str(caught.value) == f"{path}: {reason.format(tmp_path)}"


@pytest.mark.parametrize(
    ("value", "said"),
    [
        ("0,5", " (a number has a decimal point: 0.5)"),
        ("-73,25", " (a number has a decimal point: -73.25)"),
        ("1,2,3", ""),
        ("ten", ""),
        (5, ""),
    ],
)
def test_a_decimal_comma_is_named(value: object, said: str) -> None:
    assert comma_hint(value) == said
